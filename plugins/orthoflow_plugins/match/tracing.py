"""One photo on all walls by its pose: measured, cleaned, the pose refitted, measured again."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.lenses import POSE_PARAMETERS, LensFreedom, unmeasured
from orthoflow.geometry.resection import SeenPoints, adjust, misfit
from orthoflow.geometry.robust import MEDIAN_LENGTH, NMAD_FACTOR
from orthoflow.products import Intrinsics, Photo, Wall
from orthoflow_plugins.match.channels import (
    CHANNELS,
    Channels,
    WallTarget,
    colour_channels,
    textured_places,
)
from orthoflow_plugins.match.displacements import (
    CORRELATION_AREA_CELLS,
    Displacements,
    Search,
    measure,
)
from orthoflow_plugins.match.pictures import points_on_wall
from orthoflow_plugins.match.ties import TiePiece, Trace
from orthoflow_plugins.match.warping import Before, Projection, View, view_of

_NEIGHBOURS: Final = 12
_MEDIAN_TOLERANCE_CELLS: Final = 0.6
_REJECTION: Final = 3.5
_HELD_OUT: Final = 4
_LEAST: Final = 12
_MAX_SIGMA_CELLS: Final = 2.0
# What no refinement gets below: the raster's own interpolation.
_SIGMA_FLOOR_CELLS: Final = 0.1
_OCCUPIED_CELLS: Final = 5.0
# How far a place is searched in the first round; halved in every next, down to the least.
_FIRST_RADIUS_CELLS: Final = 8
_MIN_RADIUS: Final = 2
# Photos are warped and measured at most so often.
_MAX_ROUNDS: Final = 4
# Warping again by a pose that moves the photo less than this on the walls changes nothing.
_SETTLED_CELLS: Final = 0.3
# Held-out error has to fall by this share for another round.
_MIN_GAIN: Final = 0.03
# Compared only where what came before leaves doubts.
_LAST: Final = "colours"
_FEW_SHARE: Final = 0.25

CONTENTS: Final = ("gradients", "grey", _LAST)
"""All that may be compared, in the order in which it is tried."""


@dataclass(frozen=True, kw_only=True)
class Desk:
    """What photos are laid on, and how they are compared.

    Attributes:
        targets: all walls; any of them may hide another.
        before: what stands free before the walls, as far as it is known: patches keep off what it
            hides.
        max_ties: places measured per photo.
        contents: what is compared, of `gradients`, `grey` and `colours`; the best one is kept.
        threads: patches are shared between so many.
    """

    targets: Sequence[WallTarget]
    before: Before | None = None
    max_ties: int = 1200
    contents: tuple[str, ...] = CONTENTS
    threads: int = 1

    @property
    def walls(self) -> list[Wall]:
        """The walls as they are matched."""
        return [target.wall for target in self.targets]


@dataclass(frozen=True, kw_only=True)
class _Round:
    pieces: list[TiePiece]
    n_measured: int
    n_outliers: int


_Known = tuple[LensFreedom, ViewingCamera]
"""What of a lens may be off, and a camera with the lens as it is known."""


@dataclass(frozen=True, kw_only=True)
class _Refitted:
    """A pose by the ties of a round.

    Attributes:
        camera: the pose, and the lens where it was free.
        held_out_px: RMS of a residual coordinate of held-out ties.
        free: what of the lens was, None where it was held.
    """

    camera: ViewingCamera
    held_out_px: float
    free: _Known | None


def trace_photo(
    index: int,
    photo: Photo,
    camera: ViewingCamera,
    desk: Desk,
    lens: LensFreedom | None = None,
) -> Trace:
    """Match a photo with the walls it shows by its pose, until held-out ties stop improving.

    Args:
        index: of the photo.
        photo: the photo.
        camera: its pose, good to a few cells on the walls.
        desk: what it is laid on.
        lens: how far the lens may be off, too, where it was only estimated. Held as first ties had
            it where ties ask for another, it would bend what is searched, and leave out as wrong
            what contradicts it.
    """
    view = view_of(index, photo, camera, desk.walls, desk.before)
    found: tuple[Trace, View] | None = None
    for content in desk.contents:
        if content == _LAST and found is not None and not _is_doubtful(found[0], desk):
            continue
        # What one content found out about the pose is the next one's start.
        start = (view, _FIRST_RADIUS_CELLS) if found is None else (found[1], _MIN_RADIUS)
        tried = _traced(start, desk, content, lens)
        if found is None or _is_better(tried[0], found[0]):
            found = tried
    assert found is not None  # noqa: S101 - there is at least one content
    return replace(found[0], camera=camera)


def estimated_lens(photo: Photo, found: Intrinsics | None) -> LensFreedom | None:
    """Return how far the lens of a photo may be off that its first orientation estimated.

    Returns:
        None where it was calibrated, or given from elsewhere.
    """
    if photo.intrinsics is not None or found is None or found.source != "estimated":
        return None
    longer_px = max(photo.width, photo.height)
    return unmeasured(longer_px, has_exif=photo.exif_focal_px is not None)


def lens_by_ties(trace: Trace, lens: LensFreedom) -> tuple[ViewingCamera, float]:
    """Return a camera as a photo's ties alone have it, and the standard deviation of ln f.

    Args:
        trace: of the photo.
        lens: how far the lens may be off from that of its pose, the focal length among it.
    """
    seen = _joined(trace.pieces)
    try:
        found = adjust(seen, trace.settled, lens=lens, soft_limit=2.0)
    except GeometryError:
        return trace.settled, math.inf
    return found.camera, math.sqrt(found.covariance[POSE_PARAMETERS, POSE_PARAMETERS])


def _is_doubtful(found: Trace, desk: Desk) -> bool:
    """Whether laser and camera may see different things: grey says less than edges, or little."""
    return found.content != "grey" or found.n_ties < _FEW_SHARE * desk.max_ties


def _is_better(tried: Trace, found: Trace) -> bool:
    """Whether another content promises a better pose."""
    if not (tried.held_out_px and found.held_out_px):
        return tried.n_ties > found.n_ties
    return _promised(tried) < _promised(found)


def _promised(trace: Trace) -> float:
    """Held-out error over the root of the number of ties and over how far apart they lie."""
    pixels = np.concatenate([piece.pixels_photo for piece in trace.pieces])
    if len(pixels) < _LEAST:
        return math.inf
    spread_px = math.sqrt(math.sqrt(max(float(np.linalg.det(np.cov(pixels.T))), 1.0)))
    return min(trace.held_out_px) / (math.sqrt(len(pixels)) * spread_px)


def _traced(
    start: tuple[View, int],
    desk: Desk,
    content: str,
    lens: LensFreedom | None = None,
) -> tuple[Trace, View]:
    """Trace a photo by one content; also how it lay on the walls in the end."""
    view, radius = start
    known = None if lens is None else (lens, view.camera)
    best: _Round | None = None
    free: _Known | None = None
    history: list[float] = []
    for _ in range(_MAX_ROUNDS):
        found = _measured(view, desk, radius, content)
        fit = _refitted(_joined(found.pieces), view.camera, known)
        if fit is None:
            # A round that finds too little does not spoil the one before.
            best = best or found
            break
        improved = not history or fit.held_out_px < (1.0 - _MIN_GAIN) * min(history)
        history.append(fit.held_out_px)
        if fit.held_out_px <= min(history):
            best, free = found, fit.free
        if not improved or _moved_cells(found, view, fit.camera) < _SETTLED_CELLS:
            break
        view = view.posed(fit.camera, desk.walls)
        radius = max(_MIN_RADIUS, radius // 2)
    result = best or _Round(pieces=[], n_measured=0, n_outliers=0)
    cleaned = _without_misfits(result.pieces, view.camera, free)
    n_kept = sum(len(piece) for piece in cleaned)
    trace = Trace(
        photo=view.index,
        pieces=tuple(cleaned),
        n_measured=result.n_measured,
        n_outliers=result.n_measured - n_kept,
        held_out_px=tuple(history),
        content=content,
        camera=view.camera,
        settled=view.camera,
    )
    return trace, view


def _moved_cells(found: _Round, view: View, refitted: ViewingCamera) -> float:
    """How far another pose moves the photo on the walls, at the ties (RMS)."""
    squares = []
    for piece in found.pieces:
        projection = view.projections[piece.wall]
        if projection is None:
            continue
        before, after = (
            camera.project(piece.points_world)[:, :2] for camera in (view.camera, refitted)
        )
        squares.append(((after - before) ** 2).sum(axis=1) / projection.pixels_per_cell**2)
    return float(np.sqrt(np.concatenate(squares).mean()))


def _measured(view: View, desk: Desk, radius: int, content: str) -> _Round:
    targets = desk.targets
    sizes = [_footprint(item) for item in view.projections]
    occupied: set[tuple[int, int]] = set()
    pieces: list[TiePiece] = []
    n_measured = 0
    # The wall that fills most of the photo first: planes close to each other show one surface.
    for index in sorted(range(len(targets)), key=lambda k: (-sizes[k], k)):
        projection, target = view.projections[index], targets[index]
        if projection is None or target.grey is None or sizes[index] == 0:
            continue
        share = sizes[index] / sum(sizes)
        on_wall = "grey" if content == "colours" else content
        target.prepare(on_wall)
        channels = target.channels[on_wall].part(projection.part)
        usable = (channels.known > 0.0) & np.isfinite(projection.u)
        strength = target.textures[on_wall][projection.part]
        places = textured_places(strength, usable, max(50, round(desk.max_ties * share)))
        places = _unoccupied(places, projection, occupied)
        search = Search(radius_cells=radius, threads=desk.threads)
        moved = measure(channels, _seen(view, index, content), places, search)
        n_measured += len(moved.places)
        moved = moved.take(agrees_around(moved))
        grain = target.grain[0][projection.part]
        pieces.append(_piece(view.index, index, target.wall, (moved, projection), grain))
    pieces.sort(key=lambda piece: piece.wall)
    return _Round(
        pieces=pieces,
        n_measured=n_measured,
        n_outliers=n_measured - sum(len(piece) for piece in pieces),
    )


def _seen(view: View, index: int, content: str) -> Channels:
    """What of a photo is compared with a wall."""
    projection = view.projections[index]
    assert projection is not None  # noqa: S101 - the photo shows the wall
    if content == "colours":
        return colour_channels(view.colours_on_wall(projection))
    return CHANNELS[content](view.on_wall(index, projection))


def _piece(
    photo: int,
    index: int,
    wall: Wall,
    found: tuple[Displacements, Projection],
    grain: NDArray[np.float32],
) -> TiePiece:
    """Ties of one photo with one wall; residuals agree over the cells of a grain.

    A gap is filled over the grain's cells, and pictures are smoothed besides: one after the other,
    so that the areas over which residuals agree add up.
    """
    moved, projection = found
    at = moved.places + moved.shift_cells
    pixels = np.column_stack([between(projection.u, at), between(projection.v, at)])
    points = points_on_wall(wall, moved.places + projection.corner + np.float64(0.5))
    alone = grain[moved.places[:, 1], moved.places[:, 0]].astype(np.float64)
    wider = np.sqrt((CORRELATION_AREA_CELLS + alone - 1.0) / CORRELATION_AREA_CELLS)
    sigma_cells = np.hypot(moved.sigma_cells * wider, _SIGMA_FLOOR_CELLS)
    piece = TiePiece(
        photo=photo,
        wall=index,
        pixels_photo=pixels,
        points_world=points.points_world,
        sigma_px=sigma_cells * projection.pixels_per_cell,
        sigma_m=points.sigma_m,
    )
    gsd_m = wall.frame.gsd_m
    return piece.take(
        points.known & np.isfinite(pixels).all(axis=1) & (points.sigma_m < _MAX_SIGMA_CELLS * gsd_m)
    )


def _refitted(
    seen: SeenPoints, camera: ViewingCamera, known: _Known | None = None
) -> _Refitted | None:
    """Pose from three quarters of the ties, and how it fits the rest; None where there is none.

    The lens moves with it where that fits the rest better, too.
    """
    if len(seen) < _LEAST:
        return None
    order = np.lexsort((seen.pixels_photo[:, 0], seen.pixels_photo[:, 1]))
    held_out = np.zeros(len(seen), dtype=np.bool_)
    held_out[order[::_HELD_OUT]] = True
    best: _Refitted | None = None
    for free in (None,) if known is None else (None, known):
        try:
            fitted = fitted_pose(seen.take(~held_out), camera, free)
        except GeometryError:
            continue
        residuals = misfit(seen.take(held_out), fitted).residuals_px
        lengths = np.linalg.norm(residuals, axis=1)
        # Outliers that are left must not decide whether to go on.
        kept = residuals[lengths <= 3.0 * float(np.median(lengths))]
        tried = _Refitted(camera=fitted, held_out_px=float(np.sqrt(np.mean(kept**2))), free=free)
        if best is None or tried.held_out_px < (1.0 - _MIN_GAIN) * best.held_out_px:
            best = tried
    return best


def fitted_pose(
    seen: SeenPoints,
    camera: ViewingCamera,
    lens: _Known | None = None,
) -> ViewingCamera:
    """Return the pose that points agree with, those left out that do not.

    Args:
        seen: the points.
        camera: to start from.
        lens: what of the lens is free, and a camera whose lens is what is known of it beforehand.

    Raises:
        GeometryError: they determine none.
    """
    freedom, prior = (None, None) if lens is None else lens
    for _ in range(3):
        camera = adjust(seen, camera, prior=prior, lens=freedom, soft_limit=2.0).camera
        lengths = misfit(seen, camera).normalised
        good = lengths <= _limit(lengths)
        if good.all() or good.sum() < _LEAST:
            break
        seen = seen.take(good)
    return camera


def _without_misfits(
    pieces: list[TiePiece], camera: ViewingCamera, free: _Known | None = None
) -> list[TiePiece]:
    """Ties that fit one pose; displaced neighbourhoods pass the median of their neighbours."""
    seen = _joined(pieces)
    if len(seen) < _LEAST:
        return pieces
    try:
        lengths = misfit(seen, fitted_pose(seen, camera, free)).normalised
    except GeometryError:
        return pieces
    good = lengths <= _limit(lengths)
    ends = np.cumsum([len(piece) for piece in pieces])
    return [
        piece.take(good[end - len(piece) : end]) for piece, end in zip(pieces, ends, strict=True)
    ]


def _limit(lengths: NDArray[np.float64]) -> float:
    return _REJECTION * float(np.median(lengths)) / MEDIAN_LENGTH


def agrees_around(moved: Displacements) -> NDArray[np.bool_]:
    """Displacements that agree with the median of their neighbours."""
    from scipy.spatial import cKDTree

    count = len(moved.places)
    if count < 4:
        return np.zeros(count, dtype=np.bool_)
    neighbours = min(_NEIGHBOURS, count - 1)
    places = moved.places.astype(np.float64)
    around = np.asarray(cKDTree(places).query(places, k=neighbours + 1)[1])[:, 1:]
    shifts = moved.shift_cells[around]
    median = np.median(shifts, axis=1)
    spread = NMAD_FACTOR * np.median(np.abs(shifts - median[:, None]), axis=1)
    tolerance = np.maximum(_MEDIAN_TOLERANCE_CELLS, 3.0 * spread)
    # Where the neighbours themselves do not agree, nothing can be told apart from chance.
    agrees = (np.abs(moved.shift_cells - median) <= tolerance) & (spread < 2.0)
    return np.asarray(agrees.all(axis=1))


def _unoccupied(
    places: NDArray[np.intp], projection: Projection, occupied: set[tuple[int, int]]
) -> NDArray[np.intp]:
    """Places whose part of the photo no other wall has taken; they take it."""
    side = _OCCUPIED_CELLS * max(projection.pixels_per_cell, 1e-6)
    u = projection.u[places[:, 1], places[:, 0]]
    v = projection.v[places[:, 1], places[:, 0]]
    cells = [(int(a / side), int(b / side)) for a, b in zip(u, v, strict=True)]
    free = np.array([cell not in occupied for cell in cells], dtype=np.bool_)
    occupied.update(cells)
    return places[free]


def _joined(pieces: Sequence[TiePiece]) -> SeenPoints:
    return SeenPoints(
        pixels_photo=np.concatenate([np.empty((0, 2)), *(p.pixels_photo for p in pieces)]),
        points_world=np.concatenate([np.empty((0, 3)), *(p.points_world for p in pieces)]),
        sigma_px=np.concatenate([np.empty(0), *(p.sigma_px for p in pieces)]),
        sigma_m=np.concatenate([np.empty(0), *(p.sigma_m for p in pieces)]),
    )


def between(raster: NDArray[np.float32], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values (n,) at fractional cell indices (n, 2) = (column, row); NaN beside unknown cells."""
    height, width = raster.shape
    inside = (at >= 0.0).all(axis=1) & (at[:, 0] < width - 1) & (at[:, 1] < height - 1)
    left = np.where(inside, at[:, 0], 0.0).astype(np.intp)
    top = np.where(inside, at[:, 1], 0.0).astype(np.intp)
    a, b = at[:, 0] - left, at[:, 1] - top
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    corners = raster[[top, top, below, below], [left, right, left, right]].astype(np.float64)
    weights = np.array([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    values: NDArray[np.float64] = (corners * weights).sum(axis=0)
    return np.where(inside, values, np.nan)


def _footprint(projection: Projection | None) -> int:
    """Visible cells of a wall, in photo pixels, so that walls of any resolution compare."""
    if projection is None:
        return 0
    return int(np.isfinite(projection.u).sum() * projection.pixels_per_cell**2)
