"""How far estimated cameras are from the true ones, in place, in angle, and on the wall."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError, MethodError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.scene_views import SceneCameras, SeenPoints
from orthoflow.geometry.scenes import Scene
from orthoflow.products import Camera, Cameras, Finding, JsonValue, Truth, Walls

_GRID: Final = (24, 18)
# Surfaces that face another way than the wall, such as the sides of mouldings, are left out.
_LEAST_COSINE: Final = 0.9
# An orientation called `ok` that is off by more of its stated deviations is wrong.
_WRONG_SIGMAS: Final = 5.0


@dataclass(frozen=True, kw_only=True)
class PoseError:
    """What is wrong with one photo's orientation.

    Attributes:
        photo: name.
        status: `ok`, or why it has no orientation; then the rest is None.
        centre_m: distance of the projection centres.
        rotation_deg: angle between the orientations.
        wall_m: error of one coordinate on the walls, RMS over what the photo shows of them; None
            when it shows none of them, infinite when the estimated camera does not look there.
        sigma_wall_m: what the estimate states for that, or None.
    """

    photo: str
    status: str
    centre_m: float | None = None
    rotation_deg: float | None = None
    wall_m: float | None = None
    sigma_wall_m: float | None = None

    @property
    def is_wrong(self) -> bool:
        """Whether it is called `ok`, but off by more than 5 stated standard deviations."""
        if self.status != "ok" or self.wall_m is None:
            return False
        stated = math.inf if self.sigma_wall_m is None else self.sigma_wall_m
        return math.isinf(self.wall_m) or self.wall_m > _WRONG_SIGMAS * stated


def true_camera(truth: Truth, photo: str) -> ViewingCamera:
    """Give the true camera of a photo.

    Raises:
        MethodError: the truth knows no such photo.
    """
    cameras = () if truth.cameras is None else truth.cameras.cameras
    for camera in cameras:
        if camera.photo == photo:
            return camera.viewing()
    raise MethodError(
        f"the truth holds no photo {photo}, it has {len(cameras)} photos: wire the cameras of the "
        "simulated room's own photos"
    )


def pose_errors(
    cameras: Cameras, walls: Walls, truth: Truth, views: SceneCameras
) -> tuple[PoseError, ...]:
    """Compare each photo's orientation with the truth, on the walls and within their buffer.

    Raises:
        MethodError: a photo is none of the simulated ones.
    """
    return tuple(
        PoseError(photo=camera.photo, status=camera.status)
        if camera.status != "ok"
        else _pose_error(camera, true_camera(truth, camera.photo), walls, truth.scene, views)
        for camera in cameras.cameras
    )


def pose_findings(errors: Sequence[PoseError]) -> list[Finding]:
    """Sum up the errors of all photos; worst and median over those that are `ok`."""
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
    findings = [
        Finding(name="n_photos", value=len(errors), unit="1"),
        Finding(name="n_oriented", value=len(good), unit="1"),
        Finding(name="n_misoriented", value=sum(error.is_wrong for error in errors), unit="1"),
    ]
    for name, values, unit in (
        ("pose_centre", centres, "mm"),
        ("pose_rotation", angles, "deg"),
        ("pose_wall", on_wall, "mm"),
    ):
        if values:
            findings += [
                Finding(name=f"{name}_max_{unit}", value=max(values), unit=unit),
                Finding(name=f"{name}_median_{unit}", value=float(np.median(values)), unit=unit),
            ]
    if on_wall:
        findings.append(Finding(name="pose_wall_rms_mm", value=_rms(on_wall), unit="mm"))
    if ratios:
        findings.append(Finding(name="pose_error_over_sigma", value=_rms(ratios), unit="1"))
    return findings


def pose_details(errors: Sequence[PoseError]) -> list[JsonValue]:
    """Say of each photo how far off it is, as JSON."""
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


def _pose_error(
    camera: Camera, true: ViewingCamera, walls: Walls, scene: Scene, views: SceneCameras
) -> PoseError:
    found = camera.viewing()
    return PoseError(
        photo=camera.photo,
        status=camera.status,
        centre_m=float(np.linalg.norm(found.centre_world - true.centre_world)),
        rotation_deg=_angle_deg(found.rotation @ true.rotation.T),
        wall_m=_error_on_walls(found, true, walls, scene, views),
        sigma_wall_m=camera.sigma_wall_m,
    )


def _angle_deg(rotation: NDArray[np.float64]) -> float:
    """Angle of a rotation; the sine keeps small angles that the cosine would lose."""
    axis = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    return math.degrees(math.atan2(float(np.linalg.norm(axis)), float(np.trace(rotation)) - 1.0))


def _error_on_walls(
    found: ViewingCamera, true: ViewingCamera, walls: Walls, scene: Scene, views: SceneCameras
) -> float | None:
    """Where the two cameras place a grid of pixels on the surfaces that the true one sees."""
    columns, rows = ((np.arange(n) + 0.5) / n for n in _GRID)
    grid = np.stack(np.meshgrid(columns * true.width, rows * true.height), axis=-1).reshape(-1, 2)
    seen = views.trace(true, grid)
    chosen = _on_walls(seen, walls, scene)
    if not chosen.any():
        return None
    points, normal = seen.points[chosen], scene.normal[seen.rectangle[chosen]]
    camera = found.shifted(scene.origin)
    try:
        rays = camera.rays_world(grid[chosen])
    except GeometryError:
        return math.inf
    facing = np.einsum("ij,ij->i", normal, rays)
    ahead = np.einsum("ij,ij->i", normal, points - camera.centre_world)
    if np.any(facing * ahead <= 0.0):
        return math.inf
    off = camera.centre_world + (ahead / facing)[:, None] * rays - points
    # Two coordinates in each surface: half of the squared length is the square of one.
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1)) / 2.0))


def _on_walls(seen: SeenPoints, walls: Walls, scene: Scene) -> NDArray[np.bool_]:
    """Which points lie on a wall: within its raster and buffer, on a surface that faces as it."""
    on_walls = np.zeros(len(seen.points), dtype=np.bool_)
    hit = seen.rectangle >= 0
    for wall in walls.walls:
        frame = wall.frame
        relative = seen.points[hit] - (frame.origin_world - scene.origin)
        columns, rows = relative @ frame.u_world, relative @ frame.v_world
        depths = relative @ frame.normal_world
        facing = np.abs(scene.normal[seen.rectangle[hit]] @ frame.normal_world)
        on_walls[hit] |= (
            (facing > _LEAST_COSINE)
            & (columns > 0.0)
            & (columns < frame.gsd_m * frame.width)
            & (rows > 0.0)
            & (rows < frame.gsd_m * frame.height)
            & (depths < walls.buffer_front_m)
            & (depths > -walls.buffer_behind_m)
        )
    return on_walls


def _scaled(metres: float | None) -> float | None:
    return None if metres is None or math.isinf(metres) else 1e3 * metres


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
