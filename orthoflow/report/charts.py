"""Matplotlib charts in a uniform style, with the width of a journal column."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawing import COLUMN_INCHES, plane_ink, styled
from orthoflow.untrusted_text import shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ChartFormat: TypeAlias = Literal["svg", "pdf", "png"]
# Name, number and corners (4, 2) of a wall; name, position (2,) and viewing direction (2,) of a
# photo. Coordinates are in metres in plan view.
PlanWall: TypeAlias = tuple[str, int, NDArray[np.float64]]
PlanPhoto: TypeAlias = tuple[str, NDArray[np.float64], NDArray[np.float64]]

# These colours can be distinguished by readers with colour vision deficiency (Okabe and Ito 2008).
# The line styles can be distinguished in greyscale prints.
COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#000000")
_STROKES: Final = ("-", "--", ":", "-.", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 3)))
_LOGARITHMIC_RATIO: Final = 20.0
# If the smallest value is less than this share of the largest, the axis starts at 0, because a
# truncated axis exaggerates differences.
_NEAR_ZERO: Final = 0.6
# Length of the arrow for a viewing direction, as a share of the plan's size; maximum number of
# photos whose names are shown.
_ARROW_SHARE: Final = 0.06
_NAMED_PHOTOS: Final = 60
_STYLE: Final = {"font.size": 8.0, "axes.grid": True}


@dataclass(frozen=True, kw_only=True)
class ChartPoint:
    """A point of a line in a chart.

    Attributes:
        x: value on the horizontal axis.
        y: value on the vertical axis.
        spread: half the length of the error bar; NaN if there is no error bar.
        is_filled: whether the marker is filled, which indicates the baseline.
    """

    x: float
    y: float
    spread: float = math.nan
    is_filled: bool = False


def line_chart(
    lines: Mapping[str, Sequence[ChartPoint]],
    *,
    below: str,
    beside: str,
    bounds: tuple[float, float] = (-math.inf, math.inf),
    suffix: ChartFormat = "svg",
) -> bytes:
    """Draw lines with error bars.

    Args:
        lines: name of the line -> points in the order of x; at most `len(COLOURS)` lines can be
            distinguished.
        below: label of the horizontal axis.
        beside: label of the vertical axis, with its unit.
        bounds: lowest and highest possible y value, e.g. 0 and 1 for shares.
        suffix: file format.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - not needed for pages without charts

    every = [point for points in lines.values() for point in points]
    xs = sorted({point.x for point in every})
    with styled(_STYLE):
        figure = Figure(figsize=(COLUMN_INCHES, 0.75 * COLUMN_INCHES), layout="constrained")
        axes = figure.subplots()
        is_logarithmic = xs[0] > 0 and xs[-1] / xs[0] >= _LOGARITHMIC_RATIO
        if is_logarithmic:
            axes.set_xscale("log")
        for index, (name, points) in enumerate(lines.items()):
            _draw_line(axes, points, index, name=shown(name), bounds=bounds)
        axes.margins(y=0.08)
        low, high = (end([point.y for point in every]) for end in (min, max))
        if 0.0 <= low < _NEAR_ZERO * high:
            axes.set_ylim(bottom=0.0)
        axes.set_xlabel(shown(f"{below}{' (logarithmic)' if is_logarithmic else ''}"))
        axes.set_ylabel(shown(beside), wrap=True)
        if any(lines):
            figure.legend(loc="outside upper left", ncols=1)
        return saved(figure, suffix)


def _draw_line(
    axes: Axes,
    points: Sequence[ChartPoint],
    index: int,
    *,
    name: str,
    bounds: tuple[float, float],
) -> None:
    colour = COLOURS[index % len(COLOURS)]
    x, y = (np.array([getattr(point, key) for point in points]) for key in ("x", "y"))
    axes.plot(
        x,
        y,
        color=colour,
        linestyle=_STROKES[index % len(_STROKES)],
        label=name or "_",
        zorder=2,
    )
    spread = np.array([point.spread for point in points])
    if np.isfinite(spread).any():
        low, high = np.clip([y - spread, y + spread], *bounds)
        axes.errorbar(
            x, y, yerr=np.array([y - low, high - y]), fmt="none", ecolor=colour, zorder=2.5
        )
    fills = [colour if point.is_filled else "white" for point in points]
    axes.scatter(x, y, c=fills, edgecolors=colour, s=16, zorder=3)


def plan_chart(
    walls: Sequence[PlanWall],
    photos: Sequence[PlanPhoto],
    *,
    labels: Sequence[str],
    suffix: ChartFormat = "svg",
) -> bytes:
    """Draw a plan of walls and photos, with equal scales along both axes.

    Args:
        walls: walls, drawn as lines in the colours of their planes, with their names.
        photos: photos, drawn as dots with an arrow in the viewing direction; names are shown if
            there are few photos.
        labels: labels of the horizontal and vertical axes.
        suffix: file format.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - not needed for pages without charts

    feet, looks = (np.array([photo[k] for photo in photos]).reshape(-1, 2) for k in (1, 2))
    span = float(np.ptp(np.vstack([*(wall[2] for wall in walls), feet]), axis=0).max()) or 1.0
    with styled(_STYLE):
        figure = Figure(figsize=(1.5 * COLUMN_INCHES, 1.2 * COLUMN_INCHES), layout="constrained")
        axes = figure.subplots()
        for index, (name, number, corners_m) in enumerate(walls):
            colour = plane_ink(number)
            ring = np.vstack([corners_m, corners_m[:1]])
            axes.plot(*ring.T, color=colour, linewidth=1.6)
            _name(axes, name, corners_m.mean(axis=0), colour=colour, above=bool(index % 2))
        arrows = _ARROW_SHARE * span * looks
        axes.quiver(
            *feet.T,
            *arrows.T,
            angles="xy",
            scale_units="xy",
            scale=1,
            color=COLOURS[1],
            width=0.004,
        )
        axes.scatter(feet[:, 0], feet[:, 1], s=14, color=COLOURS[5], zorder=3)
        for name, foot_m, _ in photos if len(photos) <= _NAMED_PHOTOS else ():
            _name(axes, name, foot_m, colour=COLOURS[5], above=False)
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.08)
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
        return saved(figure, suffix)


def _name(axes: Axes, name: str, place: NDArray[np.float64], *, colour: Any, above: bool) -> None:
    axes.annotate(
        shown(name),
        (float(place[0]), float(place[1])),
        xytext=(3, 4 if above else -8),
        textcoords="offset points",
        fontsize=6.5,
        color=colour,
    )


def saved(figure: Figure, suffix: ChartFormat) -> bytes:
    """Encode a figure without a date, so that equal figures have equal bytes."""
    stream = io.BytesIO()
    undated: dict[str, dict[str, Any]] = {
        "svg": {"Date": None},
        "pdf": {"CreationDate": None},
        "png": {},
    }
    figure.savefig(stream, format=suffix, metadata=undated[suffix])
    return stream.getvalue()


def as_image(svg: bytes) -> str:
    """Return an SVG file as a data URI, for use as an image on a page."""
    return f"data:image/svg+xml;base64,{base64.b64encode(svg).decode('ascii')}"
