"""The pages of an E57 file, 1020 bytes and a checksum each, taken apart and put together again."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

_PAGE: Final = 1024
_PAYLOAD: Final = 1020
_CASTAGNOLI: Final = 0x82F63B78


@dataclass(frozen=True, kw_only=True)
class LogicalE57:
    """An E57 file without its checksums.

    Attributes:
        binary: header and binary sections.
        xml: what stands behind them.
    """

    binary: bytes
    xml: bytes


def logical_of(content: bytes) -> LogicalE57:
    """Take the checksums out of a valid file."""
    plain = b"".join(content[at : at + _PAYLOAD] for at in range(0, len(content), _PAGE))
    physical, length = struct.unpack_from("<QQ", content, 24)
    start = physical // _PAGE * _PAYLOAD + physical % _PAGE
    return LogicalE57(binary=plain[:start], xml=plain[start : start + length])


def e57_of(binary: bytes, xml: bytes) -> bytes:
    """Put a file together: header and checksums fit, whatever the content."""
    start = len(binary)
    plain = binary + xml
    plain += bytes(-len(plain) % _PAYLOAD)
    n_pages = len(plain) // _PAYLOAD
    physical = start // _PAYLOAD * _PAGE + start % _PAYLOAD
    plain = plain[:16] + struct.pack("<QQQ", n_pages * _PAGE, physical, len(xml)) + plain[40:]
    pages = [plain[at : at + _PAYLOAD] for at in range(0, len(plain), _PAYLOAD)]
    return b"".join(page + struct.pack(">I", crc32c(page)) for page in pages)


def crc32c(data: bytes) -> int:
    """CRC-32C, as the standard has it for each page."""
    value = 0xFFFFFFFF
    for byte in data:
        value = _TABLE[(value ^ byte) & 255] ^ (value >> 8)
    return value ^ 0xFFFFFFFF


def _entry(value: int) -> int:
    for _ in range(8):
        value = (value >> 1) ^ (_CASTAGNOLI if value & 1 else 0)
    return value


_TABLE: Final = tuple(_entry(value) for value in range(256))
