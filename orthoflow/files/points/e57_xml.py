"""The XML of an E57 file, looked at before libE57 parses it: bounded, and nothing but elements.

libE57 compares each child of a structure with all before it: 60,000 take over 50 s. Entities it
refuses today as bad XML; that nothing is read which they name shall not hang on its version. The
standard (ASTM E2807) needs none of that.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Final
from xml.parsers.expat import ExpatError, ParserCreate

from orthoflow.errors import InputError

# Scans of large buildings, a thousand scans with pictures, have a few million bytes.
MOST_XML_BYTES: Final = 1 << 25
MOST_XML_ELEMENTS: Final = 200_000
DEEPEST_XML: Final = 64
# Of a structure; vectors, as of scans and pictures, may have as many as they like.
MOST_XML_CHILDREN: Final = 500
# E57 3.3: pages of 1024 bytes, the last four of each a checksum.
_PAGE: Final = 1024
_PAYLOAD: Final = 1020
_HEADER: Final = struct.Struct("<8sIIQQQQ")
_ENCODING: Final = re.compile(rb"<\?xml[^>]*encoding\s*=\s*[\"']([^\"']*)", re.IGNORECASE)


def check_xml(path: Path) -> None:
    """Look at the XML of an E57 file.

    Raises:
        InputError: it is too large or too deep, has a document type, or is no XML in UTF-8.
    """
    xml = _xml_of(path)
    encoding = _ENCODING.match(xml)
    if encoding is not None and encoding[1].upper() != b"UTF-8":
        raise _refusal(path, f"it is in {encoding[1][:40]!r}, expected UTF-8")
    _Elements(path).parse(xml)


def _xml_of(path: Path) -> bytes:
    with path.open("rb") as file:
        head = file.read(_HEADER.size)
        if len(head) < _HEADER.size:
            raise _refusal(path, "the file ends within its header")
        _, _, _, _, start, length, _ = _HEADER.unpack(head)
        if length > MOST_XML_BYTES:
            raise _refusal(path, f"it has {length} bytes, at most {MOST_XML_BYTES} are read")
        offset = start % _PAGE
        file.seek(min(start - offset, path.stat().st_size))
        raw = file.read((offset + length) // _PAYLOAD * _PAGE + 2 * _PAGE)
    pages = b"".join(raw[at : at + _PAYLOAD] for at in range(0, len(raw), _PAGE))
    return pages[offset : offset + length]


class _Elements:
    """Counts elements and how deep they lie, and refuses what is none."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._n_elements = 0
        # Of each element around the present place: how many children, and how many it may have.
        self._open: list[list[int]] = []

    def parse(self, xml: bytes) -> None:
        """Parse it all.

        Raises:
            InputError: something in it is refused.
        """
        parser = ParserCreate("UTF-8")
        parser.StartElementHandler = self._begin
        parser.EndElementHandler = self._end
        parser.StartDoctypeDeclHandler = self._refuse_doctype
        try:
            parser.Parse(xml, True)  # noqa: FBT003 - it is all there is
        except ExpatError as error:
            raise _refusal(self._path, f"it is no XML ({error})") from error

    def _begin(self, name: str, attributes: dict[str, str]) -> None:
        if self._open:
            self._open[-1][0] += 1
            if self._open[-1][0] > self._open[-1][1]:
                raise _refusal(
                    self._path, f"a structure in it has more than {MOST_XML_CHILDREN} elements"
                )
        is_vector = attributes.get("type") == "Vector"
        self._open.append([0, MOST_XML_ELEMENTS if is_vector else MOST_XML_CHILDREN])
        self._n_elements += 1
        if len(self._open) > DEEPEST_XML:
            raise _refusal(self._path, f"it is nested deeper than {DEEPEST_XML} elements")
        if self._n_elements > MOST_XML_ELEMENTS:
            raise _refusal(self._path, f"it has more than {MOST_XML_ELEMENTS} elements")

    def _end(self, name: str) -> None:
        self._open.pop()

    def _refuse_doctype(self, *declaration: object) -> None:
        raise _refusal(self._path, "it declares a document type or entities, which no E57 has")


def _refusal(path: Path, reason: str) -> InputError:
    return InputError(
        f"{path.name} cannot be read as E57: its XML is refused, {reason}; the file is damaged or "
        "was not written by a scanner's program, copy or export it again"
    )
