"""Drawings that people open as files draw, and run and load nothing."""

from __future__ import annotations

import io

import matplotlib.pyplot as plt
import pytest

from orthoflow.untrusted_text import is_plain_svg

LINKS = 'xmlns:xlink="http://www.w3.org/1999/xlink"'


def picture(inside: str, before: str = "") -> bytes:
    return f'{before}<svg xmlns="http://www.w3.org/2000/svg" {LINKS}>{inside}</svg>'.encode()


@pytest.mark.parametrize("kind", ["path", "none"])
def test_what_matplotlib_draws_is_plain(kind: str) -> None:
    with plt.rc_context({"svg.fonttype": kind}):
        figure, (left, right) = plt.subplots(1, 2)
        left.plot([1, 2], label=r"$\alpha$ \\ <&>")
        left.legend()
        left.fill_between([0, 1], [0, 1], hatch="/")
        right.imshow([[0, 1], [1, 0]])
        content = io.BytesIO()
        figure.savefig(content, format="svg")
        plt.close(figure)
    assert is_plain_svg(content.getvalue())


def test_drawings_are_plain() -> None:
    for inside in (
        *("", '<rect fill="url(#a)"/>', '<use xlink:href="#a"/>', "<style>a{fill:red}</style>"),
        *('<image href="data:image/png;base64,AA"/>', "<text>url(http://a) @import C:\\x</text>"),
    ):
        assert is_plain_svg(picture(inside))
        assert is_plain_svg(picture(inside).decode().encode("utf-16"))


ACTIVE = [
    "<script>alert(1)</script>",
    '<g onload="x()"/>',
    '<g ONLOAD="x()"/>',
    '<a href="#x"/>',
    "<foreignObject/>",
    '<animate attributeName="href"/>',
    '<image href="http://a/b.png"/>',
    '<image xlink:href="file:///etc/passwd"/>',
    '<image href="data:image/svg+xml;base64,AA"/>',
    '<use href=" javascript:x()"/>',
    '<style>@import "x";</style>',
    "<style>a{fill:url(<!-- -->http://a)}</style>",
    "<style>a{fill:u\\72l(//a)}</style>",
    '<rect style="fill:URL( //a)"/>',
    '<g xmlns="http://www.w3.org/1999/xhtml"><script/></g>',
    "<g>",
]


@pytest.mark.parametrize("inside", ACTIVE)
def test_what_runs_or_loads_is_not_plain(inside: str) -> None:
    assert not is_plain_svg(picture(inside))


def test_what_is_no_drawing_or_too_large_is_not_plain() -> None:
    before = ("<?xml-stylesheet href='a.css'?>", "<!DOCTYPE svg [<!ENTITY b 'c'>]>")
    for content in (b"", b"GIF89a", *(picture("", one) for one in before)):
        assert not is_plain_svg(content)
    blanks = 16_000_000 - len(picture(""))
    assert is_plain_svg(picture(" " * blanks))
    assert not is_plain_svg(picture(" " * (blanks + 1)))
