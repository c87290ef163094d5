"""Tags of a directory: numbers, texts and bytes, and what is no directory at all."""

from __future__ import annotations

import io
import struct

import pytest

from orthoflow.files import tiff_tags
from orthoflow.files.tiff_tags import Directory, read_directory

TAG = 0x9000
MOST = 1 << 20
BYTE, TEXT, SHORT, RATIONAL, UNDEFINED = 1, 2, 3, 5, 7


def block(kind: int, count: int, raw: bytes, *, order: str = "<", n_entries: int = 1) -> bytes:
    """A structure of one tag, whose value stands behind the directory where it is long."""
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    behind = raw if len(raw) > 4 else b""
    held = struct.pack(order + "I", 26) if behind else raw.ljust(4, b"\0")
    entry = struct.pack(order + "HHI", TAG, kind, count) + held
    return head + struct.pack(order + "H", n_entries) + entry + bytes(4) + behind


def directory(kind: int, count: int, raw: bytes) -> Directory:
    return read_directory(block(kind, count, raw), most_bytes=MOST)


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_directory_says_where_it_begins_and_in_which_order(order: str) -> None:
    raw = struct.pack(order + "H", 258)
    found = read_directory(block(SHORT, 1, raw, order=order), most_bytes=MOST)
    assert (found.start, found.order, found.is_damaged) == (8, order, False)
    assert found.number(TAG) == 258.0
    assert found.number(TAG + 1) is None


@pytest.mark.parametrize(
    ("kind", "count", "raw", "number"),
    [
        (SHORT, 2, struct.pack("<HH", 7, 9), 7.0),
        (BYTE, 2, b"\x05\x06", 5.0),
        (RATIONAL, 1, struct.pack("<II", 1, 4), 0.25),
        (SHORT, 1, struct.pack("<H", 0), None),
        (RATIONAL, 1, struct.pack("<II", 1, 0), None),
        (UNDEFINED, 2, b"\x05\x06", None),
        (TEXT, 2, b"5\0", None),
    ],
    ids=["first-of-two", "bytes", "fraction", "zero", "infinite", "no-number", "text"],
)
def test_a_number_is_the_first_one_where_it_is_finite_and_positive(
    kind: int, count: int, raw: bytes, number: float | None
) -> None:
    assert directory(kind, count, raw).number(TAG) == number


@pytest.mark.parametrize(
    ("raw", "text"),
    [
        (b" NIKON D3X \0", "NIKON D3X"),
        (b"NIKON\0left over\0", "NIKON"),
        (b"a" * 199 + b"\0", "a" * 199),
        (b"a" * 200 + b"\0", ""),
    ],
    ids=["blanks", "behind-its-end", "longest", "too-long"],
)
def test_a_text_ends_at_its_first_nul_and_is_no_longer_than_names_are(
    raw: bytes, text: str
) -> None:
    assert directory(TEXT, len(raw), raw).text(TAG) == text


def test_what_is_no_ascii_is_marked() -> None:
    assert directory(TEXT, 3, b"M\xfc\0").text(TAG) == "M\N{REPLACEMENT CHARACTER}"


def test_a_number_is_no_text_and_a_text_has_no_bytes() -> None:
    assert directory(SHORT, 1, struct.pack("<H", 7)).text(TAG) == ""
    assert directory(TEXT, 6, b"seven\0").content(TAG) is None


@pytest.mark.parametrize("kind", [BYTE, UNDEFINED])
def test_bytes_are_given_unless_all_of_them_are_missing(kind: int) -> None:
    assert directory(kind, 6, b"\0\0\0\0\0\x01").content(TAG) == b"\0\0\0\0\0\x01"
    assert directory(kind, 6, bytes(6)).content(TAG) is None
    assert directory(kind, 6, b"abcdef").content(TAG + 1) is None


def test_without_a_directory_there_is_nothing() -> None:
    empty = Directory()
    assert (empty.number(TAG), empty.text(TAG), empty.content(TAG)) == (None, "", None)
    assert (empty.start, empty.order, empty.is_damaged) == (0, "<", False)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"XX*\0\x08\0\0\0\0\0",
        b"II*\0\x08\0\0",
        b"II*\0\x08\0\0\0",
        b"II*\0\x08\0\0\0\x01",
        block(SHORT, 1, b"\x07\0", n_entries=1001),
    ],
    ids=["nothing", "no-order", "short-head", "no-directory", "half-a-count", "too-many"],
)
def test_what_is_no_directory_is_damaged(content: bytes) -> None:
    found = read_directory(content, most_bytes=MOST)
    assert found.is_damaged
    assert found.entries is None


def test_an_empty_directory_is_whole() -> None:
    found = read_directory(b"II*\0\x08\0\0\0" + bytes(6), most_bytes=MOST)
    assert not found.is_damaged
    assert found.entries is not None


def test_a_thousand_tags_are_read_and_the_missing_ones_are_noticed() -> None:
    found = read_directory(block(SHORT, 1, struct.pack("<H", 7), n_entries=1000), most_bytes=MOST)
    assert found.is_damaged
    assert found.number(TAG) == 7.0


def test_a_directory_is_read_where_it_is_said_to_begin() -> None:
    first = block(SHORT, 1, struct.pack("<H", 7))
    both = first + block(SHORT, 1, struct.pack("<H", 9))[8:]
    found = read_directory(both, len(first), most_bytes=MOST)
    assert (found.start, found.number(TAG)) == (len(first), 9.0)


def test_values_outside_the_block_are_missed_and_the_rest_is_read() -> None:
    cut = block(RATIONAL, 1, struct.pack("<II", 1, 4))[:-2]
    found = read_directory(cut, most_bytes=MOST)
    assert found.is_damaged
    assert found.number(TAG) is None


def test_a_block_gives_what_it_has_and_zeros_where_that_is_not_enough() -> None:
    source = tiff_tags._Source(b"abc", 10)
    assert (source.read(0), source.tell()) == (b"", 0)
    assert (source.read(2), source.read(1), source.is_short) == (b"ab", b"c", False)
    # A reader that asks where the end is learns of that of the file.
    assert source.seek(0, io.SEEK_END) == 10
    assert source.seek(1) == 1
    assert (source.read(3), source.is_short) == (bytes(3), True)
