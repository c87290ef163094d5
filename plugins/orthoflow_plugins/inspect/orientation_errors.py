"""True errors of estimated cameras and their ties, which residuals cannot reveal.

Cameras are compared with the true cameras by position, by angle, and by projection onto the wall.
Ties are compared with the scene points that their pixels actually show.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError, MethodError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.resection import pixels_by_point
from orthoflow.geometry.scenes import Scene
from orthoflow.products import (
    Camera,
    Cameras,
    Finding,
    JsonValue,
    TieRole,
    Ties,
    Truth,
    Wall,
    Walls,
)
from orthoflow_plugins.inspect.findings import Number, findings_of, rms

if TYPE_CHECKING:
    from orthoflow.geometry.scene_views import SceneCameras, SeenPoints

_GRID: Final = (24, 18)
# Surfaces that are not parallel to the wall, such as the sides of mouldings, are ignored.
_LEAST_COSINE: Final = 0.9
# So are surfaces seen at more oblique angles, as in predicted errors (`orient.gates`): at the
# outline of a column, the error along the wall has no bound.
_GRAZING_COSINE: Final = 0.1
# An accepted orientation is wrong if its error exceeds this many predicted standard deviations.
_WRONG_SIGMAS: Final = 5.0
# A tie is wrong if its error exceeds this many cells of the wall.
_WRONG_CELLS: Final = 1.5
# Number of rays along the longer side of a photo that are traced to find the wall that covers most
# of the photo.
_RAYS: Final = 32


@dataclass(frozen=True, kw_only=True)
class PoseError:
    """The errors of the orientation of one photo.

    Attributes:
        photo: name of the photo.
        status: `ok`, or the reason why the photo is not oriented; in that case, the errors are
            None.
        centre_m: distance in metres between the estimated and the true projection centre.
        rotation_deg: angle between the estimated and the true orientation.
        wall_m: error of one coordinate on the walls, as RMS over the visible area; None if the
            photo shows no wall, infinite if the estimated camera does not show the wall.
        sigma_wall_m: predicted value of `wall_m`, or None.
    """

    photo: str
    status: str
    centre_m: float | None = None
    rotation_deg: float | None = None
    wall_m: float | None = None
    sigma_wall_m: float | None = None

    @property
    def is_wrong(self) -> bool:
        """Whether the error of an accepted pose exceeds 5 predicted standard deviations."""
        if self.status != "ok" or self.wall_m is None:
            return False
        stated = math.inf if self.sigma_wall_m is None else self.sigma_wall_m
        return math.isinf(self.wall_m) or self.wall_m > _WRONG_SIGMAS * stated


def true_camera(truth: Truth, photo: str) -> ViewingCamera:
    """Return the true camera of a photo.

    Raises:
        MethodError: the truth does not contain the photo.
    """
    cameras = () if truth.cameras is None else truth.cameras.cameras
    for camera in cameras:
        if camera.photo == photo:
            return camera.viewing()
    raise MethodError(
        f"the truth does not contain the photo {photo}: connect the cameras of the simulated photos"
    )


def pose_errors(
    cameras: Cameras, walls: Walls, truth: Truth, views: SceneCameras
) -> tuple[PoseError, ...]:
    """Compare the orientation of each photo with the truth, on the walls and within their buffers.

    Raises:
        MethodError: the truth does not contain a photo.
    """
    return tuple(
        PoseError(photo=camera.photo, status=camera.status)
        if camera.status != "ok"
        else _pose_error(camera, true_camera(truth, camera.photo), walls, truth.scene, views)
        for camera in cameras.cameras
    )


def pose_findings(errors: Sequence[PoseError]) -> list[Finding]:
    """Compute statistics of all photos; maxima and medians only include oriented photos."""
    good = [error for error in errors if error.status == "ok"]
    centres = [1e3 * error.centre_m for error in good if error.centre_m is not None]
    angles = [error.rotation_deg for error in good if error.rotation_deg is not None]
    known = [error for error in good if error.wall_m is not None and math.isfinite(error.wall_m)]
    on_wall = [1e3 * error.wall_m for error in known if error.wall_m is not None]
    ratios = [
        error.wall_m / error.sigma_wall_m
        for error in known
        if error.wall_m is not None and error.sigma_wall_m
    ]
    numbers: list[Number] = [
        ("n_photos", len(errors), "1"),
        ("n_oriented", len(good), "1"),
        ("n_misoriented", sum(error.is_wrong for error in errors), "1"),
    ]
    for name, values, unit in (
        ("pose_centre", centres, "mm"),
        ("pose_rotation", angles, "deg"),
        ("pose_wall", on_wall, "mm"),
    ):
        if values:
            numbers += [
                (f"{name}_max_{unit}", max(values), unit),
                (f"{name}_median_{unit}", np.median(values), unit),
            ]
    if on_wall:
        numbers.append(("pose_wall_rms_mm", rms(on_wall), "mm"))
    if ratios:
        numbers.append(("pose_error_over_sigma", rms(ratios), "1"))
    return findings_of(numbers)


def pose_details(errors: Sequence[PoseError]) -> list[JsonValue]:
    """Return the errors of each photo as JSON."""
    return [
        {
            "photo": error.photo,
            "status": error.status,
            "centre_mm": _scaled(error.centre_m),
            "rotation_deg": error.rotation_deg,
            "wall_mm": _scaled(error.wall_m),
            "sigma_wall_mm": _scaled(error.sigma_wall_m),
        }
        for error in errors
    ]


def tie_findings(cameras: Cameras, walls: Walls, truth: Truth) -> list[Finding]:
    """Compute the share of wrong ties among all ties, and among those that the orientation kept."""
    ties = cameras.ties
    if ties is None or not len(ties.photo) or not _of_these(ties, walls.walls):
        return []
    errors = tie_errors_cells(ties, walls, truth)
    own = _with_own_wall(ties, walls, truth)
    kept = ties.role != TieRole.REJECTED
    is_wrong = errors > _WRONG_CELLS
    numbers = [("match_wrong_share", is_wrong.mean()), ("n_ties_kept", kept.sum())]
    if own.any():
        numbers.append(("match_wrong_share_own_wall", is_wrong[own].mean()))
    if kept.any():
        numbers.append(("tie_wrong_share", is_wrong[kept].mean()))
    return findings_of((*number, "1") for number in numbers)


def tie_errors_cells(ties: Ties, walls: Walls, truth: Truth) -> NDArray[np.float64]:
    """Return distances (n,), in wall cells, between ties and the points that their pixels show.

    Distances are measured in the plane of the wall with the linearised true camera. They are
    infinite for points behind the true camera.

    Raises:
        MethodError: the truth does not contain a photo.
    """
    errors = np.full(len(ties.photo), np.inf)
    for photo in np.unique(ties.photo):
        camera = true_camera(truth, ties.photo_names[photo])
        for index in np.unique(ties.wall[ties.photo == photo]):
            mine = np.flatnonzero((ties.photo == photo) & (ties.wall == index))
            frame = walls.walls[index].frame
            points = ties.points_world[mine]
            axes = np.vstack([frame.u_world, frame.v_world])
            if frame.bend is not None:
                axes = frame.axes_at(frame.wall_from_world(points)[:, :2])[:, :2]
            off_px = ties.pixels_photo[mine] - camera.project(points)[:, :2]
            pixels_by_plane = pixels_by_point(camera, points) @ np.swapaxes(axes, -1, -2)
            seen = np.asarray(np.isfinite(off_px).all(axis=1), dtype=np.bool_)
            seen[seen] = np.linalg.det(pixels_by_plane[seen]) != 0.0
            off_m = np.linalg.solve(pixels_by_plane[seen], off_px[seen, :, None])[:, :, 0]
            errors[mine[seen]] = np.linalg.norm(off_m, axis=1) / frame.gsd_m
    return errors


def most_shown(camera: ViewingCamera, walls: Sequence[Wall]) -> int:
    """Return the index of the wall that covers most of a photo, or -1 if it shows no wall."""
    step = max(camera.width, camera.height) / _RAYS
    grid = np.meshgrid(
        np.arange(0.5 * step, camera.width, step), np.arange(0.5 * step, camera.height, step)
    )
    rays = camera.rays_world(np.column_stack([axis.ravel() for axis in grid]))
    nearest, shown = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for index, wall in enumerate(walls):
        frame, centre = wall.frame, camera.centre_world
        if frame.bend is not None:
            apart = np.linalg.norm(frame.met_by(centre, rays) - centre, axis=1)
            along = apart / np.linalg.norm(rays, axis=1)
            hit = np.flatnonzero(along < nearest)
            nearest[hit], shown[hit] = along[hit], index
            continue
        if float((centre - frame.origin_world) @ frame.normal_world) <= 0.0:
            continue
        with np.errstate(divide="ignore"):
            along = ((frame.origin_world - centre) @ frame.normal_world) / (
                rays @ frame.normal_world
            )
        ahead = np.flatnonzero((along > 0.0) & (along < nearest))
        cells = frame.wall_from_world(centre + along[ahead, None] * rays[ahead])[:, :2]
        hit = ahead[((cells >= 0.0) & (cells < [frame.width, frame.height])).all(axis=1)]
        nearest[hit], shown[hit] = along[hit], index
    counts = np.bincount(shown + 1, minlength=1 + len(walls))
    counts[0] = 0
    return int(counts.argmax()) - 1


def _pose_error(
    camera: Camera, true: ViewingCamera, walls: Walls, scene: Scene, views: SceneCameras
) -> PoseError:
    found = camera.viewing()
    return PoseError(
        photo=camera.photo,
        status=camera.status,
        centre_m=float(np.linalg.norm(found.centre_world - true.centre_world)),
        rotation_deg=_angle_deg(found.rotation @ true.rotation.T),
        wall_m=error_on_walls(found, true, walls, scene, views),
        sigma_wall_m=camera.sigma_wall_m,
    )


def _angle_deg(rotation: NDArray[np.float64]) -> float:
    """Return the angle of a rotation, computed from the sine, which is precise for small angles."""
    axis = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    return math.degrees(math.atan2(float(np.linalg.norm(axis)), float(np.trace(rotation)) - 1.0))


def error_on_walls(
    found: ViewingCamera, true: ViewingCamera, walls: Walls, scene: Scene, views: SceneCameras
) -> float | None:
    """Compare where the two cameras project a grid of pixels onto the true surfaces.

    Returns:
        RMS of a coordinate in metres; None if the true camera shows no wall, infinite if the
        estimated camera does not show the same surfaces.
    """
    columns, rows = ((np.arange(n) + 0.5) / n for n in _GRID)
    grid = np.stack(np.meshgrid(columns * true.width, rows * true.height), axis=-1).reshape(-1, 2)
    seen = views.trace(true, grid)
    chosen = _on_walls(seen, walls, scene)
    if not chosen.any():
        return None
    points = seen.points[chosen]
    normal = scene.normals_at(seen.rectangle[chosen], points.T)
    from_camera = points - (true.centre_world - scene.origin)
    cosine = np.einsum("ij,ij->i", normal, from_camera) / np.linalg.norm(from_camera, axis=1)
    is_facing = np.abs(cosine) >= _GRAZING_COSINE
    points, normal, pixels = points[is_facing], normal[is_facing], grid[chosen][is_facing]
    if not len(points):
        return None
    camera = found.shifted(scene.origin)
    try:
        rays = camera.rays_world(pixels)
    except GeometryError:
        return math.inf
    facing = np.einsum("ij,ij->i", normal, rays)
    ahead = np.einsum("ij,ij->i", normal, points - camera.centre_world)
    if np.any(facing * ahead <= 0.0):
        return math.inf
    off = camera.centre_world + (ahead / facing)[:, None] * rays - points
    # The squared length is the sum over two coordinates, so half of it is the mean square of one.
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1)) / 2.0))


def _on_walls(seen: SeenPoints, walls: Walls, scene: Scene) -> NDArray[np.bool_]:
    """Return a mask of the points in the raster and buffer of a wall on surfaces parallel to it."""
    on_walls = np.zeros(len(seen.points), dtype=np.bool_)
    hit = seen.rectangle >= 0
    normals = scene.normals_at(seen.rectangle[hit], seen.points[hit].T)
    for index in range(len(walls.walls)):
        slab = walls.slab(index)
        frame = slab.frame
        if frame.bend is not None:
            on_wall = frame.wall_from_world(seen.points[hit] + scene.origin)
            columns, rows = frame.gsd_m * on_wall[:, 0], frame.gsd_m * on_wall[:, 1]
            depths, on_front = on_wall[:, 2], frame.axes_at(on_wall[:, :2])[:, 2]
            facing = np.abs(np.einsum("ij,ij->i", normals, on_front))
        else:
            relative = seen.points[hit] - (frame.origin_world - scene.origin)
            columns, rows = relative @ frame.u_world, relative @ frame.v_world
            depths = relative @ frame.normal_world
            facing = np.abs(normals @ frame.normal_world)
        on_walls[hit] |= (
            (facing > _LEAST_COSINE)
            & (columns > 0.0)
            & (columns < frame.gsd_m * frame.width)
            & (rows > 0.0)
            & (rows < frame.gsd_m * frame.height)
            & (depths < slab.front_m)
            & (depths > -slab.behind_m)
        )
    return on_walls


def _scaled(metres: float | None) -> float | None:
    return None if metres is None or math.isinf(metres) else 1e3 * metres


def _with_own_wall(ties: Ties, walls: Walls, truth: Truth) -> NDArray[np.bool_]:
    """Return a mask (n,) of the ties on the wall that covers most of the photo."""
    most = [
        most_shown(true_camera(truth, name), walls.walls) if (ties.photo == index).any() else -1
        for index, name in enumerate(ties.photo_names)
    ]
    return np.asarray(ties.wall == np.array(most)[ties.photo])


def _of_these(ties: Ties, walls: tuple[Wall, ...]) -> bool:
    return int(ties.wall.min()) >= 0 and int(ties.wall.max()) < len(walls)
