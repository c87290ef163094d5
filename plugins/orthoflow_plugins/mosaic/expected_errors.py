"""Expected error, per cell, of the position of a point measured in an orthoimage.

Three independent causes displace the content of a cell along the wall. The first is the error of
the pose of the photo (its covariance, propagated to the wall). The second is the error of the depth
of the cell, times the tangent of the viewing angle. The third is unknown and is estimated from the
displacements between overlapping photos that the first two causes do not explain. Overlaps separate
depth errors from the third cause, because depth errors displace photos taken from different sides
in different directions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.bands import Allocate, row_bands
from orthoflow.geometry.robust import NMAD_FACTOR, depth_noise_m
from orthoflow.products import Camera, Cameras, SurfaceMask, TieRole, Wall
from orthoflow_plugins.mosaic.agreement import Overlaps

if TYPE_CHECKING:
    from orthoflow.geometry import WallFrame

# Pose errors vary smoothly, so they are computed at this many nodes per side, and interpolated
# linearly between the nodes.
_NODES: Final = 48
# Noise of phase correlation: 0.06 and 0.07 cells were measured in a simulated room with pose errors
# of 0.01 cells.
_PARALLAX_NOISE_CELLS: Final = 0.065
_LEAST_OVERLAPS: Final = 10
# Tangent of the maximum viewing angle, 84 degrees.
_MOST_TANGENT: Final = 10.0
# A cell with a larger spread, in standard deviations of a point, contains points of several
# surfaces. In simulated rooms, apses and columns, cells with a spread of 2 to 3 are as accurate as
# those with less, and the errors of cells with a larger spread are about as large as the spread.
_SPREAD_TIMES: Final = 3.0
# Variance of a linear interpolation in a triangle, relative to that of its corners: the mean of the
# squared weights. 0.2 to 0.4 was measured, because triangles overlap.
_BETWEEN_SHARE: Final = 0.5
# If neighbouring cells differ by less than this share of what the spread of their points predicts,
# the depths have been smoothed. It is 0.01 to 0.04 for the surface `denoised`, about 1 otherwise.
_SMOOTHED_SHARE: Final = 0.5
# Distance beyond which errors of smoothed depths are independent; correlation 0.08 for the surface
# `denoised`.
_SMOOTHED_CELLS: Final = 9
# Cells from which the noise is estimated, in bands of rows.
_NOISE_CELLS: Final = 1 << 23
_NOISE_ROWS: Final = 256
# Depth errors of clouds from photos are correlated over this distance.
_PATCH_M: Final = 0.05
# Depth errors count as correlated if depth differences over this distance exceed those between
# neighbouring cells by this factor. Relief of rooms explains a factor of up to 1.35. For example,
# the depths of neighbouring and of distant cells differ by 0.98 and 1.3 mm in the simulated room,
# by 1.2 and 2.4 mm in a stuccoed hall, and by 1.7 and 5.2 mm in a stereo cloud of a fountain.
_PATCHY_TIMES: Final = 1.5
# Depth errors can be estimated from overlaps if the tangents of the two viewing angles differ by at
# least _LEAST_TANGENTS in at least _LEAST_SLANTED patches.
_LEAST_TANGENTS: Final = 0.3
_LEAST_SLANTED: Final = 20
# Displacements of more than this many standard deviations are false matches.
_OUTLIER: Final = 3.0
_ROUNDS: Final = 8


def ties_on(cameras: Cameras | None, number: int) -> tuple[int, int]:
    """Count the control and check points of the photos on a wall.

    Args:
        cameras: orientations, including the ties from which they were computed.
        number: number of the wall.
    """
    ties = None if cameras is None else cameras.ties
    if ties is None:
        return 0, 0
    numbers = np.array([ties.number(index) for index in range(int(ties.wall.max(initial=-1)) + 1)])
    known = ties.wall >= 0
    mine = np.zeros(len(ties.wall), dtype=np.bool_)
    mine[known] = numbers[ties.wall[known]] == number
    return (
        int(np.count_nonzero(mine & (ties.role == TieRole.CONTROL))),
        int(np.count_nonzero(mine & (ties.role == TieRole.CHECK))),
    )


def expected_errors_m(
    wall: Wall,
    source: NDArray[np.int16],
    sources: Sequence[str],
    cameras: Mapping[str, Camera],
    overlaps: Overlaps,
    *,
    allocate: Allocate,
) -> NDArray[np.float32]:
    """Predict the error of each cell: the standard deviation of u, and of v, in metres.

    Args:
        wall: surface of the wall.
        source: (rows, cols) index of the photo used for each cell, -1 if none.
        sources: names of the photos.
        cameras: camera of each oriented photo by name; without a covariance, the error is unknown.
        overlaps: displacements between overlapping photos.
        allocate: function that allocates the result.

    Returns:
        (rows, cols), NaN where no photo is used or the error of the photo is unknown.
    """
    frame = wall.frame
    errors_m = np.asarray(allocate("error_m", frame.shape, np.float32), np.float32)
    errors_m[...] = np.nan
    step = max(1, -(-max(frame.shape) // _NODES))
    nodes = _node_places(frame, step)
    depths_m = np.nan_to_num(
        wall.depth_m[
            np.minimum(nodes[..., 1].astype(np.intp), frame.height - 1),
            np.minimum(nodes[..., 0].astype(np.intp), frame.width - 1),
        ].astype(np.float64)
    )
    noises = _depth_noises(wall)
    excess = _excess_of_overlaps(wall, cameras, overlaps)
    position_m, depth_m = (0.0, None) if excess is None else excess
    if depth_m is not None:
        # Within 5 cm, relief looks like correlated errors, but overlaps distinguish between the
        # two.
        noises = noises._replace(shared_m=depth_m)
    for index, name in enumerate(sources):
        camera = cameras.get(name)
        if camera is None or camera.covariance is None:
            continue
        of_pose = _pose_variances(camera, frame, nodes, depths_m)
        if of_pose is None:
            continue
        centre_world = camera.viewing().centre_world
        for rows in row_bands(frame.shape):
            mine = source[rows] == index
            down, across = np.nonzero(mine)
            if not len(down):
                continue
            down = down + rows.start
            variances = _between(of_pose, down, across, step)
            variances += _depth_variances(wall, down, across, centre_world, noises)
            errors_m[down, across] = np.sqrt(variances + position_m**2)
    return errors_m


def _node_places(frame: WallFrame, step: int) -> NDArray[np.float64]:
    """Return the columns and rows (r, c, 2) of the nodes, i.e. the centres of blocks."""
    rows, columns = ((np.arange(-(-size // step)) + 0.5) * step for size in frame.shape)
    return np.stack(np.meshgrid(columns, rows), axis=-1)


def _pose_variances(
    camera: Camera, frame: WallFrame, nodes: NDArray[np.float64], depths_m: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return the variances (r, c) of a wall coordinate due to the pose of a photo, in m²."""
    from orthoflow.geometry.cameras import LensFreedom, linearised
    from orthoflow.geometry.resection import moved_origin, pixels_by_point

    if camera.covariance is None:
        return None
    viewing, middle = camera.viewing(), frame.origin_world
    # Use coordinates relative to the wall. In survey coordinates, effects of rotations and shifts
    # almost cancel out, which loses precision.
    to_local = np.linalg.inv(moved_origin(viewing, middle, 6))
    covariance = to_local @ camera.covariance @ to_local.T
    near = viewing.shifted(middle)
    points = frame.world_from_wall(nodes.reshape(-1, 2), depths_m.ravel()) - middle
    pixels = near.project(points)[:, :2]
    in_front = (points @ near.rotation[2] + near.translation[2]) > 0.0
    shown = np.isfinite(pixels).all(axis=1) & in_front
    if not shown.any():
        return None
    variances = np.full(len(points), np.nan)
    axes = np.array([frame.u_world, frame.v_world])
    if frame.bend is not None:
        axes = frame.axes_at(nodes.reshape(-1, 2)[shown])[:, :2]
    by_pose = linearised(near, points[shown], LensFreedom()).by_parameters
    wall_by_pixel = np.linalg.pinv(pixels_by_point(near, points[shown]) @ np.swapaxes(axes, -1, -2))
    by_pose = wall_by_pixel @ by_pose
    variances[shown] = 0.5 * np.einsum("nij,jk,nik->n", by_pose, covariance, by_pose)
    inside = near.sees(pixels) & shown
    if camera.sigma_wall_m is not None and inside.any():
        # If a lens was estimated with the pose, the covariance includes the parameters of that
        # lens.
        stated = camera.sigma_wall_m**2 / float(np.median(variances[inside]))
        variances *= max(1.0, stated)
    known = np.isfinite(variances)
    variances[~known] = variances[known].max()
    return variances.reshape(nodes.shape[:2])


def _between(
    values: NDArray[np.float64], rows: NDArray[np.intp], columns: NDArray[np.intp], step: int
) -> NDArray[np.float64]:
    """Interpolate values at cells (n,) linearly between nodes; constant beyond the outer nodes."""
    places, shares = [], []
    for cells, size in zip((rows, columns), values.shape, strict=True):
        place = np.clip((cells + 0.5) / step - 0.5, 0.0, size - 1.0)
        first = np.minimum(place.astype(np.intp), max(0, size - 2))
        places.append((first, np.minimum(first + 1, size - 1)))
        shares.append(place - first)
    (top, bottom), (left, right) = places
    down, across = shares
    upper = values[top, left] * (1.0 - across) + values[top, right] * across
    lower = values[bottom, left] * (1.0 - across) + values[bottom, right] * across
    return np.asarray(upper * (1.0 - down) + lower * down, dtype=np.float64)


class _DepthNoises(NamedTuple):
    """Standard deviations of depths, in metres.

    Attributes:
        measured_m: noise of single measured depths.
        interpolated_m: noise of single interpolated depths.
        shared_m: error that neighbouring depths share; 0 if none.
        point_m: spread of the points in a cell on a single surface; 0 if unknown.
    """

    measured_m: float
    interpolated_m: float
    shared_m: float
    point_m: float


def _depth_noises(wall: Wall) -> _DepthNoises:
    """Estimate the noise of depths from measured cells.

    Interpolated cells are not used: their neighbours are interpolated between the same points.
    """
    every = max(1, -(-wall.depth_m.size // _NOISE_CELLS))
    rows = np.flatnonzero(np.arange(wall.frame.height) // _NOISE_ROWS % every == 0)
    is_measured = wall.mask[rows] == SurfaceMask.MEASURED
    depth_m = np.where(is_measured, wall.depth_m[rows], np.float32(np.nan))
    several = is_measured & (wall.count[rows] > 1) & np.isfinite(wall.sigma_m[rows])
    n_points = wall.count[rows][several].astype(np.float64)
    point_m = mean_m = 0.0
    if len(n_points):
        # The median of chi-square with n degrees of freedom is n (1 - 2 / (9 n))^3 (Wilson and
        # Hilferty 1931).
        spreads_m = wall.sigma_m[rows][several] / (1.0 - 2.0 / (9.0 * (n_points - 1.0))) ** 1.5
        point_m, mean_m = np.median([spreads_m, spreads_m / np.sqrt(n_points)], axis=1).tolist()
    noise_m = depth_noise_m(depth_m)
    between_m = float(np.sqrt(_BETWEEN_SHARE)) * noise_m
    if noise_m <= _SMOOTHED_SHARE * mean_m:
        noise_m = between_m = depth_noise_m(depth_m[::_SMOOTHED_CELLS, ::_SMOOTHED_CELLS])
    step = max(1, round(_PATCH_M / wall.frame.gsd_m))
    apart_m = depth_noise_m(depth_m[::step, ::step])
    is_patchy = apart_m > _PATCHY_TIMES * noise_m
    shared_m = float(np.sqrt(apart_m**2 - noise_m**2)) if is_patchy else 0.0
    return _DepthNoises(noise_m, between_m, shared_m, point_m)


def _depth_variances(
    wall: Wall,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    centre_world: NDArray[np.float64],
    noises: _DepthNoises,
) -> NDArray[np.float64]:
    """Return variances (n,), in m², of a wall coordinate due to depth errors.

    The viewer is at `centre_world` (3,).
    """
    depths_m = np.nan_to_num(wall.depth_m[rows, columns].astype(np.float64))
    places = np.column_stack([columns, rows]).astype(np.float64) + 0.5
    beside_m, before_m = _seen_from(centre_world, wall.frame, places, depths_m)
    squares = np.minimum((beside_m**2).sum(axis=1) / before_m**2, _MOST_TANGENT**2)
    spread_m = np.nan_to_num(wall.sigma_m[rows, columns].astype(np.float64))
    sigma_m = np.where(spread_m > _SPREAD_TIMES * noises.point_m, spread_m, noises.measured_m)
    sigma_m[wall.mask[rows, columns] == SurfaceMask.RECOVERED] = noises.interpolated_m
    return np.asarray(0.5 * squares * (sigma_m**2 + noises.shared_m**2), dtype=np.float64)


def _seen_from(
    centre_world: NDArray[np.float64],
    frame: WallFrame,
    places: NDArray[np.float64],
    depths_m: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distances of places from a camera along u and v (n, 2), and in front of them (n,)."""
    if frame.bend is None:
        centre = frame.wall_from_world(centre_world[None])[0]
        beside_m = frame.gsd_m * (places - centre[:2])
        before_m = centre[2] - depths_m
    else:
        rays = frame.world_from_wall(places, depths_m) - centre_world
        local = np.einsum("nij,nj->ni", frame.axes_at(places), rays)
        beside_m, before_m = local[:, :2], -local[:, 2]
    return beside_m, np.maximum(before_m, 1e-3)


def _excess_of_overlaps(
    wall: Wall, cameras: Mapping[str, Camera], overlaps: Overlaps
) -> tuple[float, float | None] | None:
    """Separate pose errors from depth errors by means of displacements; None if there are too few.

    The expected squared displacement is the sum of the variances of both poses, twice the
    additional variance of a pose, and the depth variance times the squared difference between the
    tangents of the two viewing angles. The two unknown variances are estimated by weighted
    non-negative least squares, without outliers.

    Returns:
        The additional standard deviation of a coordinate in one photo, and the standard deviation
        of depths over a patch; the latter is None if the viewing directions differ too little.
    """
    from scipy.optimize import nnls

    known = {
        name: _views_of(wall, cameras[name], overlaps.centres)
        for name in {name for pair in overlaps.photos for name in pair}
        if name in cameras and cameras[name].covariance is not None
    }
    rows = [
        (place, known[first], known[second])
        for place, (first, second) in enumerate(overlaps.photos)
        if first in known and second in known
    ]
    if len(rows) < _LEAST_OVERLAPS:
        return None
    places = np.array([place for place, _, _ in rows])
    stated = np.array([one[0][place] + other[0][place] for place, one, other in rows])
    apart = np.array([one[1][place] - other[1][place] for place, one, other in rows])
    gsd_m = wall.frame.gsd_m
    squares = (gsd_m * overlaps.shifts_cells[places]) ** 2
    fixed = stated[:, None] + (_PARALLAX_NOISE_CELLS * gsd_m) ** 2
    finite = np.isfinite(squares + fixed + apart).all(axis=1)
    squares, fixed, apart = squares[finite], fixed[finite], apart[finite]
    n_slanted = np.count_nonzero(np.linalg.norm(apart, axis=1) > _LEAST_TANGENTS)
    columns = [np.full(squares.size, 2.0)]
    if n_slanted >= _LEAST_SLANTED:
        columns.append((apart**2).ravel())
    matrix, wanted = np.column_stack(columns), squares.ravel()
    known_part = np.broadcast_to(fixed, squares.shape).ravel()
    # The absolute values of half of all normally distributed displacements are below 0.67 standard
    # deviations.
    predicted = np.full(len(wanted), max(float(np.median(wanted)) * NMAD_FACTOR**2, 1e-12))
    found = np.zeros(len(columns))
    for _ in range(_ROUNDS):
        kept = wanted <= _OUTLIER**2 * predicted
        if np.count_nonzero(kept) < _LEAST_OVERLAPS:
            return None
        weights = 1.0 / predicted[kept]
        found, _ = nnls(matrix[kept] * weights[:, None], (wanted - known_part)[kept] * weights)
        predicted = np.maximum(known_part + matrix @ found, 1e-12)
    position_m, *depth_m = np.sqrt(found).tolist()
    return position_m, depth_m[0] if depth_m else None


def _views_of(
    wall: Wall, camera: Camera, centres: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pose variances (n,) of a coordinate, m², and tangents (n, 2) of the view angles."""
    frame = wall.frame
    depths_m = np.nan_to_num(
        wall.depth_m[centres[:, 1].astype(np.intp), centres[:, 0].astype(np.intp)].astype(float)
    )
    variances = _pose_variances(camera, frame, centres[:, None], depths_m[:, None])
    beside_m, before_m = _seen_from(camera.viewing().centre_world, frame, centres, depths_m)
    tangents = beside_m / before_m[:, None]
    if variances is None:
        variances = np.full((len(centres), 1), np.nan)
    return variances[:, 0], tangents
