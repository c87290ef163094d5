"""Whether an SVG picture is a drawing and nothing else: no script, no link, nothing from elsewhere.

On a page a picture can do nothing, but as a file of its own a browser runs what stands in it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final
from xml.parsers import expat

MOST_BYTES: Final = 16_000_000
# What plotting libraries draw with; `a`, `script`, `foreignObject`, animations are not among them.
_ELEMENTS: Final = frozenset(
    [
        *("svg", "g", "defs", "symbol", "use", "path", "rect", "circle", "ellipse", "line"),
        *("polyline", "polygon", "text", "tspan", "textPath", "image", "title", "desc", "style"),
        *("clipPath", "mask", "pattern", "marker", "linearGradient", "radialGradient", "stop"),
        *("filter", "metadata"),
    ]
)
# Of the description that libraries put into `metadata`.
_ABOUT: Final = frozenset(
    [
        "http://www.w3.org/1999/02/22-rdf-syntax-ns#",
        "http://creativecommons.org/ns#",
        "http://purl.org/dc/elements/1.1/",
    ]
)
_NAMESPACE: Final = "http://www.w3.org/2000/svg"
_INSIDE: Final = re.compile(r"#|data:image/(png|jpeg|webp|gif);base64,")
_ELSEWHERE: Final = re.compile(r"""url\(\s*(?!["']?\s*#)|@import|image-set|\\""", re.IGNORECASE)


class _ActiveError(Exception):
    """Something in it is no drawing."""


def is_plain_svg(content: bytes) -> bool:
    """Whether a picture can be handed on as a file that people open.

    Args:
        content: the file; what is no SVG at all is no plain one.
    """
    if len(content) > MOST_BYTES:
        return False
    check = _Check()
    parser = expat.ParserCreate(namespace_separator=" ")
    parser.StartElementHandler = check.start
    parser.EndElementHandler = check.end
    parser.CharacterDataHandler = check.text
    parser.StartDoctypeDeclHandler = _check_doctype
    parser.XmlDeclHandler = _check_declaration
    parser.ProcessingInstructionHandler = _refuse
    try:
        parser.Parse(content, True)  # noqa: FBT003 - of expat
    except (expat.ExpatError, _ActiveError):
        return False
    return True


class _Check:
    """Looks at elements as they come."""

    def __init__(self) -> None:
        # A style comes in pieces, which mean something together only.
        self._style: list[str] | None = None

    def start(self, name: str, attributes: Mapping[str, str]) -> None:
        namespace, _, local = name.rpartition(" ")
        if namespace not in _ABOUT and (namespace != _NAMESPACE or local not in _ELEMENTS):
            raise _ActiveError(name)
        for key, value in attributes.items():
            bare = key.rpartition(" ")[2].lower()
            is_link = bare == "href" and namespace not in _ABOUT
            if bare.startswith("on") or (is_link and not _INSIDE.match(value)):
                raise _ActiveError(key)
            _check_style(value)
        if local == "style":
            self._style = []

    def text(self, piece: str) -> None:
        if self._style is not None:
            self._style.append(piece)

    def end(self, _name: str) -> None:
        if self._style is not None:
            _check_style("".join(self._style))
            self._style = None


def _check_style(text: str) -> None:
    """Check a style, or an attribute, many of which are styles."""
    if _ELSEWHERE.search(text):
        raise _ActiveError(text[:20])


def _check_doctype(_name: str, _system: str | None, _public: str | None, is_own: int) -> None:
    # Only its own one can define entities; that of SVG 1.1 is a word that nobody looks up.
    if is_own:
        raise _ActiveError("DOCTYPE")


def _check_declaration(_version: str, encoding: str | None, _standalone: int) -> None:
    # A browser reads it in that one, whatever was checked here.
    if encoding is not None and encoding.lower() not in ("utf-8", "us-ascii"):
        raise _ActiveError(encoding)


def _refuse(target: str, _data: str) -> None:
    raise _ActiveError(target)
