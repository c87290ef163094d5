"""Matching of one photo with all walls, starting from its pose: measure, reject, refit, repeat.

A photo may share too few key points with the laser intensity of a wall for a first pose, but
hundreds with another photo of that wall. For a photo without a pose, a first pose is therefore
computed from matches with the oriented photos, projected onto the walls. The photo is then matched
with the scan like any other photo, so that its ties depend only on the scan.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.files.images import photo_grey
from orthoflow.geometry.cameras import (
    POSE_PARAMETERS,
    LensFreedom,
    ViewingCamera,
    opencv_matrix,
    to_opencv,
)
from orthoflow.geometry.key_points import Features
from orthoflow.geometry.resection import SeenPoints, adjust, misfit
from orthoflow.geometry.robust import MEDIAN_LENGTH, NMAD_FACTOR
from orthoflow.products import Camera, Intrinsics, JsonValue, Photo, Photos, Wall
from orthoflow_plugins.match.channels import (
    WallTarget,
    colour_channels,
    gradient_channels,
    grey_channels,
    textured_places,
)
from orthoflow_plugins.match.displacements import CORRELATION_AREA_CELLS, Displacements, measure
from orthoflow_plugins.match.key_points import PairingParams, pair_photo, sampling, wall_features
from orthoflow_plugins.match.ties import (
    TiePiece,
    joined,
    key_point_ties,
    parted,
    piece_on_wall,
)
from orthoflow_plugins.match.warping import Before, Projection, View, view_of

_Painted = tuple[Wall, Features | None]
"""A wall with the intensity of photos (NaN where no photo shows the wall), and its key points."""


_NEIGHBOURS: Final = 12
_MEDIAN_TOLERANCE_CELLS: Final = 0.6
_REJECTION: Final = 3.5
_HELD_OUT: Final = 4
_LEAST: Final = 12
_MAX_SIGMA_CELLS: Final = 2.0
# Standard deviation due to the interpolation of the raster.
_SIGMA_FLOOR_CELLS: Final = 0.1
_OCCUPIED_CELLS: Final = 5.0
# Search radius of the first round; it is halved in each further round, down to the minimum.
_FIRST_RADIUS_CELLS: Final = 8
_MIN_RADIUS: Final = 2
_MAX_ROUNDS: Final = 4
# A pose is final if its last change displaced the photo by less than this on the walls.
_SETTLED_CELLS: Final = 0.3
# Relative decrease of the held-out error required for another round.
_MIN_GAIN: Final = 0.03
# Channels to compare, in the order in which they are tried. Colours are only tried if the results
# of the others are not clearly good.
_CONTENTS: Final = ("gradients", "grey", "colours")
_FEW_SHARE: Final = 0.25

# Two photos of a wall share hundreds of key points, but fewer than this number may come from a
# repeated motif.
_MIN_AGREEING: Final = 24
_POSE_LIMIT_SHARE: Final = 0.002
_POSE_TRIALS: Final = 2000
_PARAMS: Final = PairingParams()
# A lens may belong to the camera of a photo if its focal length differs from the EXIF value of the
# photo by less than this share.
_NEAR_FOCAL: Final = 0.1


@dataclass(frozen=True, kw_only=True)
class Setup:
    """The walls with which photos are matched, and parameters of the matching.

    Attributes:
        targets: all walls, which may hide one another.
        before: points in front of the walls, None if unknown; cells hidden by these points are not
            matched.
        max_ties: maximum number of positions measured per photo.
        threads: number of threads per photo.
    """

    targets: Sequence[WallTarget]
    before: Before | None = None
    max_ties: int = 1200
    threads: int = 1

    @property
    def walls(self) -> list[Wall]:
        """The walls at the resolution used for matching."""
        return [target.wall for target in self.targets]


@dataclass(frozen=True, kw_only=True)
class Trace:
    """The result of matching a photo with the walls.

    Attributes:
        photo: index of the photo.
        pieces: ties per wall, without outliers.
        n_measured: number of displacements measured in the last round.
        n_outliers: number of rejected displacements.
        held_out_px: RMS residual per coordinate of held-out ties, for each round.
        content: name of the channels used.
        camera: the initial pose.
        settled: the final pose.
    """

    photo: int
    pieces: tuple[TiePiece, ...]
    n_measured: int
    n_outliers: int
    held_out_px: tuple[float, ...]
    content: str
    camera: ViewingCamera
    settled: ViewingCamera

    @property
    def n_ties(self) -> int:
        """Number of ties on all walls."""
        return sum(len(piece) for piece in self.pieces)

    def json(self) -> JsonValue:
        """Return the numbers for the report."""
        return {
            "n_ties": self.n_ties,
            "n_measured": self.n_measured,
            "n_outliers": self.n_outliers,
            "channels": self.content,
            "held_out_px": list(self.held_out_px),
        }


_Round = tuple[list[TiePiece], int]
"""Ties per wall without outliers, and the number of measured displacements."""
_Known = tuple[LensFreedom, ViewingCamera]
"""Free parameters of a lens, and a camera with the prior of the lens."""
_Refitted = tuple[ViewingCamera, float, _Known | None]
"""A pose from the ties of a round; the RMS residual per coordinate of the held-out ties, in pixels;
and the free parameters of the lens.
"""


def trace_photo(
    index: int,
    photo: Photo,
    camera: ViewingCamera,
    setup: Setup,
    lens: LensFreedom | None = None,
) -> Trace:
    """Match a photo with the walls that it shows, until held-out ties no longer improve.

    Args:
        index: index of the photo.
        photo: the photo.
        camera: the initial pose, accurate to a few cells on the walls.
        setup: the walls, and parameters of the matching.
        lens: uncertainty of an estimated lens; with a fixed lens, correct ties that contradict its
            first estimate would be rejected.
    """
    view = view_of(index, photo, camera, setup.walls, setup.before)
    found: tuple[Trace, View] | None = None
    for content in _CONTENTS:
        if content == "colours" and found is not None:
            # If laser and camera differ, grey values match worse than edges or match at only a few
            # positions.
            is_little = found[0].n_ties < _FEW_SHARE * setup.max_ties
            if found[0].content == "grey" and not is_little:
                continue
        # The pose computed with one set of channels is the initial pose for the next set.
        start = (view, _FIRST_RADIUS_CELLS) if found is None else (found[1], _MIN_RADIUS)
        tried = _traced(start, setup, content, lens)
        if found is None or _rank(tried[0]) < _rank(found[0]):
            found = tried
    assert found is not None  # noqa: S101 - there is at least one content
    return replace(found[0], camera=camera)


def estimated_lens(photo: Photo, found: Intrinsics | None) -> LensFreedom | None:
    """Return the uncertainty of a lens estimated in a first orientation.

    Returns:
        The standard deviations, or None if the lens was calibrated or given by the user.
    """
    if photo.intrinsics is not None or found is None or found.source != "estimated":
        return None
    return photo.lens_prior()[1]


def lens_by_ties(trace: Trace, lens: LensFreedom) -> tuple[ViewingCamera, float]:
    """Return the camera adjusted to the ties of a photo, and the standard deviation of ln f.

    Args:
        trace: matching result of the photo.
        lens: free parameters of the lens, including the focal length.
    """
    try:
        found = adjust(joined(trace.pieces), trace.settled, lens=lens, soft_limit=2.0)
    except GeometryError:
        return trace.settled, math.inf
    return found.camera, math.sqrt(found.covariance[POSE_PARAMETERS, POSE_PARAMETERS])


def _rank(trace: Trace) -> tuple[float, int]:
    """Return the held-out error, divided by the spread of the ties and the root of their number."""
    pixels, error = joined(trace.pieces).pixels_photo, math.inf
    if len(pixels) >= _LEAST and trace.held_out_px:
        spread_px = math.sqrt(math.sqrt(max(float(np.linalg.det(np.cov(pixels.T))), 1.0)))
        error = min(trace.held_out_px) / (math.sqrt(len(pixels)) * spread_px)
    return error, -len(pixels)


def _traced(
    start: tuple[View, int],
    setup: Setup,
    content: str,
    lens: LensFreedom | None = None,
) -> tuple[Trace, View]:
    """Match a photo by one set of channels; return the result and the final projection."""
    view, radius = start
    known = None if lens is None else (lens, view.camera)
    best: _Round | None = None
    free: _Known | None = None
    history: list[float] = []
    for _ in range(_MAX_ROUNDS):
        found = _measured(view, setup, radius, content)
        fit = _refitted(joined(found[0]), view.camera, known)
        if fit is None:
            # A round with too few ties does not replace the previous one.
            best = best or found
            break
        camera, held_out_px, freed = fit
        improved = not history or held_out_px < (1.0 - _MIN_GAIN) * min(history)
        history.append(held_out_px)
        if held_out_px <= min(history):
            best, free = found, freed
        if not improved or _moved_cells(found[0], view, camera) < _SETTLED_CELLS:
            break
        view = view.posed(camera, setup.walls)
        radius = max(_MIN_RADIUS, radius // 2)
    pieces, n_measured = best or ([], 0)
    cleaned = _without_misfits(pieces, view.camera, free)
    trace = Trace(
        photo=view.index,
        pieces=tuple(cleaned),
        n_measured=n_measured,
        n_outliers=n_measured - sum(len(piece) for piece in cleaned),
        held_out_px=tuple(history),
        content=content,
        camera=view.camera,
        settled=view.camera,
    )
    return trace, view


def _moved_cells(pieces: list[TiePiece], view: View, refitted: ViewingCamera) -> float:
    """Return the RMS displacement of the ties, in cells, that is due to refitting the pose."""
    squares = []
    for piece in pieces:
        projection = view.projections[piece.wall]
        if projection is None:
            continue
        before, after = (
            camera.project(piece.points_world)[:, :2] for camera in (view.camera, refitted)
        )
        squares.append(((after - before) ** 2).sum(axis=1) / projection.pixels_per_cell**2)
    return float(np.sqrt(np.concatenate(squares).mean()))


def _measured(view: View, setup: Setup, radius: int, content: str) -> _Round:
    targets = setup.targets
    # Visible area of each wall in photo pixels.
    sizes = [
        0 if item is None else int(np.isfinite(item.u).sum() * item.pixels_per_cell**2)
        for item in view.projections
    ]
    occupied: set[tuple[int, int]] = set()
    pieces: list[TiePiece] = []
    n_measured = 0
    # Start with the largest wall. Planes close to each other may contain the same surface, which is
    # then measured on the largest.
    for index in sorted(range(len(targets)), key=lambda k: (-sizes[k], k)):
        projection, target = view.projections[index], targets[index]
        if projection is None or target.wall.intensity is None or sizes[index] == 0:
            continue
        share = sizes[index] / sum(sizes)
        whole, textures = target.gradients if content == "gradients" else target.greys
        channels = whole.part(projection.part)
        usable = (channels.known > 0.0) & np.isfinite(projection.u)
        strength = textures[projection.part]
        places = textured_places(strength, usable, max(50, round(setup.max_ties * share)))
        places = _unoccupied(places, projection, occupied)
        if content == "colours":
            shown = colour_channels(view.colours_on_wall(projection))
        elif content == "grey":
            shown = grey_channels(view.on_wall(index, projection))
        else:
            shown = gradient_channels(view.on_wall(index, projection))
        moved = measure(channels, shown, places, radius, threads=setup.threads)
        n_measured += len(moved.places)
        moved = moved.take(agrees_around(moved))
        grain = target.grain[projection.part]
        pieces.append(_piece(view.index, index, target.wall, (moved, projection), grain))
    pieces.sort(key=lambda piece: piece.wall)
    return pieces, n_measured


def _piece(
    photo: int,
    index: int,
    wall: Wall,
    found: tuple[Displacements, Projection],
    grain: NDArray[np.float32],
) -> TiePiece:
    """Return the ties of one photo with one wall.

    Residuals are correlated for two reasons: filled cells share the error of a measured cell, and
    the smoothing kernel covers several cells. The two effects are independent, so their correlation
    areas are added.
    """
    moved, projection = found
    alone = grain[moved.places[:, 1], moved.places[:, 0]].astype(np.float64)
    wider = np.sqrt((CORRELATION_AREA_CELLS + alone - 1.0) / CORRELATION_AREA_CELLS)
    sigma_cells = np.hypot(moved.sigma_cells * wider, _SIGMA_FLOOR_CELLS)
    piece = piece_on_wall(
        (photo, index),
        wall,
        projection.pixels_at(moved.places + moved.shift_cells),
        moved.places + projection.corner + np.float64(0.5),
        sigma_cells * projection.pixels_per_cell,
    )
    return piece.take(piece.sigma_m < _MAX_SIGMA_CELLS * wall.frame.gsd_m)


def _refitted(
    seen: SeenPoints, camera: ViewingCamera, known: _Known | None = None
) -> _Refitted | None:
    """Return the pose from 3/4 of the ties, and the misfit of the others; None for too few ties.

    The lens is also adjusted if that reduces the misfit of the held-out ties.
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
        # Whether matching continues must not depend on remaining outliers.
        kept = residuals[lengths <= 3.0 * float(np.median(lengths))]
        held_out_px = float(np.sqrt(np.mean(kept**2)))
        if best is None or held_out_px < (1.0 - _MIN_GAIN) * best[1]:
            best = fitted, held_out_px, free
    return best


def fitted_pose(
    seen: SeenPoints,
    camera: ViewingCamera,
    lens: _Known | None = None,
) -> ViewingCamera:
    """Alternately adjust a pose to points and reject outliers.

    Args:
        seen: the points.
        camera: initial camera.
        lens: free parameters of the lens, and a camera with the prior values of these parameters.

    Raises:
        GeometryError: the points do not determine a pose.
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
    """Reject ties that do not fit the pose.

    This removes groups of wrong ties, which a comparison with neighbours does not detect.
    """
    seen = joined(pieces)
    if len(seen) < _LEAST:
        return pieces
    try:
        lengths = misfit(seen, fitted_pose(seen, camera, free)).normalised
    except GeometryError:
        return pieces
    return parted(pieces, lengths <= _limit(lengths))


def _limit(lengths: NDArray[np.float64]) -> float:
    return _REJECTION * float(np.median(lengths)) / MEDIAN_LENGTH


def agrees_around(moved: Displacements) -> NDArray[np.bool_]:
    """Return a mask of the displacements that agree with the median of their neighbours."""
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
    # If neighbours contradict each other, any displacement may agree with them by chance.
    agrees = (np.abs(moved.shift_cells - median) <= tolerance) & (spread < 2.0)
    return np.asarray(agrees.all(axis=1))


def _unoccupied(
    places: NDArray[np.intp], projection: Projection, occupied: set[tuple[int, int]]
) -> NDArray[np.intp]:
    """Select positions in parts of the photo that no other wall uses; mark these as used."""
    side = _OCCUPIED_CELLS * max(projection.pixels_per_cell, 1e-6)
    u = projection.u[places[:, 1], places[:, 0]]
    v = projection.v[places[:, 1], places[:, 0]]
    cells = [(int(a / side), int(b / side)) for a, b in zip(u, v, strict=True)]
    free = np.array([cell not in occupied for cell in cells], dtype=np.bool_)
    occupied.update(cells)
    return places[free]


def recovered_traces(
    photos: Photos,
    oriented: Mapping[str, Camera],
    setup: Setup,
    traces: Sequence[Trace],
    ambiguous: Set[str] = frozenset(),
) -> dict[str, Trace]:
    """Match photos without a pose, starting from poses computed with the matched photos.

    Args:
        photos: all photos.
        oriented: cameras of the photos with a pose, by name.
        setup: the walls, and parameters of the matching.
        traces: results of the oriented photos.
        ambiguous: names of photos that are not matched, since they show one of several identical
            walls.

    Returns:
        Results of the photos whose pose was found, by name.
    """
    recovered: dict[str, Trace] = {}
    known = [trace for trace in traces if trace.n_ties]
    settled = _settled(photos, oriented, known)
    left_out = oriented.keys() | ambiguous
    missing = [k for k, photo in enumerate(photos.photos) if photo.name not in left_out]
    views = [_view(trace, photos, setup) for trace in known] if missing else []
    is_new = bool(known)
    while is_new and missing:
        painted = painted_walls(views, setup.walls)
        n_before = len(recovered)
        for index in missing:
            photo = photos.photos[index]
            lens = lens_of(photo, settled, photos)
            pose = None
            if lens is not None:
                pose = recovered_pose(photo_grey(photo), painted, lens.posed())
            if pose is None:
                continue
            found = trace_photo(index, photo, pose, setup, estimated_lens(photo, lens))
            if found.n_ties:
                recovered[photo.name] = found
                views.append(_view(found, photos, setup))
        missing = [k for k in missing if photos.photos[k].name not in recovered]
        is_new = len(recovered) > n_before
    return recovered


def _settled(
    photos: Photos, oriented: Mapping[str, Camera], traces: Sequence[Trace]
) -> dict[str, Camera]:
    """Return the cameras of matched photos by name, starting with the most precise focal length.

    Estimated lenses are adjusted to the new ties.
    """
    cameras: list[tuple[float, Camera]] = []
    for trace in traces:
        photo = photos.photos[trace.photo]
        camera, sigma = oriented[photo.name], 0.0
        freedom = estimated_lens(photo, camera.intrinsics)
        if freedom is not None:
            found, sigma = lens_by_ties(trace, freedom)
            lens = Intrinsics.of(found, source="estimated")
            camera = replace(camera, intrinsics=lens)
        cameras.append((sigma, camera))
    cameras.sort(key=lambda each: each[0])
    return {camera.photo: camera for _, camera in cameras}


def _view(trace: Trace, photos: Photos, setup: Setup) -> View:
    """Project a photo with its final pose, hiding the cells that were hidden at its first pose."""
    photo = photos.photos[trace.photo]
    first = view_of(trace.photo, photo, trace.camera, setup.walls, setup.before)
    return first.posed(trace.settled, setup.walls)


def painted_walls(views: Sequence[View], walls: Sequence[Wall]) -> list[_Painted]:
    """Project oriented photos onto the walls; the photo with the highest resolution is used."""
    painted = []
    for index, wall in enumerate(walls):
        grey = np.full(wall.frame.shape, np.nan, dtype=np.float32)
        shown_by = [
            (view, projection)
            for view in views
            if (projection := view.projections[index]) is not None
        ]
        for view, projection in sorted(shown_by, key=lambda each: each[1].pixels_per_cell):
            shown = view.on_wall(index, projection)
            part = grey[projection.part]
            part[np.isfinite(shown)] = shown[np.isfinite(shown)]
        as_shown = replace(wall, intensity=grey / np.float32(255.0))
        painted.append((as_shown, wall_features(as_shown, _PARAMS.max_features)))
    return painted


def recovered_pose(
    grey: NDArray[np.uint8],
    painted: Sequence[_Painted],
    lens: ViewingCamera,
) -> ViewingCamera | None:
    """Compute the pose of a photo from matches with projected photos; None for too few matches.

    Args:
        grey: (height, width) grey values of the photo.
        painted: the walls with the projected photos.
        lens: approximate interior orientation of the photo; its pose is ignored.
    """
    pairs = pair_photo(grey, [features for _, features in painted], _PARAMS)
    pieces = []
    for pair in pairs.pairs:
        wall, features = painted[pair.wall]
        if pair.is_shown and features is not None:
            matches = pair.matches.take(pair.agreeing)
            sets = (pairs.features.take(matches.first), features.take(matches.second))
            pieces.append(key_point_ties((0, pair.wall), wall, sets, scale=pairs.scale))
    seen = joined(pieces)
    if len(seen) < _MIN_AGREEING:
        return None
    return pose_of_most(
        seen.pixels_photo, seen.points_world, lens, _POSE_LIMIT_SHARE * max(grey.shape)
    )


def lens_of(photo: Photo, oriented: Mapping[str, Camera], photos: Photos) -> Intrinsics | None:
    """Return the lens of a photo: calibrated, or estimated for another photo by the same camera.

    The estimate is preferred to EXIF values, which may be wrong for all photos taken with the same
    lens.

    Returns:
        The lens, or None if it is neither calibrated nor estimated.
    """
    focal_px = {each.name: each.exif_focal_px for each in photos.photos}
    similar = [
        camera.intrinsics
        for name, camera in oriented.items()
        if camera.intrinsics is not None
        and (camera.intrinsics.width, camera.intrinsics.height) == (photo.width, photo.height)
        and (
            photo.exif_focal_px is None
            or focal_px.get(name) == photo.exif_focal_px
            or abs(camera.intrinsics.fx / photo.exif_focal_px - 1.0) < _NEAR_FOCAL
        )
    ]
    return photo.intrinsics or next(iter(similar), None)


def pose_of_most(
    pixels: NDArray[np.float64],
    points: NDArray[np.float64],
    lens: ViewingCamera,
    limit_px: float,
) -> ViewingCamera | None:
    """Return the pose with the most inliers, or None if there are too few."""
    import cv2

    params = sampling(limit_px, trials=_POSE_TRIALS)
    middle = points.mean(axis=0)
    matrix = opencv_matrix(lens)
    observed = to_opencv(pixels)[:, None]
    straight: Any = cv2.undistortPoints(observed, matrix, lens.distortion, P=matrix)
    call: Any = cv2.solvePnPRansac
    found, _, turn, shift, agreed = call(
        points - middle, straight[:, 0], matrix, None, params=params
    )
    if not found or agreed is None or len(agreed) < _MIN_AGREEING:
        return None
    return lens.at_opencv_pose(turn, shift, middle)
