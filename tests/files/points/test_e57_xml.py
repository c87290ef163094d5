"""The XML of an E57 file is as large, as deep and as wide as a scanner's program writes it."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import pytest

from orthoflow.errors import InputError
from orthoflow.files.points.e57 import check_xml
from tests.fuzz.e57_pages import e57_of

# What stands before the XML does not count here.
HEADER = bytes(48)


def structure(inside: str) -> str:
    return f"<a>{inside}</a>"


def vector(n_children: int) -> str:
    return f'<v type="Vector">{"<a/>" * n_children}</v>'


def nested(depth: int) -> str:
    return "<a>" * depth + "</a>" * depth


@pytest.mark.parametrize(
    ("most", "more", "reason"),
    [
        (structure("<a/>" * 500), structure("<a/>" * 501), "a structure in it has more than 500"),
        (nested(64), nested(65), "it is nested deeper than 64 elements"),
        (
            structure(vector(100_000) + vector(99_997)),
            structure(vector(100_000) + vector(99_998)),
            "it has more than 200000 elements",
        ),
        (
            '<?xml version="1.0" encoding="utf-8"?><a/>',
            '<?xml version="1.0" encoding="latin-1"?><a/>',
            "it is in b'latin-1', expected UTF-8",
        ),
        ("<a/>", "<!DOCTYPE a><a/>", "it declares a document type or entities"),
        ("<a/>", "<a>", "it is not XML"),
    ],
    ids=["wide", "deep", "many", "encoding", "document type", "no XML"],
)
def test_xml_up_to_its_limits_is_taken_and_no_further(
    most: str, more: str, reason: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.e57"
    path.write_bytes(e57_of(HEADER, most.encode()))
    check_xml(path)
    path.write_bytes(e57_of(HEADER, more.encode()))
    told = f"a.e57 cannot be read as E57: its XML is refused, {reason}"
    with pytest.raises(InputError, match=re.escape(told)):
        check_xml(path)


def test_vectors_are_wider_than_structures(tmp_path: Path) -> None:
    path = tmp_path / "a.e57"
    path.write_bytes(e57_of(HEADER, vector(20_000).encode()))
    check_xml(path)


@pytest.mark.parametrize(("n_bytes", "is_read"), [(1 << 25, True), ((1 << 25) + 1, False)])
def test_a_header_may_ask_for_32_mib_of_xml(n_bytes: int, is_read: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.e57"
    content = bytearray(e57_of(HEADER, b"<a/>"))
    content[32:40] = struct.pack("<Q", n_bytes)
    path.write_bytes(content)
    # What is there ends long before.
    with pytest.raises(
        InputError, match="it is not XML" if is_read else "at most 33554432 are read"
    ):
        check_xml(path)


def test_a_file_shorter_than_a_header_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.e57"
    path.write_bytes(HEADER[:47])
    with pytest.raises(InputError, match="the file ends within its header"):
        check_xml(path)
