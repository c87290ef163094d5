# ruff: noqa: N802, N815 - methods have the names that reportlab gives them
"""A page that keeps what is drawn on it, in millimetres, instead of making a PDF of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from reportlab.pdfbase.pdfmetrics import registerFont, stringWidth
from reportlab.pdfbase.ttfonts import TTFont

MM = 25.4 / 72.0


@dataclass(frozen=True, kw_only=True)
class Box:
    """A rectangle: left, bottom, width, height in mm, and its colour where it is filled."""

    sides: tuple[float, float, float, float]
    fill: tuple[float, ...] | None


@dataclass(frozen=True, kw_only=True)
class Line:
    """A line through points (n, 2) in mm, closed ones with their first point at the end again."""

    points: NDArray[np.float64]
    colour: tuple[float, ...]
    width_mm: float
    is_closed: bool


@dataclass(frozen=True, kw_only=True)
class Text:
    """A text, where it begins on its base line, and how large it is, in mm."""

    text: str
    left: float
    bottom: float
    width: float
    high: float
    colour: tuple[float, ...]
    is_bold: bool
    is_upright: bool
    is_centred: bool

    @property
    def middle(self) -> float:
        """Across, of a text that lies."""
        return self.left + 0.5 * self.width


class _Way:
    def __init__(self) -> None:
        self.points: list[tuple[float, float]] = []
        self.is_closed = False

    def moveTo(self, x: float, y: float) -> None:
        self.points.append((x * MM, y * MM))

    lineTo = moveTo

    def rect(self, x: float, y: float, wide: float, high: float) -> None:
        self.moveTo(x, y)
        self.lineTo(x + wide, y + high)

    def close(self) -> None:
        self.is_closed = True


@dataclass
class Page:
    """What reportlab's canvas is used for, kept."""

    boxes: list[Box] = field(default_factory=list)
    lines: list[Line] = field(default_factory=list)
    texts: list[Text] = field(default_factory=list)
    clips: list[NDArray[np.float64]] = field(default_factory=list)
    images: dict[str, tuple[float, float, float, float]] = field(default_factory=dict)
    said: dict[str, str] = field(default_factory=dict)
    n_pages: int = 0
    is_saved: bool = False
    state: dict[str, Any] = field(
        default_factory=lambda: {
            "fill": (0.0, 0.0, 0.0),
            "stroke": (0.0, 0.0, 0.0),
            "width": 0.0,
            "font": ("", 0.0),
            "at": (0.0, 0.0),
            "turned": 0,
        }
    )
    _kept: list[dict[str, Any]] = field(default_factory=list)

    def saveState(self) -> None:
        self._kept.append(dict(self.state))

    def restoreState(self) -> None:
        self.state = self._kept.pop()

    def setLineWidth(self, width: float) -> None:
        self.state["width"] = width * MM

    def setFillColorRGB(self, *colour: float) -> None:
        self.state["fill"] = colour

    def setStrokeColorRGB(self, *colour: float) -> None:
        self.state["stroke"] = colour

    def setFont(self, name: str, size: float) -> None:
        self.state["font"] = (name, size)

    def translate(self, x: float, y: float) -> None:
        self.state["at"] = (x * MM, y * MM)

    def rotate(self, degrees: float) -> None:
        self.state["turned"] = degrees

    def setTitle(self, text: str) -> None:
        self.said["title"] = text

    def setAuthor(self, text: str) -> None:
        self.said["author"] = text

    def setSubject(self, text: str) -> None:
        self.said["subject"] = text

    def drawImage(self, path: str, x: float, y: float, wide: float, high: float) -> None:
        self.images[path] = (x * MM, y * MM, wide * MM, high * MM)

    def showPage(self) -> None:
        self.n_pages += 1

    def save(self) -> None:
        self.is_saved = True

    def beginPath(self) -> _Way:
        return _Way()

    def clipPath(self, way: _Way, stroke: int = 1, fill: int = 0) -> None:
        assert (stroke, fill) == (0, 0)
        self.clips.append(np.array(way.points))

    def drawPath(self, way: _Way) -> None:
        self.lines.append(
            Line(
                points=np.array(way.points),
                colour=self.state["stroke"],
                width_mm=self.state["width"],
                is_closed=way.is_closed,
            )
        )

    def rect(
        self, x: float, y: float, wide: float, high: float, stroke: int = 1, fill: int = 0
    ) -> None:
        sides = (x * MM, y * MM, wide * MM, high * MM)
        self.boxes.append(Box(sides=sides, fill=self.state["fill"] if fill else None))

    def drawString(self, x: float, y: float, text: str) -> None:
        self._write(text, is_centred=False)

    def drawCentredString(self, x: float, y: float, text: str) -> None:
        self._write(text, is_centred=True)

    def _write(self, text: str, *, is_centred: bool) -> None:
        name, size = self.state["font"]
        (x, y), wide = self.state["at"], stringWidth(text, name, size) * MM
        self.texts.append(
            Text(
                text=text,
                left=x - 0.5 * wide * is_centred,
                bottom=y,
                width=wide,
                # Capital letters of DejaVu Sans are 1493 of 2048 units high.
                high=size * MM * 1493 / 2048,
                colour=self.state["fill"],
                is_bold=name.endswith("-Bold"),
                is_upright=self.state["turned"] == 90,
                is_centred=is_centred,
            )
        )


@cache
def _register_fonts() -> None:
    fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"
    for name in ("DejaVuSans", "DejaVuSans-Bold"):
        registerFont(TTFont(name, str(fonts / f"{name}.ttf")))


@contextmanager
def page() -> Iterator[Page]:
    """Give a page, with the fonts that sheets are written in."""
    _register_fonts()
    drawn = Page()
    yield drawn
    assert drawn._kept == []
