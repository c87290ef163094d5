"""How far ties between photos and walls are from the truth, which no residual can tell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.resection import pixels_by_point
from orthoflow.products import Cameras, Finding, TieRole, Ties, Truth, Wall, Walls
from orthoflow_plugins.inspect.poses import true_camera

# A tie that is off by more than so many cells of the wall is wrong.
_WRONG_CELLS: Final = 1.5
# Rays along the longer side of a photo that say which wall it shows most.
_RAYS: Final = 32


def tie_errors_cells(ties: Ties, walls: Walls, truth: Truth) -> NDArray[np.float64]:
    """Distance (n,) in the wall's plane of each tie's point from where its pixel truly looks.

    To first order of the true camera, in cells of the wall; infinite where the true camera does not
    look towards the point at all.

    Raises:
        MethodError: the truth knows no such photo.
    """
    errors = np.full(len(ties.photo), np.inf)
    for photo in np.unique(ties.photo):
        camera = true_camera(truth, ties.photo_names[photo])
        for index in np.unique(ties.wall[ties.photo == photo]):
            mine = np.flatnonzero((ties.photo == photo) & (ties.wall == index))
            frame = walls.walls[index].frame
            points = ties.points_world[mine]
            axes = np.vstack([frame.u_world, frame.v_world])
            off_px = ties.pixels_photo[mine] - camera.project(points)[:, :2]
            pixels_by_plane = pixels_by_point(camera, points) @ axes.T
            seen = np.isfinite(off_px).all(axis=1) & (np.linalg.det(pixels_by_plane) != 0.0)
            off_m = np.linalg.solve(pixels_by_plane[seen], off_px[seen, :, None])[:, :, 0]
            errors[mine[seen]] = np.linalg.norm(off_m, axis=1) / frame.gsd_m
    return errors


def tie_findings(cameras: Cameras, walls: Walls, truth: Truth) -> list[Finding]:
    """Say how many ties are wrong: of all that were matched, and of those that photos kept."""
    ties = cameras.ties
    if ties is None or not len(ties.photo) or not _of_these(ties, walls.walls):
        return []
    errors = tie_errors_cells(ties, walls, truth)
    own = _with_own_wall(ties, walls, truth)
    kept = ties.role != TieRole.REJECTED
    findings = [
        Finding(name="match_wrong_share", value=float((errors > _WRONG_CELLS).mean()), unit="1"),
        Finding(name="n_ties_kept", value=int(kept.sum()), unit="1"),
    ]
    if own.any():
        wrong = float((errors[own] > _WRONG_CELLS).mean())
        findings.append(Finding(name="match_wrong_share_own_wall", value=wrong, unit="1"))
    if kept.any():
        wrong = float((errors[kept] > _WRONG_CELLS).mean())
        median = float(np.median(errors[kept]))
        findings += [
            Finding(name="tie_wrong_share", value=wrong, unit="1"),
            Finding(name="tie_error_median_cells", value=median, unit="1"),
        ]
    return findings


def _with_own_wall(ties: Ties, walls: Walls, truth: Truth) -> NDArray[np.bool_]:
    """Ties (n,) of photos with the wall that each truly shows most."""
    most = [
        most_shown(true_camera(truth, name), walls.walls) if (ties.photo == index).any() else -1
        for index, name in enumerate(ties.photo_names)
    ]
    return np.asarray(ties.wall == np.array(most)[ties.photo])


def most_shown(camera: ViewingCamera, walls: Sequence[Wall]) -> int:
    """Index of the wall whose rectangle covers most of a photo, -1 where none is in it."""
    step = max(camera.width, camera.height) / _RAYS
    grid = np.meshgrid(
        np.arange(0.5 * step, camera.width, step), np.arange(0.5 * step, camera.height, step)
    )
    rays = camera.rays_world(np.column_stack([axis.ravel() for axis in grid]))
    nearest, shown = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for index, wall in enumerate(walls):
        frame, centre = wall.frame, camera.centre_world
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


def _of_these(ties: Ties, walls: tuple[Wall, ...]) -> bool:
    """Whether the ties may be ties with these walls."""
    return int(ties.wall.min()) >= 0 and int(ties.wall.max()) < len(walls)
