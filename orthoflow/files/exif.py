"""What a camera wrote about a photo: how it was held, its lens, and the focal length in pixels.

Tags as in CIPA DC-008 (Exif 2.32). A damaged block gives what can still be read, never an error:
a photo is good without it.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from numbers import Real
from typing import TYPE_CHECKING, Final

from orthoflow.files.containers import opened

if TYPE_CHECKING:
    from PIL.Image import Exif as PillowExif
    from PIL.Image import Image

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

_DIGITAL_ZOOM: Final = 0xA404

_TAGS: Final = frozenset(
    {_ORIENTATION, _MAKE, _MODEL, _FOCAL_LENGTH, _FOCAL_LENGTH_35MM, _DIGITAL_ZOOM}
    | {_WIDTH, _HEIGHT, _RESOLUTION_X, _RESOLUTION_Y, _RESOLUTION_UNIT}
)
_MAX_TEXT: Final = 200
# As long as an EXIF block may be.
_PADDING: Final = 1 << 16
_UNIT_MM: Final = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_INCH: Final = 2
# Longest side of sensors, from the smallest phone to large format scanning backs.
_SENSOR_MM: Final = (1.5, 130.0)
# From fisheyes to telescopes, in front of any sensor; cameras that do not know write 0, 1 or 65535.
_FOCAL_MM: Final = (0.5, 3000.0)
_EQUIVALENT_MM: Final = (4.0, 3000.0)
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
        digital_zoom: by how much the picture was enlarged; 1 without.
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
    digital_zoom: float | None = None
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
        doubt: what EXIF says that cannot be and was not used; empty without such.
    """

    value_px: float | None
    reason: str
    doubt: str = ""


def read_exif(encoded: bytes) -> Exif:
    """Read the EXIF data of a photo; without any, everything is absent."""
    with opened(encoded) as image:
        if image is None:
            return Exif()
        found, is_damaged = _tags(image)
    return Exif(
        orientation=_orientation(_number(found.get(_ORIENTATION))),
        make=_text(found.get(_MAKE)),
        model=_text(found.get(_MODEL)),
        focal_mm=_number(found.get(_FOCAL_LENGTH)),
        focal_35mm=_number(found.get(_FOCAL_LENGTH_35MM)),
        digital_zoom=_number(found.get(_DIGITAL_ZOOM)),
        resolution_px_per_mm=_resolution(found),
        width=_whole(_number(found.get(_WIDTH))),
        height=_whole(_number(found.get(_HEIGHT))),
        is_damaged=is_damaged,
    )


def _tags(image: Image) -> tuple[Mapping[int, object], bool]:
    """The tags that count, and whether the block is damaged, which gives what is left of it."""
    block = image.info.get("exif")
    if not isinstance(block, bytes):
        return _readable_tags(image.getexif)
    found, is_damaged = _readable_tags(lambda: _loaded(block))
    if is_damaged:
        # Zeros stand for what is missing, so that one bad place does not end the reading.
        found = _readable_tags(lambda: _loaded(block + bytes(_PADDING)))[0] | found
    return found, is_damaged


def _loaded(block: bytes) -> PillowExif:
    from PIL.Image import Exif as PillowExif

    exif = PillowExif()
    exif.load(block)
    return exif


def _readable_tags(read: Callable[[], PillowExif]) -> tuple[dict[int, object], bool]:
    """Tags of the main and of the inner directory, and whether some could not be read."""
    tags: dict[int, object] = {}
    is_damaged = False
    with warnings.catch_warnings(record=True) as noticed:
        warnings.simplefilter("always")
        try:
            main = read()
            directories: list[Callable[[], Mapping[int, object]]] = [
                lambda: main,
                lambda: main.get_ifd(_EXIF_DIRECTORY),
            ]
            for directory in directories:
                content = directory()
                for tag in _TAGS & set(content):
                    tags[tag] = content[tag]
        except Exception:  # noqa: BLE001 - Pillow raises whatever its parsing of damaged tags meets
            is_damaged = True
    return tags, is_damaged or bool(noticed)


def focal_length(exif: Exif, width: int, height: int) -> FocalLength:
    """Focal length of a photo in pixels of its stored array.

    The pixel pitch of the focal plane comes first, as it is exact where it is right; it follows
    the picture when that was made smaller or turned since. It is left when it contradicts the
    35 mm equivalent, which does not depend on the size of the picture. That one is taken over the
    diagonal, see `FULL_FRAME_DIAGONAL_MM`. What no lens has is told and not used.

    Args:
        exif: what EXIF says.
        width: pixels of the stored array.
        height: pixels.
    """
    of_length = _doubt("focal length", exif.focal_mm, _FOCAL_MM)
    of_equivalent = _doubt("35 mm equivalent", exif.focal_35mm, _EQUIVALENT_MM)
    doubt = "; ".join(filter(None, (of_length, of_equivalent)))
    believed = replace(
        exif,
        focal_mm=None if of_length else exif.focal_mm,
        focal_35mm=None if of_equivalent else exif.focal_35mm,
    )
    found = _believed_focal_length(believed, width, height)
    reason = doubt if found.value_px is None and doubt else found.reason
    return FocalLength(value_px=found.value_px, reason=reason, doubt=doubt)


def _doubt(what: str, value_mm: float | None, possible_mm: tuple[float, float]) -> str:
    """Say that a value cannot be; empty when it can, or is absent."""
    shortest, longest = possible_mm
    if value_mm is None or shortest <= value_mm <= longest:
        return ""
    return (
        f"EXIF says a {what} of {value_mm:g} mm, which no lens has ({shortest:g} to {longest:g} mm)"
    )


def _believed_focal_length(exif: Exif, width: int, height: int) -> FocalLength:
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


def _number(value: object) -> float | None:
    """Number of a tag, the first one where it has several, where it is finite and positive."""
    if isinstance(value, bytes):
        value = tuple(value)
    first = value[0] if isinstance(value, tuple) and value else value
    number = float(first) if isinstance(first, Real) else math.nan
    return number if 0.0 < number < math.inf else None


def _text(value: object) -> str:
    """Text of a tag up to its first NUL; empty where it is absent, long or a number."""
    if not isinstance(value, str) or len(value) >= _MAX_TEXT:
        return ""
    # Pillow takes them for Latin-1, but these texts are ASCII.
    plain = value.encode("latin-1", "replace").decode("ascii", "replace")
    return plain.split("\0")[0].strip()


def _orientation(number: float | None) -> int:
    return int(number) if number is not None and 1.0 <= number < 9.0 else 1


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
    return int(value) if value is not None and value >= 1.0 else None


def _resolution(tags: Mapping[int, object]) -> float | None:
    """Pixels per millimetre, the mean of both axes where both are there."""
    unit_mm = _UNIT_MM.get(int(_number(tags.get(_RESOLUTION_UNIT)) or _INCH))
    known = [
        value
        for tag in (_RESOLUTION_X, _RESOLUTION_Y)
        if (value := _number(tags.get(tag))) is not None
    ]
    if unit_mm is None or not known:
        return None
    return math.fsum(known) / len(known) / unit_mm
