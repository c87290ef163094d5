"""Pictures of an orientation: ties on the photos, predicted error on the walls, and residuals."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import decode_image, encode_webp
from orthoflow.geometry.opencv_border import to_opencv
from orthoflow.products import Photo, TieRole
from orthoflow.sdk import StepContext
from orthoflow_plugins.orient.gates import Candidate
from orthoflow_plugins.orient.wall_errors import sigmas_on_wall

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIDE_PX: Final = 900
# markiewicz2015, Figure 17: control green, rejected red, check yellow.
_ROLE_RGB: Final = {
    TieRole.REJECTED: (220, 40, 40),
    TieRole.CONTROL: (40, 200, 60),
    TieRole.CHECK: (250, 220, 40),
}
_MAX_FIGURES: Final = 24
_SUB_PIXEL_BITS: Final = 4
# Cells along the longer side of a map of predicted errors, and pixels per cell.
_MAP_CELLS: Final = 90
_MAP_ZOOM: Final = 8
_UNSEEN_BGR: Final = (60, 40, 20)
# Histograms, with normal distributions: markiewicz2015, Figures 18, 20, 21 and 23.
_BARS: Final = 40
_BARS_OF_A_PHOTO: Final = 25
# Rows of the picture of single photos, and how much of a row its highest bar takes.
_MAX_PHOTOS: Final = 30
_ROW_SHARE: Final = 0.8
_BAR_COLOUR: Final = "#9db8d2"
_CURVE_COLOUR: Final = "#b03a2e"
# Of the plan of photos: length of an arrow, and points of a photo's control.
_VIEW_M: Final = 0.4
_MAX_CONTROL: Final = 300
_PERCENTILE: Final = 99.5
# Width of a letter of the names of photos, inches.
_LETTER_IN: Final = 0.065
_KINDS: Final = (TieRole.CONTROL, TieRole.CHECK)


@dataclass(frozen=True, kw_only=True)
class PhotoResiduals:
    """Residuals of one oriented photo.

    Attributes:
        name: of the photo.
        residuals_px: (n, 2) observed - computed.
        role: (n,) `TieRole`.
    """

    name: str
    residuals_px: NDArray[np.float64]
    role: NDArray[np.uint8]

    def of_kind(self, kind: TieRole) -> NDArray[np.float64]:
        """Residuals (m, 2) of one role that are known."""
        values = self.residuals_px[self.role == kind]
        return np.asarray(values[np.isfinite(values).all(axis=1)])


def draw_ties(
    ctx: StepContext,
    photo: Photo,
    pixels_photo: NDArray[np.float64],
    role: NDArray[np.uint8],
    status: str,
) -> None:
    """Draw a photo's ties on it: control green, check yellow, rejected red."""
    import cv2

    if len(ctx.figures) >= _MAX_FIGURES:
        return
    name = _figure_name(photo.name)
    if any(figure.name == name for figure in ctx.figures):
        name = f"{name}-{len(ctx.figures)}"
    rgb = decode_image(photo.encoded, f"photo {photo.name}")
    scale = min(1.0, _SIDE_PX / max(photo.width, photo.height))
    size = (max(1, round(photo.width * scale)), max(1, round(photo.height * scale)))
    small = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    # Dimmed, so that the marks stand out.
    canvas = np.rint(0.7 * small).astype(np.uint8)
    unit = 1 << _SUB_PIXEL_BITS
    for kind, colour in _ROLE_RGB.items():
        at = np.rint(to_opencv(pixels_photo[role == kind] * scale) * unit).astype(int)
        for u, v in at.tolist():
            cv2.circle(canvas, (u, v), 2 * unit, colour, -1, cv2.LINE_AA, _SUB_PIXEL_BITS)
    ctx.figure(
        name,
        encode_webp(canvas),
        f"Ties of {photo.name}: control green, check yellow, rejected red. {status}. Green over "
        "the whole wall holds the photo; green in one corner alone, or red among it everywhere, "
        "does not.",
    )


def draw_wall_errors(ctx: StepContext, candidates: Sequence[Candidate]) -> None:
    """Draw the predicted error over each wall, at every place that of the photo that knows it best.

    Args:
        ctx: takes the pictures.
        candidates: of the photos that are ok.
    """
    walls = {wall.index: wall for candidate in candidates for wall in candidate.known}
    for index in sorted(walls):
        wall = walls[index]
        if len(ctx.figures) >= _MAX_FIGURES:
            return
        across, down = np.linalg.norm(wall.corners_world[[3, 1]] - wall.corners_world[0], axis=1)
        cell_m = max(across, down) / _MAP_CELLS
        shape = (max(1, round(down / cell_m)), max(1, round(across / cell_m)))
        best = np.full(shape, np.inf)
        for candidate in candidates:
            sigmas = sigmas_on_wall(candidate.estimate.resection, wall, shape)
            best = np.fmin(best, sigmas)
        shown = np.isfinite(best)
        if not shown.any():
            continue
        # A corner that photos hardly reach must not darken all the rest.
        median_m, high_m = np.percentile(best[shown], [50.0, 98.0])
        ctx.figure(
            f"wall_{wall.number}_predicted_error",
            partial(_error_map, best / high_m),
            f"Predicted error of a coordinate on {wall.name}, of the photo that knows each place "
            f"best: black 0 to yellow {1e3 * high_m:.2g} mm and more, median "
            f"{1e3 * median_m:.2g} mm; blue where no oriented photo shows the wall. Bright places "
            "far from ties are where the orthoimage may be off; more ties there would help.",
        )


def draw_positions(ctx: StepContext, candidates: Sequence[Candidate]) -> None:
    """Draw where the photos were taken, and the control, along the first wall and facing it.

    After skarlatos2012, Figure 3. Of a floor the second view is its plan.

    Args:
        ctx: takes the picture.
        candidates: of the photos that are ok.
    """
    from matplotlib.figure import Figure

    walls = {wall.index: wall for candidate in candidates for wall in candidate.known}
    if not walls:
        return
    first = walls[min(walls)]
    sides = first.corners_world[[3, 1]] - first.corners_world[0]
    axes_world = np.vstack([sides / np.linalg.norm(sides, axis=1)[:, None], first.normal])
    origin = first.corners_world[0]
    figure = Figure(figsize=(11.0, 5.0))
    panels = figure.subplots(1, 2)
    _set_margins(figure, left_in=0.6)
    for panel, axis, label in zip(panels, (2, 1), ("before it", "down it"), strict=True):
        shown = axes_world[[0, axis]].T
        for wall in walls.values():
            ring = (wall.corners_world[[0, 1, 2, 3, 0]] - origin) @ shown
            panel.plot(*ring.T, color="#888888", linewidth=0.8)
        for candidate in candidates:
            _draw_position(panel, candidate, origin, shown)
        panel.set_aspect("equal")
        panel.set_xlabel("along the first wall [m]", fontsize=8)
        panel.set_ylabel(f"{label} [m]", fontsize=8)
        panel.tick_params(labelsize=7)
    panels[1].invert_yaxis()
    ctx.figure(
        "positions",
        figure,
        "Where the oriented photos were taken and which way they look, with their control: seen "
        "along the first wall (left) and facing it (right); of a floor the right view is its plan. "
        "A photo behind a wall or far from the others is oriented wrongly.",
    )


def draw_residuals(ctx: StepContext, photos: Sequence[PhotoResiduals]) -> None:
    """Draw histograms of the residuals of oriented photos, all together and each by itself."""
    pooled = {
        kind: np.vstack([np.empty((0, 2)), *(photo.of_kind(kind) for photo in photos)])
        for kind in _KINDS
    }
    drawn = {kind: values for kind, values in pooled.items() if len(values) > 2}
    if drawn:
        _draw_pooled(ctx, drawn)
        _draw_each(ctx, photos, drawn)


def _draw_position(
    axes: Axes, candidate: Candidate, origin: NDArray[np.float64], shown: NDArray[np.float64]
) -> None:
    """Draw a photo's place, view and control onto two axes (3, 2) of the world."""
    camera = candidate.estimate.resection.camera
    control = (candidate.seen.points_world[candidate.control] - origin) @ shown
    step = max(1, len(control) // _MAX_CONTROL)
    axes.plot(*control[::step].T, ".", markersize=1.0, color="#30a040")
    x, y = ((camera.centre_world - origin) @ shown).tolist()
    across, down = (_VIEW_M * camera.rotation[2] @ shown).tolist()
    axes.arrow(x, y, across, down, head_width=0.2 * _VIEW_M, color=_CURVE_COLOUR, linewidth=0.8)
    axes.annotate(candidate.photo.name, (x, y), fontsize=5.5)


def _figure_name(photo_name: str) -> str:
    """Name of a photo's figure: letters, digits, `-` and `_`."""
    stem = photo_name.rpartition(".")[0] or photo_name
    return f"ties_{re.sub(r'[^A-Za-z0-9_-]', '-', stem)}"


def _error_map(shares: NDArray[np.float64]) -> bytes:
    import cv2

    shown = np.isfinite(shares)
    grey = np.rint(255.0 * np.clip(np.where(shown, shares, 0.0), 0.0, 1.0)).astype(np.uint8)
    bgr = np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO), dtype=np.uint8)
    bgr[~shown] = _UNSEEN_BGR
    size = (_MAP_ZOOM * shares.shape[1], _MAP_ZOOM * shares.shape[0])
    enlarged = cv2.resize(bgr, size, interpolation=cv2.INTER_NEAREST)
    return encode_webp(np.asarray(enlarged, dtype=np.uint8)[:, :, ::-1])


def _draw_pooled(ctx: StepContext, pooled: dict[TieRole, NDArray[np.float64]]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 2.6 * len(pooled)))
    panels = figure.subplots(len(pooled), 2, squeeze=False)
    _set_margins(figure, left_in=0.4)
    for (kind, values), row in zip(pooled.items(), panels, strict=True):
        for label, column, axes in zip("uv", values.T, row, strict=True):
            # One outline instead of forty bars, each of which takes its time to draw.
            counts, edges = np.histogram(column, bins=_BARS)
            axes.stairs(counts, edges, fill=True, color=_BAR_COLOUR)
            grid = np.linspace(edges[0], edges[-1], 200)
            axes.plot(grid, _normal(column, edges, grid), color=_CURVE_COLOUR, linewidth=1.0)
            axes.set_title(
                f"{kind.name.lower()} {label}: {len(column)} ties, SD {column.std():.2f} px",
                fontsize=9,
            )
            axes.set_xlabel("observed - computed [px]", fontsize=8)
            axes.tick_params(labelsize=7)
    ctx.figure(
        "residuals",
        figure,
        "Residuals of all oriented photos, with normal distributions: narrow hills about 0 are "
        "good; one beside 0, or broader for check ties than for control, is a systematic error.",
    )


def _draw_each(
    ctx: StepContext,
    photos: Sequence[PhotoResiduals],
    pooled: dict[TieRole, NDArray[np.float64]],
) -> None:
    """Draw a row per photo, a column per role and coordinate, all bars up to its height."""
    from matplotlib.figure import Figure

    shown = photos[:_MAX_PHOTOS]
    columns = [(kind, axis) for kind in pooled for axis in (0, 1)]
    figure = Figure(figsize=(2.6 * len(columns), 1.0 + 0.45 * len(shown)))
    panels = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    longest = max(len(photo.name) for photo in shown)
    _set_margins(figure, left_in=min(0.2 + _LETTER_IN * longest, 2.6))
    for (kind, axis), axes in zip(columns, panels, strict=True):
        reach = max(float(np.percentile(np.abs(pooled[kind][:, axis]), _PERCENTILE)), 1e-6)
        for row, photo in enumerate(shown):
            _draw_row(axes, photo.of_kind(kind)[:, axis], -row, reach)
        axes.axvline(0.0, color="#888888", linewidth=0.5)
        axes.set_xlim(-reach, 1.6 * reach)
        axes.set_ylim(0.9 - len(shown), 1.0)
        axes.set_title(f"{kind.name.lower()} {'uv'[axis]}", fontsize=9)
        axes.set_xlabel("observed - computed [px]", fontsize=8)
        axes.tick_params(labelsize=7)
    panels[0].set_yticks([-row for row in range(len(shown))], [photo.name for photo in shown])
    ctx.figure(
        "residuals_by_photo",
        figure,
        "Residuals of each oriented photo, with the normal distribution of the same mean and SD: a "
        "row that is broader than the others, or beside 0, is a photo to look at.",
    )


def _draw_row(axes: Axes, values: NDArray[np.float64], base: float, reach: float) -> None:
    """Draw the residuals (n,) of a photo on the line `base`."""
    if len(values) < 3:
        return
    counts, edges = np.histogram(values, bins=_BARS_OF_A_PHOTO, range=(-reach, reach))
    grid = np.linspace(-reach, reach, 120)
    curve = _normal(values, edges, grid)
    scale = _ROW_SHARE / max(float(counts.max()), float(curve.max()), 1e-9)
    axes.stairs(scale * counts + base, edges, baseline=base, fill=True, color=_BAR_COLOUR)
    axes.plot(grid, scale * curve + base, color=_CURVE_COLOUR, linewidth=0.8)
    axes.text(1.55 * reach, base, f"{len(values)}\nSD {values.std():.2f}", fontsize=5.5, ha="right")


def _set_margins(figure: Figure, *, left_in: float) -> None:
    """Leave room for labels and titles: a layout that measures them draws everything twice."""
    width, height = figure.get_size_inches()
    figure.subplots_adjust(
        left=left_in / width,
        right=1.0 - 0.15 / width,
        bottom=0.5 / height,
        top=1.0 - 0.3 / height,
        wspace=0.2,
        hspace=0.45,
    )


def _normal(
    values: NDArray[np.float64], edges: NDArray[np.float64], grid: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Counts per bar of a normal distribution with the mean and SD of the values."""
    mean, deviation = float(values.mean()), max(float(values.std()), 1e-9)
    density = np.exp(-0.5 * ((grid - mean) / deviation) ** 2) / deviation / np.sqrt(2.0 * np.pi)
    return np.asarray(len(values) * (edges[1] - edges[0]) * density)
