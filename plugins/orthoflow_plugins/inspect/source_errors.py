"""True errors of painted cells, from the true target of the pixel that coloured them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.bands import IN_MEMORY_CELLS, Allocate, in_memory
from orthoflow.geometry.scenes import SurfaceRole
from orthoflow.products import Cameras, Finding, Orthoimage, OrthoMask, Truth, Wall
from orthoflow_plugins.inspect.cell_errors import depth_step_band
from orthoflow_plugins.inspect.orientation_errors import true_camera
from orthoflow_plugins.inspect.spreads import Spread, in_file

if TYPE_CHECKING:
    from orthoflow.geometry.scene_views import SceneCameras, TrueOrthoimage

# A cell coloured from farther away shows another place.
_FAR_CELLS: Final = 3.0


@dataclass(frozen=True, kw_only=True)
class SourceErrors:
    """The true sources of the colours of a wall's painted cells.

    Attributes:
        frame: where the cells lie.
        displacement_m: (rows, cols, 2) along u and v, cell - true target of its pixel; NaN where no
            oriented photo painted or the pixel has no target.
        traced: (rows, cols) bool, cells that an oriented photo painted.
        expected_m: (rows, cols) stated error of the orthoimage; None if it states none.
        steps: (rows, cols) bool, within 2 cells of a true depth step.
        ghosts: (rows, cols) bool, the pixel shows a free-standing object.
        n_seen_by_both: of the cells whose visibility is tested, those whose true surface a station
            and a photo see.
        n_seen_painted: those of them that are painted.
    """

    frame: WallFrame
    displacement_m: NDArray[np.float64]
    traced: NDArray[np.bool_]
    steps: NDArray[np.bool_]
    ghosts: NDArray[np.bool_]
    n_seen_by_both: int
    n_seen_painted: int
    expected_m: NDArray[np.float32] | None = None

    def kept(self, name: str, allocate: Allocate) -> SourceErrors:
        """Return the same with its arrays in files."""
        return replace(
            self,
            displacement_m=in_file(self.displacement_m, f"{name}.displacement_m", allocate),
            traced=in_file(self.traced, f"{name}.traced", allocate),
            steps=in_file(self.steps, f"{name}.steps", allocate),
            ghosts=in_file(self.ghosts, f"{name}.ghosts", allocate),
        )


def trace_sources(
    image: Orthoimage,
    wall: Wall,
    true: TrueOrthoimage,
    lattice: NDArray[np.bool_],
    cameras: Cameras,
    truth: Truth,
    views: SceneCameras,
) -> SourceErrors:
    """Trace every cell that a photo painted back to the true target of its pixel.

    The cell's point on the found surface is projected with the estimated camera, as in painting;
    the pixel's ray through the true camera meets the true scene, and that place on the wall is
    compared with the cell's own.

    Args:
        image: the orthoimage.
        wall: its wall.
        true: its truth.
        lattice: (rows, cols) cells whose visibility is tested.
        cameras: the estimated ones.
        truth: the simulated room.
        views: its scene, prepared for many rays.

    Raises:
        MethodError: a photo is not one of the simulated ones.
    """
    known = {camera.photo: camera for camera in cameras.cameras if camera.status == "ok"}
    displacement = np.full((*image.frame.shape, 2), np.nan)
    traced = np.zeros(image.frame.shape, dtype=np.bool_)
    ghosts = np.zeros(image.frame.shape, dtype=np.bool_)
    painted = (image.mask == OrthoMask.PAINTED) & np.isfinite(wall.depth_m)
    for source, name in enumerate(image.sources):
        if name not in known:
            continue
        rows, columns = np.nonzero(painted & (image.source == source))
        places = np.column_stack([columns + 0.5, rows + 0.5])
        near = _near_frame(image.frame, truth)
        points = near.world_from_wall(places, wall.depth_m[rows, columns].astype(np.float64))
        estimated = known[name].viewing().shifted(truth.scene.origin)
        pixels = estimated.project(points)[:, :2]
        seen = views.trace(true_camera(truth, name), pixels)
        found = near.wall_from_world(seen.points)[:, :2]
        displacement[rows, columns] = image.frame.gsd_m * (places - found)
        traced[rows, columns] = True
        hit = seen.rectangle >= 0
        ghosts[rows, columns] = hit & (truth.scene.role[seen.rectangle] == SurfaceRole.OBJECT)
    both = _seen_by_photos(true, true.seen & lattice, truth, views)
    return SourceErrors(
        frame=image.frame,
        displacement_m=displacement,
        traced=traced,
        steps=depth_step_band(true.depth_m),
        ghosts=ghosts,
        n_seen_by_both=int(np.count_nonzero(both)),
        n_seen_painted=int(np.count_nonzero(both & (image.mask == OrthoMask.PAINTED))),
        expected_m=image.error_m,
    )


def source_findings(
    errors: Sequence[SourceErrors], wall: int, allocate: Allocate = in_memory
) -> list[Finding]:
    """Compute statistics of one wall, or of several (wall -1); none without photos.

    Displacements are of all painted cells that show no free-standing object; those within 2 cells
    of true depth steps are separate.

    Args:
        errors: of walls, or of parts of them.
        wall: index in the findings.
        allocate: returns arrays for the displacements of many cells, by name.
    """
    errors = [item for item in errors if item.traced.any()]
    if not errors:
        return []
    n_traced = sum(int(np.count_nonzero(item.traced)) for item in errors)
    away = _gathered(errors, allocate, at_steps=False)
    steps = _gathered(errors, allocate, at_steps=True)
    numbers = [("n_traced", float(n_traced), "1")]
    for axis, name in enumerate(("u", "v")):
        if len(away):
            spread = Spread(away[:, axis], 1e3)
            numbers += [
                (f"rmse_{name}_mm", spread.rms(), "mm"),
                (f"mean_{name}_mm", spread.mean(), "mm"),
                (f"nmad_{name}_mm", spread.median_deviation(), "mm"),
                (f"p99_{name}_mm", spread.percentile_of_size(99.0), "mm"),
            ]
        if len(steps):
            numbers.append((f"step_rmse_{name}_mm", Spread(steps[:, axis], 1e3).rms(), "mm"))
    n_far = sum(int(np.count_nonzero(_is_far(item))) for item in errors)
    n_ghosts = sum(int(np.count_nonzero(item.ghosts)) for item in errors)
    numbers += [
        ("far_source_share", n_far / n_traced, "1"),
        ("ghost_share", n_ghosts / n_traced, "1"),
        ("n_ghost_cells", float(n_ghosts), "1"),
    ]
    numbers += _shares_within(errors)
    n_both = sum(item.n_seen_by_both for item in errors)
    if n_both:
        n_painted = sum(item.n_seen_painted for item in errors)
        numbers.append(("completeness_seen_by_both", n_painted / n_both, "1"))
    return [Finding(name=name, value=value, unit=unit, wall=wall) for name, value, unit in numbers]


def _shares_within(errors: Sequence[SourceErrors]) -> list[tuple[str, float, str]]:
    """Return shares of coordinates with errors within once and twice the stated one."""
    counts = np.zeros(3)
    for item in errors:
        if item.expected_m is None:
            continue
        chosen = item.traced & ~item.steps & ~item.ghosts & np.isfinite(item.expected_m)
        chosen &= np.isfinite(item.displacement_m).all(axis=2)
        sigmas = np.abs(item.displacement_m[chosen]) / item.expected_m[chosen][:, None]
        counts += [sigmas.size, (sigmas <= 1.0).sum(), (sigmas <= 2.0).sum()]
    if not counts[0]:
        return []
    return [
        ("within_1_sigma_share", float(counts[1] / counts[0]), "1"),
        ("within_2_sigma_share", float(counts[2] / counts[0]), "1"),
    ]


def counted_once(bands: Sequence[SourceErrors]) -> tuple[SourceErrors, ...]:
    """Return the bands that photos painted as representative of their wall; none without any."""
    traced = [bool(item.traced.any()) for item in bands]
    if not any(traced):
        return ()
    n_both = sum(item.n_seen_by_both for item in bands)
    n_painted = sum(item.n_seen_painted for item in bands)
    first = traced.index(True)
    return tuple(
        replace(
            item,
            n_seen_by_both=n_both if place == first else 0,
            n_seen_painted=n_painted if place == first else 0,
        )
        for place, item in enumerate(bands)
    )


def _gathered(
    errors: Sequence[SourceErrors], allocate: Allocate, *, at_steps: bool
) -> NDArray[np.float64]:
    """Return displacements (n, 2) of cells at true depth steps, or away from them."""

    def of(item: SourceErrors) -> NDArray[np.float64]:
        return _of(item, item.traced & (item.steps if at_steps else ~item.steps))

    if sum(item.traced.size for item in errors) <= IN_MEMORY_CELLS:
        return np.concatenate([of(item) for item in errors])
    counts = [len(of(item)) for item in errors]
    name = "steps" if at_steps else "away"
    whole = np.asarray(allocate(name, (sum(counts), 2), np.float64), np.float64)
    ends = np.cumsum(counts)
    for item, count, end in zip(errors, counts, ends, strict=True):
        whole[end - count : end] = of(item)
    return whole


def _near_frame(frame: WallFrame, truth: Truth) -> WallFrame:
    """Return the frame relative to the scene's origin: survey coordinates would lose digits."""
    return replace(frame, origin_world=frame.origin_world - truth.scene.origin)


def _seen_by_photos(
    true: TrueOrthoimage, asked: NDArray[np.bool_], truth: Truth, views: SceneCameras
) -> NDArray[np.bool_]:
    """Return those of the tested cells whose true surface some photo sees, oriented or not."""
    rows, columns = np.nonzero(asked)
    places = np.column_stack([columns + 0.5, rows + 0.5])
    depths = true.depth_m[rows, columns].astype(np.float64)
    points = _near_frame(true.frame, truth).world_from_wall(places, depths)
    seen = np.zeros(len(points), dtype=np.bool_)
    for camera in () if truth.cameras is None else truth.cameras.cameras:
        left = np.flatnonzero(~seen)
        seen[left] = views.sees(camera.viewing(), points[left])
    mask = np.zeros(true.frame.shape, dtype=np.bool_)
    mask[rows, columns] = seen
    return mask


def _of(errors: SourceErrors, chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return displacements (n, 2) of the chosen cells, without ghosts and pixels without target."""
    values = errors.displacement_m[chosen & ~errors.ghosts]
    return values[np.isfinite(values).all(axis=1)]


def _is_far(errors: SourceErrors) -> NDArray[np.bool_]:
    """Report cells whose colour comes from more than 3 cells away, or from nothing."""
    length = np.linalg.norm(errors.displacement_m, axis=2)
    far: NDArray[np.bool_] = errors.traced & ~(length <= _FAR_CELLS * errors.frame.gsd_m)
    return far
