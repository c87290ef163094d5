"""Small valid files made wrong: bytes, numbers, lines and structures changed at random places.

Everything follows from the generator that is passed in, so that a case can be had again.
"""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from random import Random
from typing import Any, Final, TypeAlias

# Content, the generator, and other valid files of the same reader to take pieces from.
Mutate: TypeAlias = Callable[[bytes, Random, Sequence[bytes]], bytes]

_MOST_ROUNDS: Final = 4
_LARGEST: Final = 1 << 20
_HEADER_BYTES: Final = 512
_NUMBER: Final = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_NUMBERS: Final = (
    *(b"0", b"-1", b"-0.0", b"1", b"255", b"256", b"65535", b"65536", b"2147483647"),
    *(b"-2147483648", b"4294967295", b"4294967296", b"9223372036854775807"),
    *(b"-9223372036854775809", b"18446744073709551616", b"1e9", b"1e30", b"-1e30", b"1e308"),
    *(b"1e309", b"-1e309", b"1e-320", b"nan", b"-nan", b"inf", b"-inf", b"NaN", b"Infinity"),
    *(b".inf", b".nan", b"0x7fffffff", b"0o17", b"1_000", b"1,5", b"1.2.3", b"--1", b"true"),
    *(b"false", b"null", b"", b"~", b'""', b"[]", b"{}", b"9" * 5000, b"1e" + b"9" * 400),
)
_FRAGMENTS: Final = (
    *(b"\0", b"\n", b"\r", b"\t", b"\xff\xfe", b"\xef\xbb\xbf", b"\xed\xa0\x80", b"\x1b[2J"),
    *("\u202e".encode(), "\u2028".encode(), "\U0001f4a5".encode(), b"\\ud800", b"\\u0000"),
    *(b"[" * 60, b"[" * 50_000, b"{" * 200, b'{"a":' * 3000, b"- " * 200, b"&a ", b"*a "),
    *(b"<<: *a", b"&a [*a, *a, *a]", b"!!python/object:os.system ", b"? ", b": ", b"|\n", b">-\n"),
    *(b"%YAML 1.1\n", b"---\n", b"...\n", b"#", b"'", b'"', b",", b";", b"}", b"]"),
    *(b"../../outside", b"/etc/passwd", b"<!DOCTYPE a [<!ENTITY b 'c'>]>", b"&b;", b"<a>" * 500),
    *(b"</a>", b"]]>", b"x" * 20_000),
)
# (format, values) of numbers as they lie in binary files.
_BINARY: Final = (
    ("B", (0, 1, 127, 128, 255)),
    ("H", (0, 1, 32767, 32768, 65535)),
    ("I", (0, 1, 255, 65536, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)),
    ("Q", (0, 1, 2**31, 2**32, 2**40, 2**63 - 1, 2**63, 2**64 - 1)),
    ("f", (0.0, -1.0, 1e30, float("nan"), float("inf"), 1e-40)),
    ("d", (0.0, -1.0, 1e30, 1e308, float("nan"), float("inf"), -float("inf"), 5e-324)),
)


# Documents with more places than a thousand copies of one make are not multiplied again, and what
# a place is replaced by is put in as often as makes this many bytes.
_MANY_PLACES: Final = 500
_LONGEST: Final = 20_000_000


def mutate_bytes(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    """Change a binary file, its first bytes as often as all the others."""
    return _in_rounds(content, rng, others, _BYTE_STEPS)


def mutate_text(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    """Change a text file: its numbers, its lines, and what stands between."""
    return _in_rounds(content, rng, others, (*_TEXT_STEPS, *_TEXT_STEPS, *_BYTE_STEPS))


def mutate_json(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    """Change the values and keys of a JSON document, and sometimes its text."""
    return _mutate_tree(content, rng, others, 0.7)


def mutate_yaml(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    """Change a YAML document as a tree, which is JSON then, or as text."""
    return _mutate_tree(content, rng, others, 0.4)


def _mutate_tree(content: bytes, rng: Random, others: Sequence[bytes], share: float) -> bytes:
    is_tree = rng.random() < share
    if is_tree:
        content = _changed_tree(_tree_of(content), rng)
    return content if is_tree and rng.random() < 0.7 else mutate_text(content, rng, others)


def mutate_e57(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    """Change an E57 file, mostly behind its checksums: the XML, or the points."""
    if rng.random() < 0.15:
        return mutate_bytes(content, rng, others)
    parts = logical_of(content)
    if rng.random() < 0.6:
        return e57_of(parts.binary, mutate_text(parts.xml, rng, [parts.xml]))
    head, body = parts.binary[:48], parts.binary[48:]
    return e57_of(head + mutate_bytes(body, rng, [body]), parts.xml)


def mutate_png(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    """Change a PNG file, mostly a chunk of it with a checksum that fits, packed data unpacked."""
    starts, at = [], 8
    while at + 12 <= len(content):
        starts.append(at)
        at += 12 + int.from_bytes(content[at : at + 4], "big")
    if rng.random() < 0.3 or not starts:
        return mutate_bytes(content, rng, others)
    at = rng.choice(starts)
    end = at + 8 + int.from_bytes(content[at : at + 4], "big")
    kind, data = content[at + 4 : at + 8], content[at + 8 : end]
    if kind in (b"IDAT", b"iCCP") and rng.random() < 0.5:
        with suppress(zlib.error):
            data = zlib.compress(mutate_bytes(zlib.decompress(data), rng, [data]))
    else:
        data = mutate_bytes(data, rng, [data])
    changed = struct.pack(">I", len(data)) + kind + data
    changed += struct.pack(">I", zlib.crc32(kind + data))
    return content[:at] + changed * rng.choice((1, 1, 1, 0, 2)) + content[end + 4 :]


def _in_rounds(
    content: bytes, rng: Random, others: Sequence[bytes], steps: Sequence[Mutate]
) -> bytes:
    for _ in range(rng.randint(1, _MOST_ROUNDS)):
        content = rng.choice(steps)(content, rng, others)[:_LARGEST]
    return content


def _place(content: bytes, rng: Random) -> int:
    end = len(content) if rng.random() < 0.5 else min(len(content), _HEADER_BYTES)
    return rng.randrange(end + 1)


def _flip(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 8)) if content else 0):
        changed[min(_place(content, rng), len(content) - 1)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _overwrite(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    kind, values = rng.choice(_BINARY)
    raw = struct.pack(rng.choice("<>") + kind, rng.choice(values))
    at = _place(content, rng) // len(raw) * len(raw) if rng.random() < 0.5 else _place(content, rng)
    return content[:at] + raw + content[at + len(raw) :]


def _splice(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    """Put a piece in, over what is there, several times, or take one out; or cut the rest off."""
    at, source = _place(content, rng), rng.choice(others)
    start = _place(source, rng)
    piece = source[start : start + int(2 ** rng.uniform(0.0, 12.0))]
    rest = content[at + rng.choice((0, len(piece))) :]
    return content[:at] + piece * rng.choice((0, 0, 1, 1, 3, 50)) + rest * (rng.random() < 0.8)


def _number(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    found = list(_NUMBER.finditer(content[:_LARGEST]))
    if not found:
        return _fragment(content, rng, others)
    chosen = rng.choice(found)
    return content[: chosen.start()] + rng.choice(_NUMBERS) + content[chosen.end() :]


def _fragment(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    at = _place(content, rng)
    return content[:at] + rng.choice(_FRAGMENTS) + content[at:]


def _line(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    lines = content.split(b"\n")
    place = rng.randrange(len(lines))
    line = lines[place]
    # No more than is kept: two thousand long lines are more than the process may hold.
    many = min(rng.choice((2, 40, 2000)), _LARGEST // (len(line) + 1) + 1)
    lines[place : place + 1] = rng.choice(
        ([], [line] * many, [b"  " + line], [line.lstrip()], [line, rng.choice(lines)])
    )
    return b"\n".join(lines)


_BYTE_STEPS: Final[tuple[Mutate, ...]] = (_flip, _overwrite, _splice)
_TEXT_STEPS: Final[tuple[Mutate, ...]] = (_number, _number, _fragment, _line)


@lru_cache(maxsize=64)
def _tree_of(content: bytes) -> str:
    """A document of JSON or YAML, as JSON."""
    from ruamel.yaml import YAML

    if content.startswith(b"{"):
        return json.dumps(json.loads(content))
    return json.dumps(YAML(typ="safe", pure=True).load(content), default=str)


# Any: a tree of JSON values, changed wherever it is.
def _changed_tree(text: str, rng: Random) -> bytes:
    tree: Any = {"": json.loads(text)}
    raws: list[bytes] = []
    for _ in range(rng.randint(1, 3)):
        places = _places(tree)
        container, key = rng.choice(places)
        kind = rng.randrange(6)
        if kind < 3:
            deep = (b"[" * 50_000 + b"]" * 50_000, b"[" * 70 + b"]" * 70)
            raws.append(rng.choice((*_NUMBERS, *deep)) or b"0")
            container[key] = f"@{len(raws) - 1}@"
        elif kind == 3:
            other, other_key = rng.choice(places)
            container[key] = json.loads(json.dumps(other[other_key]))
        elif kind == 4 and isinstance(container, dict) and key:
            name = rng.choice(("", "..", "a/b", "\0", "x" * 5000, key + " "))
            container[name] = container[key]
        else:
            # A thousand times a thousand times a thousand would be the harness's own end.
            count = 5 if len(places) > _MANY_PLACES else rng.choice((0, 1, 5, 1000))
            container[key] = [container[key]] * count
    dumped = json.dumps(tree[""]).encode()
    for index, raw in enumerate(raws):
        dumped = dumped.replace(f'"@{index}@"'.encode(), raw, max(1, _LONGEST // len(raw)))
    return dumped


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """All places of a tree, each as a container and its key or index."""
    found: list[tuple[Any, Any]] = []
    waiting = [tree]
    while waiting and len(found) < 10_000:
        container = waiting.pop()
        keys = list(container) if isinstance(container, dict) else range(len(container))
        found += [(container, key) for key in keys]
        waiting += [container[key] for key in keys if isinstance(container[key], dict | list)]
    return found


# The pages of an E57 file, 1020 bytes and a checksum each, taken apart and put together again -----


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
