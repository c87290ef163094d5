"""Calibration files: cameras by photo name or pattern, with OpenCV's model and pixel convention.

```yaml
cameras:
  "IMG_00*.jpg": {width: 6000, height: 4000, fx: 4210.5, fy: 4211.2, cx: 2996.1, cy: 2003.7,
                  distortion: [-0.08, 0.05, 0.0002, -0.0001, 0.0]}
  "GOPR*": {model: fisheye, width: 4000, height: 3000, fx: 1750.0, fy: 1750.0, cx: 1999.5,
            cy: 1499.5, distortion: [0.04, 0.01, -0.01, 0.002]}
  "*": {width: 4000, height: 3000, fx: 3004.2, fy: 3004.2, cx: 1999.5, cy: 1499.5}
```

The first entry that matches a photo is used. For `model: fisheye` (`cv2.fisheye`), the distortion
is k1, k2, k3, k4, and `field_of_view_deg` is the full angle that is used, by default 180. In the
file, the centre of the first pixel is (0, 0); internally it is (0.5, 0.5). Only this module
converts between the two.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
)

from orthoflow.errors import GeometryError, InputError
from orthoflow.files.cube_faces import WIDEST_DEG, FisheyeLens, problem_of
from orthoflow.files.documents import read_model
from orthoflow.files.sidecars import write_text
from orthoflow.geometry.cameras import HALF_PIXEL
from orthoflow.products import Calibration, Intrinsics
from orthoflow.untrusted_text import text_of_file

# Parsing a file of this size takes a few seconds; a thousand cameras need about 150 kB.
#: bytes of a calibration file
MOST_BYTES: Final = 400_000
#: entries of a calibration file
MOST_CAMERAS: Final = 1000
#: values of a calibration file, with aliases expanded
MOST_VALUES: Final = 20_000
_REQUIRED: Final = ("width", "height", "fx", "fy", "cx", "cy")


@dataclass(frozen=True, kw_only=True)
class CalibratedLenses:
    """The content of a calibration file; the first pattern that matches a photo applies.

    Attributes:
        patterns: photo names or shell patterns.
        lenses: one lens per pattern.
    """

    patterns: tuple[str, ...]
    lenses: tuple[Intrinsics | FisheyeLens, ...]


def read_calibration(path: Path) -> CalibratedLenses:
    """Read a calibration file.

    Raises:
        InputError: the file is invalid; one line per problem, `file:line:column: ...`.
    """
    text = text_of_file(
        path,
        MOST_BYTES,
        "a calibration file (YAML)",
        way_out=": use one entry with a pattern for all photos of a camera",
    )
    found, problems = read_model(text, _File, MOST_VALUES)
    if found is None:
        raise InputError(
            "\n".join(
                f"{path.name}:{place.line}:{place.column}: {message}" for place, message in problems
            )
        )
    lenses = [_lens(dict(lens), lens.distortion or ()) for lens in found.cameras.values()]
    return CalibratedLenses(patterns=tuple(found.cameras), lenses=tuple(lenses))


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration file for `read_calibration`.

    Raises:
        StoreError: the file cannot be written.
    """
    write_text(path, calibration_text(calibration))


def calibration_text(calibration: Calibration) -> str:
    """Return the content of a calibration file."""
    lines = [
        "# Pixels as OpenCV counts them: the centre of the first pixel is (0, 0).",
        "# distortion: k1, k2, p1, p2, k3. The first entry that matches a photo's name applies.",
        "cameras:",
    ]
    for pattern, camera in zip(calibration.patterns, calibration.intrinsics, strict=True):
        values = {
            "width": camera.width,
            "height": camera.height,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx - HALF_PIXEL,
            "cy": camera.cy - HALF_PIXEL,
            "distortion": list(camera.distortion),
            **({"skew": camera.skew} if camera.skew else {}),
        }
        lines.append(f"  {json.dumps(pattern, ensure_ascii=False)}:")
        lines += [f"    {key}: {json.dumps(value)}" for key, value in values.items()]
    return "\n".join(lines) + "\n"


def matching_pattern(patterns: Sequence[str], photo_name: str) -> str | None:
    """Return the first pattern that equals the photo's name, or matches it as a shell pattern.

    Matching is case-sensitive. A name with brackets matches itself, and a name with folders is also
    matched without the folders.
    """
    names = (photo_name, photo_name.rpartition("/")[2])
    for pattern in patterns:
        if pattern in names or any(fnmatchcase(name, pattern) for name in names):
            return pattern
    return None


def lens_for(
    calibration: CalibratedLenses, photo_name: str, width: int, height: int
) -> Intrinsics | FisheyeLens | None:
    """Return the calibrated lens of a photo; None if no entry matches its name.

    Args:
        calibration: the calibrated lenses.
        photo_name: file name of the photo.
        width: width of the stored array in pixels.
        height: height of the stored array in pixels.

    Raises:
        InputError: the size of the photo differs from that of the calibration.
    """
    pattern = matching_pattern(calibration.patterns, photo_name)
    if pattern is None:
        return None
    camera = calibration.lenses[calibration.patterns.index(pattern)]
    if (camera.width, camera.height) == (width, height):
        return camera
    way_out = (
        "it seems to be for the rotated photo: calibrate the pixels as they are stored, without "
        "the EXIF rotation, or add a separate entry for photos that are stored upright"
        if (camera.width, camera.height) == (height, width)
        else "calibrate at the size of the photos, or add a separate entry for this one"
    )
    raise InputError(
        f'photo {photo_name} has {width} x {height} pixels, but its calibration "{pattern}" is '
        f"for {camera.width} x {camera.height}; {way_out}"
    )


class _Lens(BaseModel):
    """An entry in the file; each validator uses fields that are declared before its own."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    model: Literal["fisheye"] | None = None
    width: Annotated[int, Field(ge=1)]
    height: Annotated[int, Field(ge=1)]
    fx: float
    fy: float
    cx: float
    cy: float
    skew: float = 0.0
    field_of_view_deg: float | None = None
    distortion: Annotated[tuple[float, ...] | None, Field(strict=False, validate_default=True)] = (
        None
    )

    @field_validator("fx", "fy", "cx", "cy")
    @classmethod
    def _is_in_pixels(cls, value: float, info: ValidationInfo) -> float:
        sides = [info.data.get("width", 0), info.data.get("height", 0)]
        side = sides[info.field_name == "cy"]
        if info.field_name in ("fx", "fy") and not value >= 0.1 * max(sides):
            raise ValueError(
                "expected the focal length in pixels, at least a tenth of the longer side of the "
                f"image ({max(sides)}), got {value:g}"
            )
        if info.field_name in ("cx", "cy") and side and not -side <= value <= 2 * side:
            raise ValueError(
                "expected the principal point in pixels, inside or near the image "
                f"({side} pixels), got {value:g}"
            )
        return value

    @field_validator("distortion")
    @classmethod
    def _is_a_lens(
        cls, values: tuple[float, ...] | None, info: ValidationInfo
    ) -> tuple[float, ...]:
        terms = _FISHEYE_TERMS if info.data.get("model") else _TERMS
        if info.data.get("field_of_view_deg") and not info.data.get("model"):
            raise ValueError("field_of_view_deg is only allowed with model: fisheye")
        values = values or (0.0,) * len(terms)
        if len(values) != len(terms):
            raise ValueError(
                f"expected the {len(terms)} numbers [{', '.join(terms)}], got {len(values)}; "
                "add 0 for terms that are not used; other lens models are not supported"
            )
        if len(info.data) == _FIELDS_ABOVE and (problem := _problem(_lens(info.data, values))):
            raise ValueError(
                f"{problem}; expected {', '.join(terms)} of a calibration that covers the whole "
                "image, or, for a fisheye, a smaller field_of_view_deg"
            )
        return values


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    cameras: Annotated[dict[str, _Lens], Field(min_length=1)]

    @field_validator("cameras", mode="before")
    @classmethod
    def _are_not_many(cls, values: object) -> object:
        if isinstance(values, dict) and len(values) > MOST_CAMERAS:
            raise ValueError(
                f"expected at most {MOST_CAMERAS} entries, got {len(values)}; use one entry with a "
                "pattern for all photos of a camera"
            )
        return values


_TERMS: Final = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE_TERMS: Final = ("k1", "k2", "k3", "k4")
_FIELDS_ABOVE: Final = len(_Lens.model_fields) - 1


def _lens(given: Mapping[str, Any], terms: tuple[float, ...]) -> Intrinsics | FisheyeLens:
    """Return the lens of an entry, in orthoflow's pixel convention."""
    pixels = {key: given[key] for key in _REQUIRED}
    pixels |= {key: pixels[key] + HALF_PIXEL for key in ("cx", "cy")}
    if not given["model"]:
        return Intrinsics(**pixels, distortion=terms, skew=given["skew"] or None)
    return FisheyeLens(
        **pixels,
        radial=terms,
        skew=given["skew"],
        field_of_view_deg=given["field_of_view_deg"] or WIDEST_DEG,
    )


def _problem(lens: Intrinsics | FisheyeLens) -> str:
    if isinstance(lens, Intrinsics):
        two = (
            "the lens distortion is not monotonic inside the image, so two directions share a pixel"
        )
        return two if _folds(lens) else ""
    problem = problem_of(lens)
    return f"the fisheye lens is invalid: {problem}" if problem else ""


def _folds(camera: Intrinsics) -> bool:
    """Return whether the lens model cannot be inverted in a part of the image."""
    sides = (np.linspace(0.0, side, 9) for side in (camera.width, camera.height))
    pixels = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    try:
        with np.errstate(all="ignore"):
            rays = camera.posed().rays_camera(pixels)
    except (GeometryError, np.linalg.LinAlgError):
        return True
    # The search may end beyond the fold, so check that the radius increases all the way to the ray.
    k1, k2, _, _, k3 = camera.distortion
    steps = np.linspace(0.0, float((rays[:, :2] ** 2).sum(axis=1).max()), 200)
    growth = 1.0 + steps * (3.0 * k1 + steps * (5.0 * k2 + steps * 7.0 * k3))
    return not bool((growth > 0.0).all())
