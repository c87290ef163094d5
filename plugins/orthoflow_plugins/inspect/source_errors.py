"""True errors of cells that were coloured from photos.

Each cell is compared with the scene point that its source pixel actually shows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.robust import median_deviation
from orthoflow.geometry.scenes import SurfaceRole
from orthoflow.products import Cameras, Finding, Orthoimage, Truth, Wall, is_painted
from orthoflow_plugins.inspect.findings import Number, count_true, findings_of, rms
from orthoflow_plugins.inspect.orientation_errors import true_camera

if TYPE_CHECKING:
    from orthoflow.geometry.scene_views import SceneCameras, TrueOrthoimage

# A cell is wrong if its colour shows a scene point farther away than this.
_FAR_CELLS: Final = 3.0


@dataclass(frozen=True, kw_only=True)
class SourceErrors:
    """The true origin of the colours of the cells of a wall.

    Attributes:
        frame: grid of the cells.
        displacement_m: (rows, cols, 2) position of the cell minus position of the scene point that
            its source pixel shows, along u and v in metres; NaN if the cell was not coloured from
            an oriented photo or if the pixel shows no surface.
        traced: (rows, cols) bool, cells coloured from an oriented photo.
        expected_m: (rows, cols) predicted error of the orthoimage; None if there is no prediction.
        ghosts: (rows, cols) bool, cells whose source pixel shows a free-standing object.
        n_seen_by_both: number of tested cells whose true surface is visible both from a station and
            in a photo.
        n_seen_painted: number of these cells that are coloured.
    """

    frame: WallFrame
    displacement_m: NDArray[np.float64]
    traced: NDArray[np.bool_]
    ghosts: NDArray[np.bool_]
    n_seen_by_both: int
    n_seen_painted: int
    expected_m: NDArray[np.float32] | None = None

    def samples(self, steps: NDArray[np.bool_], error_step: int = 1) -> SourceSamples:
        """Return the errors that are used for statistics.

        Args:
            steps: (rows, cols) mask of the cells within 2 cells of a true depth step.
            error_step: n if every nth displacement is kept.
        """
        known = self.traced & np.isfinite(self.displacement_m).all(axis=2)
        counted = known & ~self.ghosts
        length_m = np.linalg.norm(self.displacement_m, axis=2)
        is_far = self.traced & ~(length_m <= _FAR_CELLS * self.frame.gsd_m)
        sigmas = np.empty(0)
        if self.expected_m is not None:
            stated = counted & ~steps & np.isfinite(self.expected_m)
            sigmas = np.abs(self.displacement_m[stated]) / self.expected_m[stated][:, None]
        return SourceSamples(
            away_m=self.displacement_m[counted & ~steps][::error_step],
            step_m=self.displacement_m[counted & steps][::error_step],
            n_traced=count_true(self.traced),
            n_far=count_true(is_far),
            n_ghosts=count_true(self.ghosts),
            n_stated=sigmas.size,
            n_within_1_sigma=count_true(sigmas <= 1.0),
            n_within_2_sigma=count_true(sigmas <= 2.0),
            n_seen_by_both=self.n_seen_by_both,
            n_seen_painted=self.n_seen_painted,
        )


@dataclass(frozen=True, kw_only=True)
class SourceSamples:
    """Errors of traced cells, of one wall or of several walls together, for statistics.

    Attributes:
        away_m: (n, 2) displacements along u and v, in metres, of cells that show no free-standing
            object and are away from true depth steps.
        step_m: (m, 2) displacements of cells that show no free-standing object and are within 2
            cells of a true depth step.
        n_traced: number of cells coloured from an oriented photo.
        n_far: number of traced cells whose source pixel shows a point more than 3 cells away, or no
            surface.
        n_ghosts: number of traced cells whose source pixel shows a free-standing object.
        n_stated: number of components (along u or v) of the displacements in `away_m`, before
            thinning, that have a predicted error.
        n_within_1_sigma: number of these components that are at most the predicted error.
        n_within_2_sigma: number of these components that are at most twice the predicted error.
        n_seen_by_both: as in `SourceErrors`.
        n_seen_painted: as in `SourceErrors`.
    """

    away_m: NDArray[np.float64]
    step_m: NDArray[np.float64]
    n_traced: int
    n_far: int
    n_ghosts: int
    n_stated: int
    n_within_1_sigma: int
    n_within_2_sigma: int
    n_seen_by_both: int
    n_seen_painted: int


def trace_sources(
    image: Orthoimage,
    wall: Wall,
    true: TrueOrthoimage,
    lattice: NDArray[np.bool_],
    cameras: Cameras,
    truth: Truth,
    views: SceneCameras,
) -> SourceErrors:
    """Find the scene point that each cell coloured from a photo actually shows.

    The point of the cell on the measured surface is projected with the estimated camera, as in the
    computation of the orthoimage. The ray through this pixel of the true camera is intersected with
    the true scene. The position of the intersection on the wall is compared with the position of
    the cell.

    Args:
        image: the orthoimage.
        wall: the wall of the orthoimage.
        true: the true orthoimage.
        lattice: (rows, cols) bool, cells whose visibility is tested.
        cameras: the estimated cameras.
        truth: the simulated room.
        views: the scene, prepared for many rays.

    Raises:
        MethodError: the truth does not contain a photo.
    """
    known = {camera.photo: camera for camera in cameras.cameras if camera.status == "ok"}
    displacement = np.full((*image.frame.shape, 2), np.nan)
    traced = np.zeros(image.frame.shape, dtype=np.bool_)
    ghosts = np.zeros(image.frame.shape, dtype=np.bool_)
    painted = is_painted(image.mask) & np.isfinite(wall.depth_m)
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
        ghosts=ghosts,
        n_seen_by_both=count_true(both),
        n_seen_painted=count_true(both & is_painted(image.mask)),
        expected_m=image.error_m,
    )


def source_findings(samples: SourceSamples, wall: int) -> list[Finding]:
    """Compute statistics of one wall or of all walls (wall -1); empty without traced cells.

    The statistics cover all cells that show no free-standing object; cells within 2 cells of true
    depth steps are reported separately.

    Args:
        samples: errors of the wall, or of all walls.
        wall: index of the wall.
    """
    if not samples.n_traced:
        return []
    numbers: list[Number] = [("n_traced", samples.n_traced, "1")]
    for name, away, step in zip("uv", 1e3 * samples.away_m.T, 1e3 * samples.step_m.T, strict=True):
        if len(away):
            numbers += [
                (f"rmse_{name}_mm", rms(away), "mm"),
                (f"mean_{name}_mm", away.mean(), "mm"),
                (f"nmad_{name}_mm", median_deviation(away), "mm"),
                (f"p99_{name}_mm", np.percentile(np.abs(away), 99.0), "mm"),
            ]
        if len(step):
            numbers.append((f"step_rmse_{name}_mm", rms(step), "mm"))
    numbers += [
        ("far_source_share", samples.n_far / samples.n_traced, "1"),
        ("ghost_share", samples.n_ghosts / samples.n_traced, "1"),
        ("n_ghost_cells", samples.n_ghosts, "1"),
    ]
    if samples.n_stated:
        numbers += [
            ("within_1_sigma_share", samples.n_within_1_sigma / samples.n_stated, "1"),
            ("within_2_sigma_share", samples.n_within_2_sigma / samples.n_stated, "1"),
        ]
    if samples.n_seen_by_both:
        share = samples.n_seen_painted / samples.n_seen_by_both
        numbers.append(("completeness_seen_by_both", share, "1"))
    return findings_of(numbers, wall)


def _near_frame(frame: WallFrame, truth: Truth) -> WallFrame:
    """Return the frame relative to the origin of the scene, where float64 keeps its precision."""
    return replace(frame, origin_world=frame.origin_world - truth.scene.origin)


def _seen_by_photos(
    true: TrueOrthoimage, asked: NDArray[np.bool_], truth: Truth, views: SceneCameras
) -> NDArray[np.bool_]:
    """Return a mask of the tested cells whose true surface any photo shows, oriented or not."""
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
