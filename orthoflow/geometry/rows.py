"""Dataclasses of arrays with one row per item, which can be selected and concatenated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Base class of dataclasses whose arrays have one row per item."""

    def __len__(self) -> int:
        return len(next(iter(_arrays(self).values())))

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Self:
        """Return the selected items; views if they are selected by a slice."""
        return replace(self, **{name: array[chosen] for name, array in _arrays(self).items()})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Concatenate items; fields that are not arrays are taken from the first object."""
        columns = {name: [getattr(part, name) for part in parts] for name in _arrays(parts[0])}
        return replace(parts[0], **{name: np.concatenate(own) for name, own in columns.items()})


def _arrays(rows: Rows) -> dict[str, NDArray[Any]]:
    return {name: value for name, value in vars(rows).items() if isinstance(value, np.ndarray)}
