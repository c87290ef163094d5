"""The calibration file: cameras by photo name or pattern, in OpenCV's model and pixel convention.

```yaml
cameras:
  "IMG_00*.jpg": {width: 6000, height: 4000, fx: 4210.5, fy: 4211.2, cx: 2996.1, cy: 2003.7,
                  distortion: [-0.08, 0.05, 0.0002, -0.0001, 0.0]}
  "GOPR*": {model: fisheye, width: 4000, height: 3000, fx: 1750.0, fy: 1750.0, cx: 1999.5,
            cy: 1499.5, distortion: [0.04, 0.01, -0.01, 0.002]}
  "*": {width: 4000, height: 3000, fx: 3004.2, fy: 3004.2, cx: 1999.5, cy: 1499.5}
```

The first entry that matches a photo holds. Of `model: fisheye` (`cv2.fisheye`) the distortion is
k1, k2, k3, k4, and `field_of_view_deg` the whole angle to use, 180 where it is missing. Pixels in
the file count from the centre of the first pixel; inside, that centre is at (0.5, 0.5), and only
this module converts.
"""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final, TypedDict

import numpy as np

from orthoflow.errors import GeometryError, InputError
from orthoflow.files.fisheyes import WIDEST_DEG, FisheyeLens, problem_of
from orthoflow.files.regular_files import text_of_file
from orthoflow.files.sidecars import write_text
from orthoflow.files.yaml_positions import (
    Dialect,
    Entry,
    Listing,
    Position,
    Table,
    Text,
    Value,
    describe,
    plain,
    read_yaml,
)
from orthoflow.geometry.opencv_border import HALF_PIXEL
from orthoflow.products import Calibration, Intrinsics

# Some seconds of parsing; a calibration of a thousand cameras has about 150 kB.
MOST_BYTES: Final = 400_000
MOST_CAMERAS: Final = 1000
MOST_VALUES: Final = 20_000
_SIZES: Final = ("width", "height")
_FOCALS: Final = ("fx", "fy")
_CENTRES: Final = ("cx", "cy")
_DISTORTION: Final = "distortion"
_SKEW: Final = "skew"
_REQUIRED: Final = (*_SIZES, *_FOCALS, *_CENTRES)
_TERMS: Final = ("k1", "k2", "p1", "p2", "k3")
_MODEL: Final = "model"
_FISHEYE: Final = "fisheye"
_FIELD: Final = "field_of_view_deg"
_FISHEYE_TERMS: Final = ("k1", "k2", "k3", "k4")
_COUNTED: Final = {4: "four", 5: "five"}
_START: Final = Position(line=1, column=1)
_DIALECT: Final = Dialect(
    is_strict=False,
    most_values=MOST_VALUES,
    empty="the calibration file is empty",
    duplicate='found duplicate key "{key}"; remove one of them',
)


@dataclass(frozen=True, kw_only=True)
class CalibratedLenses:
    """What a calibration file says; the first pattern that matches a photo holds.

    Attributes:
        patterns: photo names or shell patterns.
        lenses: one per pattern.
    """

    patterns: tuple[str, ...]
    lenses: tuple[Intrinsics | FisheyeLens, ...]


def read_calibration(path: Path) -> CalibratedLenses:
    """Read a calibration file.

    Raises:
        InputError: the file cannot be used; one line per problem, `file:line:column: ...`.
    """
    reader = _Reader(path.name)
    calibration = reader.read(
        text_of_file(
            path,
            MOST_BYTES,
            "a calibration file (YAML)",
            way_out=": give photos of one camera one entry, by a pattern",
        )
    )
    if calibration is None or reader.problems:
        raise InputError("\n".join(problem for _, problem in sorted(reader.problems)))
    return calibration


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration file that `read_calibration` reads.

    Raises:
        StoreError: the file cannot be written.
    """
    write_text(path, calibration_text(calibration))


def calibration_text(calibration: Calibration) -> str:
    """Give the content of a calibration file."""
    lines = [
        "# Pixels as OpenCV counts them: the centre of the first pixel is (0, 0).",
        "# distortion: k1, k2, p1, p2, k3. The first entry that matches a photo's name holds.",
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
            _DISTORTION: list(camera.distortion),
            **({_SKEW: camera.skew} if camera.skew else {}),
        }
        lines.append(f"  {json.dumps(pattern, ensure_ascii=False)}:")
        lines += [f"    {key}: {json.dumps(value)}" for key, value in values.items()]
    return "\n".join(lines) + "\n"


def matching_pattern(patterns: Sequence[str], photo_name: str) -> str | None:
    """Return the first pattern that is the photo's name, or matches it as in a shell.

    The case of letters counts. A name that holds brackets matches itself, and a name with folders
    is also matched without them.
    """
    names = (photo_name, photo_name.rpartition("/")[2])
    for pattern in patterns:
        if pattern in names or any(fnmatchcase(name, pattern) for name in names):
            return pattern
    return None


def lens_for(
    calibration: CalibratedLenses, photo_name: str, width: int, height: int
) -> Intrinsics | FisheyeLens | None:
    """Give the calibrated lens of a photo; None when no entry matches its name.

    Args:
        calibration: the calibrated lenses.
        photo_name: file name of the photo.
        width: pixels of its stored array.
        height: pixels.

    Raises:
        InputError: the photo has another size than the calibration.
    """
    pattern = matching_pattern(calibration.patterns, photo_name)
    if pattern is None:
        return None
    camera = calibration.lenses[calibration.patterns.index(pattern)]
    if (camera.width, camera.height) == (width, height):
        return camera
    way_out = (
        "it seems to be for the turned photo: calibrate the pixels as they are stored, without "
        "the EXIF rotation, or give photos that are stored upright an entry of their own"
        if (camera.width, camera.height) == (height, width)
        else "calibrate at the size of the photos, or give this one an entry of its own"
    )
    raise InputError(
        f'photo {photo_name} has {width} x {height} pixels, but its calibration "{pattern}" is '
        f"for {camera.width} x {camera.height}; {way_out}"
    )


class _Pixels(TypedDict):
    """What lenses of all models say of their pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


def _pixels(sizes: Mapping[str, int], numbers: Mapping[str, float]) -> _Pixels:
    return _Pixels(
        width=sizes["width"],
        height=sizes["height"],
        fx=numbers["fx"],
        fy=numbers["fy"],
        cx=numbers["cx"] + HALF_PIXEL,
        cy=numbers["cy"] + HALF_PIXEL,
    )


class _Reader:
    """Turns the text into cameras and collects everything that is wrong with it."""

    def __init__(self, file_name: str) -> None:
        self.file_name = file_name
        self.problems: list[tuple[Position, str]] = []

    def read(self, text: str) -> CalibratedLenses | None:
        document = read_yaml(text, self, _DIALECT)
        if document is None:
            return None
        if isinstance(document, Text) and document.value is None:
            self._add(_START, _DIALECT.empty)
            return None
        section = document.get("cameras") if isinstance(document, Table) else None
        if not isinstance(document, Table) or section is None:
            self._add(
                _START,
                "expected the key cameras with one entry per photo name or pattern, as cameras: "
                f"{{'*': {{{', '.join(f'{key}: ...' for key in _REQUIRED)}}}}}",
            )
            return None
        self._refuse_unknown(document, ("cameras",), "")
        if not isinstance(section.value, Table) or not section.value.entries:
            self._add(section.position, "cameras: expected one entry per photo name or pattern")
            return None
        n_cameras = len(section.value.entries)
        if n_cameras > MOST_CAMERAS:
            self._add(
                section.position,
                f"cameras: expected at most {MOST_CAMERAS} entries, got {n_cameras}; give photos "
                "of one camera one entry, by a pattern",
            )
            return None
        cameras: dict[str, Intrinsics | FisheyeLens] = {}
        for entry in section.value:
            camera = self._camera(entry)
            if camera is not None:
                cameras[entry.key] = camera
        return CalibratedLenses(patterns=tuple(cameras), lenses=tuple(cameras.values()))

    def add(self, position: Position, path: str, message: str) -> None:
        """Keep a problem of the YAML; places are told by line and column."""
        del path
        self._add(position, message)

    def _camera(self, entry: Entry) -> Intrinsics | FisheyeLens | None:
        name, values = entry.key, entry.value
        if not entry.is_text:
            self._add(
                entry.position, f'cameras: a photo name must be text, got {name}; write "{name}"'
            )
            return None
        path = f'cameras."{name}"'
        if not isinstance(values, Table):
            self._add(entry.position, f"{path}: expected {', '.join(_REQUIRED)} [, {_DISTORTION}]")
            return None
        n_before = len(self.problems)
        given = {item.key: item for item in values}
        is_fisheye = self._is_fisheye(given.get(_MODEL), path)
        more = (_MODEL, _FIELD) if is_fisheye else (_MODEL,)
        self._refuse_unknown(values, (*_REQUIRED, _DISTORTION, _SKEW, *more), path + ".")
        missing = [key for key in _REQUIRED if key not in given]
        if missing:
            self._add(entry.position, f"{path}: {', '.join(missing)} missing")
        sizes: dict[str, int] = {
            key: self._size(given[key], path) for key in _SIZES if key in given
        }
        numbers: dict[str, float] = {
            key: self._number(given[key], f"{path}.{key}", given[key].value)
            for key in (*_FOCALS, *_CENTRES, _SKEW, _FIELD)
            if key in given
        }
        terms = _FISHEYE_TERMS if is_fisheye else _TERMS
        distortion = self._distortion(given.get(_DISTORTION), path, terms)
        if len(self.problems) == n_before:
            self._check_pixels(given, path, sizes, numbers)
        if len(self.problems) > n_before:
            return None
        if is_fisheye:
            return self._fisheye(entry, sizes, numbers, distortion)
        camera = Intrinsics(
            **_pixels(sizes, numbers), distortion=distortion, skew=numbers.get(_SKEW) or None
        )
        if _folds(camera):
            self._add(
                given[_DISTORTION].position,
                f"{path}.{_DISTORTION}: the lens model folds back inside the image, so that two "
                "directions share a pixel; expected k1, k2, p1, p2, k3 of a calibration that "
                "covers the whole image",
            )
        return camera

    def _fisheye(
        self,
        entry: Entry,
        sizes: Mapping[str, int],
        numbers: Mapping[str, float],
        radial: tuple[float, ...],
    ) -> FisheyeLens | None:
        lens = FisheyeLens(
            **_pixels(sizes, numbers),
            radial=radial,
            skew=numbers.get(_SKEW, 0.0),
            field_of_view_deg=numbers.get(_FIELD, WIDEST_DEG),
        )
        problem = problem_of(lens)
        if problem:
            self._add(
                entry.position,
                f'cameras."{entry.key}": the fisheye lens is none: {problem}; expected '
                f"{', '.join(_FISHEYE_TERMS)} of a calibration that covers the image, or a smaller "
                f"{_FIELD}",
            )
        return None if problem else lens

    def _is_fisheye(self, entry: Entry | None, path: str) -> bool:
        if entry is None:
            return False
        value = plain(entry.value)
        if value != _FISHEYE:
            self._add(
                entry.position,
                f"{path}.{_MODEL}: expected {_FISHEYE}, or no {_MODEL} for other lenses, got "
                f"{describe(entry.value)}",
            )
        return bool(value == _FISHEYE)

    def _size(self, entry: Entry, path: str) -> int:
        value = plain(entry.value)
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            self._add(
                entry.position,
                f"{path}.{entry.key}: expected a whole number of pixels, got {value}",
            )
            return 0
        return value

    def _number(self, entry: Entry, path: str, value: Value) -> float:
        given = value.value if isinstance(value, Text) else None
        is_number = isinstance(given, int | float) and not isinstance(given, bool)
        # Through text: whole numbers may be larger than a float can be.
        number = float(str(given)) if is_number else math.nan
        if not math.isfinite(number):
            got = describe(value) if isinstance(value, Text) else "a list or mapping"
            self._add(entry.position, f"{path}: expected a number, got {got}")
            return 0.0
        return number

    def _distortion(
        self, entry: Entry | None, path: str, terms: Sequence[str]
    ) -> tuple[float, ...]:
        path = f"{path}.{_DISTORTION}"
        if entry is None:
            return (0.0,) * len(terms)
        values = entry.value
        if not isinstance(values, Listing) or len(values.items) != len(terms):
            got = f"{len(values.items)} values" if isinstance(values, Listing) else describe(values)
            self._add(
                entry.position,
                f"{path}: expected the {_COUNTED[len(terms)]} numbers [{', '.join(terms)}], got "
                f"{got}; fill up with 0, other lens models are not read",
            )
            return ()
        return tuple(
            self._number(entry, f"{path}[{index}]", value)
            for index, value in enumerate(values.items)
        )

    def _check_pixels(
        self,
        given: Mapping[str, Entry],
        path: str,
        sizes: Mapping[str, int],
        numbers: Mapping[str, float],
    ) -> None:
        """Refuse what looks like millimetres, or like another image."""
        longest = max(sizes.values())
        for key in _FOCALS:
            if key in numbers and not numbers[key] >= 0.1 * longest:
                self._add(
                    given[key].position,
                    f"{path}.{key}: expected the focal length in pixels, at least a tenth of the "
                    f"image's {longest}, got {numbers[key]:g}",
                )
        for key, side in zip(_CENTRES, _SIZES, strict=True):
            if not -sizes[side] <= numbers[key] <= 2 * sizes[side]:
                self._add(
                    given[key].position,
                    f"{path}.{key}: expected the principal point in pixels, in or near the "
                    f"image's {sizes[side]}, got {numbers[key]:g}",
                )

    def _refuse_unknown(self, table: Table, known: Collection[str], path: str) -> None:
        for entry in table:
            if entry.key not in known:
                near = difflib.get_close_matches(entry.key, known, n=1)
                hint = f" (did you mean {near[0]}?)" if near else ""
                if entry.key.isdecimal():
                    hint = ", what a decimal comma leaves behind: write decimal points"
                self._add(
                    entry.position,
                    f"{path}{entry.key}: unknown key{hint}; expected {', '.join(known)}",
                )

    def _add(self, place: Position, message: str) -> None:
        self.problems.append((place, f"{self.file_name}:{place.line}:{place.column}: {message}"))


def _folds(camera: Intrinsics) -> bool:
    """Whether the lens model cannot be undone somewhere in the image."""
    sides = (np.linspace(0.0, side, 9) for side in (camera.width, camera.height))
    pixels = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    try:
        with np.errstate(all="ignore"):
            rays = camera.posed().rays_camera(pixels)
    except (GeometryError, np.linalg.LinAlgError):
        return True
    # The search may end on the far side of the fold: the radius must grow all the way to the ray.
    k1, k2, _, _, k3 = camera.distortion
    steps = np.linspace(0.0, float((rays[:, :2] ** 2).sum(axis=1).max()), 200)
    growth = 1.0 + steps * (3.0 * k1 + steps * (5.0 * k2 + steps * 7.0 * k3))
    return not bool((growth > 0.0).all())
