"""Descriptions of a wall's orthoimage for pages, sheets, tiles, tables and catalogues."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import BaseModel, ConfigDict, NonNegativeFloat, NonNegativeInt

from orthoflow.files.drawings.words import Phrase
from orthoflow.products import PAINTED_STATES

ORTHO_FILE: Final = re.compile(r"(?:[a-z]+_)?wall_(\d{1,5})_ortho\.tif")
# An image that covers a smaller share of its wall is not recommended.
_MIN_PAINTED_SHARE: Final = 0.5


class WallDescription(BaseModel):
    """A wall and its orthoimage: size, covered share, expected error and recommendation.

    Attributes:
        number: number of the wall, i.e. the index of its plane in `planes.json`.
        name: name of the wall, including its number.
        kind: `wall`, `floor`, `ceiling`, or another kind defined by the method.
        recommended: whether the orthoimage should be delivered.
        reason: reason for the recommendation.
        width_m: width of the image in metres; None if there is no image, like the following
            numbers.
        height_m: height of the image in metres.
        area_m2: area of the image in square metres.
        painted_share: share of cells with a colour in the image.
        height_of_top_m: height of the upper edge in scan coordinates, in metres; None for
            horizontal surfaces.
        expected_mm_median: median of the expected error (one standard deviation) of points measured
            in the image; None if the image was not checked.
        expected_mm_p95: 95th percentile of the expected error over the image.
        n_withheld_ties: number of withheld tie points on this wall; 0 if there is no image.
        errors: errors of the run that are reasons not to deliver the orthoimage.
        near: centre of the image in scan coordinates, in metres, which selects the wall if it is
            added to the parameter `near` of the wall step.
        orthoimage: path of the GeoTIFF, relative to the file with this description.
    """

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    number: NonNegativeInt
    name: str
    kind: str
    recommended: bool
    reason: str
    width_m: NonNegativeFloat | None = None
    height_m: NonNegativeFloat | None = None
    area_m2: NonNegativeFloat | None = None
    painted_share: NonNegativeFloat | None = None
    height_of_top_m: float | None = None
    expected_mm_median: NonNegativeFloat | None = None
    expected_mm_p95: NonNegativeFloat | None = None
    n_withheld_ties: NonNegativeInt = 0
    errors: tuple[str, ...] = ()
    near: tuple[float, float, float] | None = None
    orthoimage: str | None = None

    @property
    def accuracy(self) -> Phrase:
        """Expected error of the orthoimage, as a phrase for drawings."""
        if self.expected_mm_median is None or self.expected_mm_p95 is None:
            return Phrase(key="not_checked")
        errors = {"median": self.expected_mm_median, "high": self.expected_mm_p95}
        texts: dict[str, object] = {name: f"{error_mm:.1f}" for name, error_mm in errors.items()}
        return Phrase(key="expected_error", values=texts | {"count": f"{self.n_withheld_ties:,}"})

    @property
    def objection(self) -> Phrase | None:
        """Reason not to deliver the orthoimage, as a phrase for drawings; None if there is none."""
        if self.recommended:
            return None
        if self.errors:
            return Phrase(key="run_error", values={"error": "; ".join(self.errors)})
        if (share := self.painted_share or 0.0) < _MIN_PAINTED_SHARE:
            return Phrase(key="barely_painted", values={"percent": f"{100.0 * share:.0f}"})
        return Phrase(key="no_ties")

    @property
    def sentence(self) -> str:
        """Size, covered share, expected error, and any reason not to deliver the image."""
        is_known = self.expected_mm_median is not None
        parts = [self.accuracy.text() if is_known else "expected error not known"]
        if self.painted_share is not None:
            parts.insert(0, f"{self.width_m:.2f} x {self.height_m:.2f} m")
            parts.insert(1, f"{self.painted_share:.0%} covered")
        return "; ".join(
            [*parts, *([] if self.recommended else [f"not recommended: {self.reason}"])]
        )


def described(path: Path, sidecar: Mapping[str, object]) -> WallDescription:
    """Describe the wall of a published orthoimage.

    Args:
        path: the GeoTIFF; for images from photos, the raster of expected errors is next to it.
        sidecar: content of its JSON sidecar.

    Raises:
        ValueError: the sidecar lacks a required number.
    """
    found = ORTHO_FILE.fullmatch(path.name)
    number = int(found[1]) if found else 0
    name = sidecar.get("name")
    name = name if isinstance(name, str) else f"wall {number}"
    counts = _table(sidecar.get("mask_counts"))
    n_painted = sum(_number(counts.get(str(int(state)))) or 0.0 for state in PAINTED_STATES)
    n_cells = sum(_number(count) or 0.0 for count in counts.values())
    painted = round(n_painted / n_cells, 4) if n_cells else 0.0
    accuracy = _table(sidecar.get("accuracy"))
    is_assessed = accuracy.get("assessed") is True
    median, high = (
        _number(accuracy.get(f"expected_mm_{kind}")) if is_assessed else None
        for kind in ("median", "p95")
    )
    is_of_photos = path.with_name(path.name.replace("_ortho.tif", "_error.tif")).exists()
    reason = f"{painted:.0%} covered"
    stated = sidecar.get("errors")
    errors = tuple(str(text) for text in stated) if isinstance(stated, list) else ()
    if errors:
        is_recommended, reason = False, "; ".join(errors)
    elif painted < _MIN_PAINTED_SHARE:
        is_recommended, reason = False, f"only {reason}"
    elif is_of_photos and median is None:
        is_recommended = False
        reason += ", accuracy not checked: there is no tie point on this wall"
    else:
        is_recommended = True
        error = "not known" if median is None else f"{median:.1f} mm"
        reason += f", expected error {error}"
    gsd_m = _number(sidecar.get("gsd_m")) or 0.0
    width, height = (_number(sidecar.get(key)) or 0.0 for key in ("width", "height"))
    return WallDescription(
        number=number,
        name=name,
        kind=name.split(" ", maxsplit=1)[0] or "wall",
        recommended=is_recommended,
        reason=reason,
        width_m=round(gsd_m * width, 4),
        height_m=round(gsd_m * height, 4),
        area_m2=round(gsd_m**2 * width * height, 3),
        painted_share=painted,
        height_of_top_m=_number(sidecar.get("height_of_top_m")),
        expected_mm_median=median,
        expected_mm_p95=high,
        n_withheld_ties=int(_number(accuracy.get("n_check_points")) or 0),
        errors=errors,
        near=_centre(sidecar.get("middle_world", sidecar.get("corners_world"))),
        orthoimage=path.name,
    )


def _table(value: object) -> Mapping[str, object]:
    return value if isinstance(value, dict) else {}


def _number(value: object) -> float | None:
    """Return a sidecar's value as a number; None if it is not a finite number."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(str(value)) if is_number and abs(float(str(value))) < 1e15 else None


def _centre(points: object) -> tuple[float, float, float] | None:
    try:
        x, y, z = np.array(points, dtype=np.float64).reshape(-1, 3).mean(axis=0).round(2).tolist()
    except (TypeError, ValueError):
        return None
    return x, y, z
