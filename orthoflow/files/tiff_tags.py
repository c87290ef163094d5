"""Tags of TIFF directories, which EXIF blocks have as well; Pillow reads them, damaged ones too."""

from __future__ import annotations

import io
import math
import warnings
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

# By the mark of the byte order: as `struct` has that, and what begins a TIFF file.
_ORDERS: Final = {b"II": ("<", b"II*\x00"), b"MM": (">", b"MM\x00*")}
_BYTE: Final = 1
_UNDEFINED: Final = 7
_MAX_ENTRIES: Final = 1000
_MAX_TEXT: Final = 200


@dataclass(frozen=True, kw_only=True)
class Directory:
    """Tags of one directory; what cannot be read is absent.

    Attributes:
        entries: Pillow's directory, or None when there is none.
        start: where it begins in the block.
        order: byte order, as `struct` has it.
        is_damaged: something lies outside the block, or makes no sense.
    """

    entries: ImageFileDirectory_v2 | None = None
    start: int = 0
    order: str = "<"
    is_damaged: bool = False

    def number(self, tag: int) -> float | None:
        """Number of a tag, the first one where it has several, where it is finite and positive."""
        value = self._value(tag)
        if isinstance(value, bytes) and self._kind(tag) == _BYTE:
            value = tuple(value)
        first = value[0] if isinstance(value, tuple) and value else value
        number = float(first) if isinstance(first, Real) else math.nan
        return number if 0.0 < number < math.inf else None

    def text(self, tag: int) -> str:
        """Text of a tag up to its first NUL; empty where it is absent, long or a number."""
        value = self._value(tag)
        if not isinstance(value, str) or len(value) >= _MAX_TEXT:
            return ""
        # Pillow takes them for Latin-1, but these texts are ASCII.
        plain = value.encode("latin-1", "replace").decode("ascii", "replace")
        return plain.split("\0")[0].strip()

    def content(self, tag: int) -> bytes | None:
        """Bytes of a tag; None where they are absent or not in the block."""
        value = self._value(tag) if self._kind(tag) in (_BYTE, _UNDEFINED) else None
        # What is missing has been read as zeros.
        return value if isinstance(value, bytes) and value.count(0) < len(value) else None

    def _kind(self, tag: int) -> int | None:
        return None if self.entries is None else self.entries.tagtype.get(tag)

    def _value(self, tag: int) -> object:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # more values than the tag should have
            return None if self.entries is None else self.entries.get(tag)


def read_directory(block: bytes, start: int | None = None, *, most_bytes: int) -> Directory:
    """Read a directory of a TIFF structure.

    Args:
        block: a TIFF file or the block of EXIF data.
        start: where the directory begins; None for the first one.
        most_bytes: so many may all its values have together; what comes later is left out, as a
            small file can point to itself a thousand times.
    """
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    if block[:2] not in _ORDERS or len(block) < 8:
        return Directory(is_damaged=True)
    order, head = _ORDERS[block[:2]]
    entries = ImageFileDirectory_v2(head + block[4:8])
    begins = entries.next if start is None else start
    count = int.from_bytes(block[begins : begins + 2], "little" if order == "<" else "big")
    if begins + 2 > len(block) or count > _MAX_ENTRIES:
        return Directory(is_damaged=True)
    source = _Source(block, most_bytes)
    source.seek(begins)
    with warnings.catch_warnings(record=True) as noticed:
        warnings.simplefilter("always")
        entries.load(source)
    is_larger_than_block = bool(noticed) and len(block) < most_bytes
    return Directory(
        entries=entries,
        start=begins,
        order=order,
        is_damaged=source.is_short or is_larger_than_block,
    )


class _Source(io.BytesIO):
    """A block that gives zeros for what it lacks: one bad place does not end the reading."""

    def __init__(self, block: bytes, most_bytes: int) -> None:
        super().__init__(block)
        self.most_bytes = most_bytes
        self.is_short = False

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        # Pillow asks for the end to know how much all values together may have.
        return super().seek(self.most_bytes if whence == io.SEEK_END else offset)

    def read(self, size: int | None = None) -> bytes:
        assert size is not None  # noqa: S101 - Pillow says how much it wants
        found = super().read(size)
        self.is_short |= len(found) < size
        return found if len(found) == size else bytes(size)
