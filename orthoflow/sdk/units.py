"""Units in the names of parameters and metrics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

# Unit by word in a name; `1` for dimensionless numbers.
UNITS: Final[Mapping[str, str]] = {
    **{unit: unit for unit in ("m", "mm", "m2", "px", "deg", "rad", "s", "cells", "ppm")},
    "mib": "MiB",
    "grey": "grey levels",
    "sigma": "sigmas",
    **dict.fromkeys(("share", "ratio", "factor", "scale", "exponent", "power", "probability"), "1"),
}


def unit_of(name: str) -> str:
    """Return the unit of a name, from its last word that has one; a lone unit such as `m` has none.

    >>> unit_of("tolerance_m"), unit_of("area_min_m2"), unit_of("area_m2_min"), unit_of("n_trials")
    ('m', 'm2', 'm2', '')
    >>> unit_of("m"), unit_of("share")
    ('', '1')
    """
    words = name.split("_")
    unit = next((UNITS[word] for word in reversed(words) if word in UNITS), "")
    return unit if len(words) > 1 or unit == "1" else ""
