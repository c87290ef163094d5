"""What a camera wrote about a photo: how it was held, its lens, and the focal length in pixels.

Tags as in CIPA DC-008 (Exif 2.32). A damaged block gives what can still be read, never an error:
a photo is good without it.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Final

from orthoflow.files.containers import exif_block, image_format

# Diagonal of 36 x 24 mm. CIPA DCG-001 defines the 35 mm equivalent by equal angle over the
# diagonal, and the cameras we could check keep to it: a Redmi Note 9S (4.74 mm, sensor diagonal
# 8.0 mm) writes 26 where the diagonal gives 25.6 and the width 26.7; a Kodak C743 (6.0 mm, 7.18 mm)
# writes 36 where the diagonal gives 36.2 and the width 37.5. For 3:2 pictures both are the same.
FULL_FRAME_DIAGONAL_MM: Final = math.hypot(36.0, 24.0)

_ORIENTATION: Final = 0x0112
_MAKE: Final = 0x010F
_MODEL: Final = 0x0110
_EXIF_DIRECTORY: Final = 0x8769
_FOCAL_LENGTH: Final = 0x920A
_WIDTH: Final = 0xA002
_HEIGHT: Final = 0xA003
_RESOLUTION_X: Final = 0xA20E
_RESOLUTION_Y: Final = 0xA20F
_RESOLUTION_UNIT: Final = 0xA210
_FOCAL_LENGTH_35MM: Final = 0xA405

_UNIT_MM: Final = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_INCH: Final = 2
_TYPES: Final = {
    1: "B",
    3: "H",
    4: "I",
    5: "II",
    6: "b",
    8: "h",
    9: "i",
    10: "ii",
    11: "f",
    12: "d",
}
_TEXT: Final = 2
_MAX_ENTRIES: Final = 1000
_MAX_TEXT: Final = 200
# Longest side of sensors, from the smallest phone to large format scanning backs.
_SENSOR_MM: Final = (1.5, 130.0)
_CROPPED: Final = 0.02
_CONTRADICTION: Final = 1.15


@dataclass(frozen=True, kw_only=True)
class Exif:
    """What EXIF says of a photo; None, or an empty text, where it is silent.

    Attributes:
        orientation: 1..8, how to turn the stored array for looking at it.
        make: maker of the camera.
        model: model of the camera.
        focal_mm: focal length.
        focal_35mm: full-frame equivalent of it.
        resolution_px_per_mm: pixels of the picture as it was taken per millimetre of the sensor.
        width: pixels of the picture as it was taken; it may have been made smaller since.
        height: pixels.
        is_damaged: some of it could not be read.
    """

    orientation: int = 1
    make: str = ""
    model: str = ""
    focal_mm: float | None = None
    focal_35mm: float | None = None
    resolution_px_per_mm: float | None = None
    width: int | None = None
    height: int | None = None
    is_damaged: bool = False

    @property
    def camera(self) -> str:
        """Maker and model, the maker not said twice."""
        first_word = self.make.partition(" ")[0].lower()
        is_repeated = bool(first_word) and self.model.lower().startswith(first_word)
        return self.model if is_repeated else f"{self.make} {self.model}".strip()


@dataclass(frozen=True, kw_only=True)
class FocalLength:
    """A focal length from EXIF.

    Attributes:
        value_px: pixels of the stored array, or None when EXIF does not tell it.
        reason: what it was taken from, or why there is none.
    """

    value_px: float | None
    reason: str


def read_exif(encoded: bytes) -> Exif:
    """Read the EXIF data of a JPEG, PNG or TIFF file; without any, everything is absent."""
    block = exif_block(encoded)
    if block is None:
        return Exif()
    directories = _Directories(block)
    main = directories.read(directories.first_offset())
    inner = directories.read(main.number(_EXIF_DIRECTORY))
    orientation = int(main.positive(_ORIENTATION) or 1)
    return Exif(
        orientation=orientation if orientation <= 8 else 1,
        make=main.text(_MAKE),
        model=main.text(_MODEL),
        focal_mm=inner.positive(_FOCAL_LENGTH),
        focal_35mm=inner.positive(_FOCAL_LENGTH_35MM),
        resolution_px_per_mm=_resolution(inner),
        width=_whole(inner.positive(_WIDTH)),
        height=_whole(inner.positive(_HEIGHT)),
        is_damaged=directories.is_damaged,
    )


def focal_length(exif: Exif, width: int, height: int) -> FocalLength:
    """Focal length of a photo in pixels of its stored array.

    The pixel pitch of the focal plane comes first, as it is exact where it is right; it follows
    the picture when that was made smaller or turned since. It is left when it contradicts the
    35 mm equivalent, which does not depend on the size of the picture. That one is taken over the
    diagonal, see `FULL_FRAME_DIAGONAL_MM`.

    Args:
        exif: what EXIF says.
        width: pixels of the stored array.
        height: pixels.
    """
    if exif.focal_mm is None and exif.focal_35mm is None:
        return FocalLength(value_px=None, reason="no EXIF focal length")
    if _is_cropped(exif, width, height):
        return FocalLength(
            value_px=None,
            reason=f"the photo was cut after it was taken ({exif.width} x {exif.height} became "
            f"{width} x {height}), so EXIF no longer speaks of it",
        )
    by_pitch = _by_pitch(exif, max(width, height))
    by_equivalent = (
        None
        if exif.focal_35mm is None
        else exif.focal_35mm / FULL_FRAME_DIAGONAL_MM * math.hypot(width, height)
    )
    if by_pitch is not None and not _contradict(by_pitch, by_equivalent):
        return FocalLength(value_px=by_pitch, reason="pixel pitch of the focal plane")
    if by_equivalent is not None:
        return FocalLength(value_px=by_equivalent, reason="35 mm equivalent over the diagonal")
    return FocalLength(
        value_px=None,
        reason=f"EXIF says {exif.focal_mm:g} mm but neither the pixel pitch nor the 35 mm "
        "equivalent",
    )


def without_orientation(encoded: bytes) -> bytes:
    """Give a TIFF file with its orientation set to 1; anything else unchanged.

    OpenCV turns TIFF images by that tag even when it is asked not to.
    """
    if image_format(encoded) != "TIFF":
        return encoded
    directories = _Directories(encoded)
    main = directories.read(directories.first_offset())
    if main.number(_ORIENTATION) in (None, 1):
        return encoded
    place = main.places[_ORIENTATION]
    one = struct.pack(directories.order + "H", 1)
    return encoded[:place] + one + encoded[place + 2 :]


def _is_cropped(exif: Exif, width: int, height: int) -> bool:
    if exif.width is None or exif.height is None:
        return False
    taken = max(exif.width, exif.height) / min(exif.width, exif.height)
    stored = max(width, height) / min(width, height)
    # One pixel of rounding more than the share, for pictures that were made very small.
    return abs(taken / stored - 1.0) > _CROPPED + 1.0 / min(width, height)


def _by_pitch(exif: Exif, longest_px: int) -> float | None:
    if exif.focal_mm is None or exif.resolution_px_per_mm is None:
        return None
    taken_px = max(exif.width or 0, exif.height or 0) or longest_px
    smallest, largest = _SENSOR_MM
    if not smallest <= taken_px / exif.resolution_px_per_mm <= largest:
        return None
    return exif.focal_mm * exif.resolution_px_per_mm * longest_px / taken_px


def _contradict(one: float, other: float | None) -> bool:
    return other is not None and max(one / other, other / one) > _CONTRADICTION


def _whole(value: float | None) -> int | None:
    return None if value is None else int(value)


def _resolution(directory: _Directory) -> float | None:
    """Pixels per millimetre, the mean of both axes where both are said."""
    unit_mm = _UNIT_MM.get(int(directory.positive(_RESOLUTION_UNIT) or _INCH))
    said = [directory.positive(tag) for tag in (_RESOLUTION_X, _RESOLUTION_Y)]
    known = [value for value in said if value is not None]
    if unit_mm is None or not known:
        return None
    return math.fsum(known) / len(known) / unit_mm


@dataclass(frozen=True, kw_only=True)
class _Directory:
    """Tags of one directory: first value of each, and where it lies in the block."""

    values: dict[int, float | str]
    places: dict[int, int]

    def number(self, tag: int) -> float | None:
        value = self.values.get(tag)
        return None if isinstance(value, str) else value

    def positive(self, tag: int) -> float | None:
        value = self.number(tag)
        return value if value is not None and 0.0 < value < math.inf else None

    def text(self, tag: int) -> str:
        value = self.values.get(tag)
        return value if isinstance(value, str) else ""


class _Directories:
    """Reads directories of a TIFF structure; what lies outside the block counts as damage."""

    def __init__(self, block: bytes) -> None:
        self.block = block
        self.order = ">" if block[:2] == b"MM" else "<"
        self.is_damaged = False

    def first_offset(self) -> float | None:
        if self.block[:2] not in (b"II", b"MM"):
            self.is_damaged = True
            return None
        return self._unpack("I", 4)

    def read(self, offset: float | None) -> _Directory:
        directory = _Directory(values={}, places={})
        count = None if offset is None else self._unpack("H", int(offset))
        if offset is None or count is None:
            return directory
        if count > _MAX_ENTRIES:
            self.is_damaged = True
            return directory
        for index in range(int(count)):
            self._read_entry(int(offset) + 2 + 12 * index, directory)
        return directory

    def _read_entry(self, offset: int, directory: _Directory) -> None:
        header = self._slice(offset, 12)
        if header is None:
            return
        tag, kind, count = struct.unpack(self.order + "HHI", header[:8])
        layout = f"{count}s" if kind == _TEXT else _TYPES.get(kind)
        if layout is None or count == 0 or (kind == _TEXT and count > _MAX_TEXT):
            return
        size = struct.calcsize("=" + layout) * (1 if kind == _TEXT else count)
        place = offset + 8 if size <= 4 else int(struct.unpack(self.order + "I", header[8:])[0])
        value = self._text(place, count) if kind == _TEXT else self._unpack(layout, place)
        if value is not None:
            directory.values[tag] = value
            directory.places[tag] = place

    def _text(self, place: int, count: int) -> str | None:
        raw = self._slice(place, count)
        return None if raw is None else raw.split(b"\0")[0].decode("ascii", "replace").strip()

    def _unpack(self, layout: str, place: int) -> float | None:
        raw = self._slice(place, struct.calcsize("=" + layout))
        if raw is None:
            return None
        numbers = struct.unpack(self.order + layout, raw)
        if len(numbers) == 1:
            return float(numbers[0])
        return float(numbers[0] / numbers[1]) if numbers[1] else None

    def _slice(self, start: int, length: int) -> bytes | None:
        if start < 0 or start + length > len(self.block):
            self.is_damaged = True
            return None
        return self.block[start : start + length]
