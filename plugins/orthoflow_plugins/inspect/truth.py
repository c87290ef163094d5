"""`inspect.truth`: compare the products of a run with the truth of a simulated scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.bands import Band, count_cells
from orthoflow.geometry.rows import raster_rows
from orthoflow.geometry.scenes import Viewers
from orthoflow.products import (
    PAINTED_STATES,
    Cameras,
    Finding,
    Inspection,
    JsonValue,
    Orthoimage,
    Orthoimages,
    Planes,
    PointCloud,
    PointLabels,
    Truth,
    Wall,
    Walls,
)
from orthoflow.sdk import (
    Determinism,
    DiagnosticSpec,
    Method,
    MethodParams,
    MetricSpec,
    Ports,
    StepContext,
)
from orthoflow_plugins.inspect.cell_errors import (
    BLOCK_CELLS,
    Sampling,
    SamplingRule,
    WallSamples,
    sample_findings,
    sampling,
    wall_errors,
)
from orthoflow_plugins.inspect.figures import (
    colour_error_map,
    depth_error_map,
    displacement_map,
)
from orthoflow_plugins.inspect.findings import (
    IMAGE_QUALITY,
    higher,
    lower,
    of_walls,
    pooled,
    report,
)
from orthoflow_plugins.inspect.image_quality import quality_findings
from orthoflow_plugins.inspect.orientation_errors import (
    PoseError,
    pose_details,
    pose_errors,
    pose_findings,
    tie_findings,
)
from orthoflow_plugins.inspect.patches import PATCH_CELLS, PatchShifts
from orthoflow_plugins.inspect.placing import in_files, on_walls, wall_of
from orthoflow_plugins.inspect.plane_errors import (
    LABEL_SCORES,
    found_planes,
    inspect_planes,
    label_findings,
    wall_plane_findings,
    worst_plane_findings,
)
from orthoflow_plugins.inspect.source_errors import (
    SourceSamples,
    source_findings,
    trace_sources,
)

if TYPE_CHECKING:
    from orthoflow.geometry.scene_views import SceneCameras, TrueOrthoimage

_TRACED_POINTS: Final = 4000
# The true colour of a cell is the mean over n x n rays.
SUPERSAMPLE: Final = 3
# Larger walls are compared in bands of this many cells; a band needs about 1 GB of memory.
BAND_CELLS: Final = 1 << 23
# Figures of large walls show every nth row and column, such that about this many remain along the
# longer side.
_DRAWN_CELLS: Final = 1800
_OF_WALLS: Final = (
    lower("rmse_[uv]_mm", label="error along {0}, RMS", headline=True),
    MetricSpec("mean_[uv]_mm", label="shift along {0}, mean"),
    lower("nmad_[uv]_mm", label="typical error along {0} (NMAD)", headline=True),
    MetricSpec("p99_[uv]_mm", label="error along {0}, 99th percentile"),
    lower("step_rmse_[uv]_mm", label="error along {0} near depth steps, RMS"),
    lower("patch_rmse_[uv]_mm", label="error along {0} by patch matching, RMS"),
    MetricSpec("patch_mean_[uv]_mm", label="shift along {0} by patch matching, mean"),
    MetricSpec("n_patches", label="patches compared with the truth"),
    MetricSpec("displaced_share", label="cells displaced by more than one cell"),
    MetricSpec("depth_median_mm", label="depth error, median"),
    lower("depth_nmad_mm", label="typical depth error (NMAD)"),
    lower(
        "depth_rmse_mm",
        label="depth error, RMS",
        headline=True,
        description="dominated by cells at edges, which have two depths; depth_nmad_mm describes "
        "the others",
    ),
    lower("depth_step_rmse_mm", label="depth error near depth steps, RMS"),
    MetricSpec(
        "depth_within_3sigma", label="share of depths within three predicted standard deviations"
    ),
    lower("colour_rmse_grey", label="colour error, RMS"),
    lower("ghost_share", label="share of the cells that show an occluder"),
    higher(
        "completeness",
        label="share of the visible surface that is covered, without filled cells",
        headline=True,
    ),
    higher("completeness_filled", label="share of the visible surface that is covered or filled"),
    higher(
        "completeness_seen_by_both",
        label="covered share of the surface visible from a station and a photo",
        headline=True,
    ),
    MetricSpec("n_traced", label="cells traced back to their source photo"),
    lower("far_source_share", label="share of cells coloured from a wrong position"),
    MetricSpec("n_ghost_cells", label="cells that show an occluder"),
    MetricSpec(
        "within_1_sigma_share", label="cells whose error is within the predicted standard deviation"
    ),
    MetricSpec(
        "within_2_sigma_share",
        label="cells whose error is within twice the predicted standard deviation",
    ),
)
# Metrics of planes, which can be computed without orthoimages.
_OF_PLANES: Final = (
    lower("plane_angle_deg", label="direction error of the main plane", headline=True),
    lower("plane_offset_mm", label="position error of the main plane", headline=True),
)
NOT_COMPARED: Final = DiagnosticSpec(
    code="truth-not-compared",
    severity="warning",
    text="{dropped} cannot be compared with the truth without {missing}: only planes and "
    "labels are compared",
    remedy="connect {missing} to {step}",
)
NOT_TRACED: Final = DiagnosticSpec(
    code="truth-not-traced",
    severity="warning",
    text="displacements are not computed for cells from sources that are not oriented photos of "
    "the connected cameras: {names}",
    rank_by="n",
)


def _needing(ports: tuple[str, ...], *specs: MetricSpec) -> tuple[MetricSpec, ...]:
    """Return the metrics that are only reported if these ports are connected."""
    return tuple(replace(spec, needs=ports) for spec in specs)


class InspectTruth(Method):
    """Compare products with the truth of a simulated scene, cell by cell and patch by patch.

    The true orthoimage is rendered in the frame of each wall. It shows the first surface within the
    buffer, seen perpendicular to the wall. Depths and colours are compared away from true depth
    steps; a band of 2 cells along the steps is reported separately. Displacements are measured in
    patches of 32 x 32 covered cells, which are matched to the truth by least squares. Metrics
    without a prefix describe the first wall, and those with `all_` describe all walls together. On
    large walls, colours and patches are compared in evenly spread blocks of 96 x 96 cells, and
    visibility is tested on a regular lattice of cells; depths, and displacements computed from
    cameras, are compared in every cell. If there are more than eight million errors, statistics are
    computed from an evenly spread sample.

    With cameras, the orientation of each photo is compared with the true one, and the displacement
    of each cell coloured from a photo is computed exactly. For this, the point of the cell on the
    measured surface is projected with the estimated camera. The ray through this pixel of the true
    camera meets the true scene at the point whose colour the cell shows. Displacements of patches
    then have the prefix `patch_`. The ties stored with the cameras are also compared. A tie is
    wrong if it is more than 1.5 cells of the wall away from the scene point that its pixel shows.
    `match_wrong_share` is the share of wrong ties among all ties, `tie_wrong_share` is the share
    among the ties that the orientation kept, and `match_wrong_share_own_wall` is the share among
    the ties on the wall that covers most of their photo.

    Without orthoimages, only planes and labels are compared, which is sufficient for plane
    detectors.
    """

    id: ClassVar[str] = "inspect.truth"
    determinism: ClassVar[Determinism] = "loose"
    result_version: ClassVar[int] = 2
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        *_needing(("orthoimages", "walls"), *of_walls(_OF_WALLS), *IMAGE_QUALITY),
        *of_walls(_OF_PLANES),
        *_needing(
            ("cameras", "orthoimages", "walls"),
            MetricSpec("n_photos", label="photos"),
            higher("n_oriented", label="photos oriented"),
            MetricSpec("n_misoriented", label="accepted photos with a wrong pose"),
            MetricSpec(
                "pose_error_over_sigma",
                label="true pose error divided by the predicted error",
                better="one",
                counted_by="n_oriented",
            ),
            lower(
                "pose_wall_rms_mm",
                label="true orientation error on the wall, RMS",
                counted_by="n_oriented",
            ),
            *(
                MetricSpec(name, label=f"{label}, {which}", counted_by="n_oriented")
                for part, unit, label in (
                    ("centre", "mm", "error of the projection centre"),
                    ("wall", "mm", "true orientation error on the wall"),
                    ("rotation", "deg", "error of the viewing direction"),
                )
                for name, which in (
                    (f"pose_{part}_max_{unit}", "worst"),
                    (f"pose_{part}_median_{unit}", "median"),
                )
            ),
            lower("match_wrong_share", label="share of wrong matches"),
            lower(
                "match_wrong_share_own_wall",
                label="share of wrong matches on the wall that covers most of the photo",
            ),
            MetricSpec("n_ties_kept", label="ties kept by the orientation"),
            lower("tie_wrong_share", label="share of wrong ties among those kept"),
        ),
        *_needing(
            ("planes",),
            MetricSpec("true_planes", label="true planes"),
            higher("true_planes_found", label="true planes found", headline=True),
            higher("main_found", unit="yes/no", label="main wall found", headline=True),
        ),
        MetricSpec("worst_plane_angle_deg", label="direction error of the worst plane"),
        MetricSpec("worst_plane_offset_mm", label="position error of the worst plane"),
        *_needing(
            ("labels",),
            *(
                higher(name, label=label, headline=score == "iou")
                for score, word in LABEL_SCORES.items()
                for name, label in (
                    (f"label_{score}", f"labels of the main plane, {word}"),
                    (f"label_{score}_mean", f"label {word}, mean over planes"),
                )
            ),
        ),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Gruen 1985, Adaptive least squares correlation, S. Afr. J. Photogramm. 14(3)",
        "Hoehle and Hoehle 2009, doi:10.1016/j.isprsjprs.2009.02.003 (NMAD)",
    )

    class Params(MethodParams):
        """No parameters."""

    class In(Ports):
        """The products to compare, and the truth."""

        truth: Truth
        orthoimages: Orthoimages | None = None
        walls: Walls | None = None
        planes: Planes | None = None
        labels: PointLabels | None = None
        cloud: PointCloud | None = None
        cameras: Cameras | None = None

    class Out(Ports):
        """The measured errors."""

        inspection: Inspection

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Compare the photos, each wall, and all walls together."""
        if inputs.cloud is not None:
            inputs.cloud.require_points(2)
        if inputs.orthoimages is None or inputs.walls is None:
            return self.Out(inspection=_inspect_planes(inputs, ctx))
        if not inputs.orthoimages.images:
            raise MethodError("there is no orthoimage to inspect")
        orthoimages = on_walls(inputs.orthoimages, inputs.walls)
        rule = SamplingRule.of(orthoimages.images)
        _warn_of_untraced(inputs.orthoimages, inputs.cameras, ctx)
        views = _views(inputs, ctx.cores)
        poses: tuple[PoseError, ...] = ()
        if inputs.cameras is not None and views is not None:
            poses = pose_errors(inputs.cameras, inputs.walls, inputs.truth, views)
        judge = _Judge(inputs=inputs, walls=inputs.walls, rule=rule, views=views, ctx=ctx)
        verdicts: list[_Verdict] = []
        findings: list[Finding] = []
        for place, image in enumerate(orthoimages.images):
            ctx.progress(place / len(orthoimages.images), image.name)
            verdict = judge.verdict_on(image)
            verdicts.append(verdict)
            if image.frame.bend is None:
                findings += wall_plane_findings(image.frame.plane, image.wall, inputs.truth.planes)
            findings += _findings([verdict], image.wall)
            findings += verdict.quality
            _draw(image, verdict, ctx)
        findings += _findings(verdicts, -1)
        findings += worst_plane_findings(findings)
        if inputs.cameras is not None:
            findings += pose_findings(poses)
            findings += tie_findings(inputs.cameras, inputs.walls, inputs.truth)
        if inputs.planes is not None:
            findings += found_planes(inputs.planes, inputs.truth.planes)
        if inputs.labels is not None:
            findings += label_findings(inputs.labels, inputs.cloud, inputs.truth, ctx)
        numbers = {image.wall: image.number for image in orthoimages.images}
        report(findings, orthoimages.images[0].wall, numbers, ctx)
        details: dict[str, JsonValue] = {
            "patch_cells": PATCH_CELLS,
            "colour_share_compared": rule.colour_share,
            "seen_lattice_cells": rule.lattice_step,
        }
        return self.Out(inspection=_inspection(orthoimages, verdicts, poses, findings, details))


@dataclass(frozen=True, kw_only=True)
class _Verdict:
    """All errors of one wall.

    Attributes:
        samples: errors of depths, colours and patches.
        sources: errors of traced cells; None if no photo coloured a cell.
        patches: patches whose displacement was measured.
        depth_m: measured minus true depth in every nth row and column, for the figure; n is given
            by `_draw_step`.
        grey: RMS colour error of the same cells.
        length_m: length of the displacement of the same cells, in metres.
        cells: (n, 2) row and column of a sample of the traced cells.
        cell_shift_m: (n, 2) displacements of these cells along u and v, in metres.
        quality: findings that do not depend on the truth.
    """

    samples: WallSamples
    sources: SourceSamples | None
    patches: PatchShifts
    depth_m: NDArray[np.float64]
    grey: NDArray[np.float64]
    length_m: NDArray[np.float64]
    cells: NDArray[np.int64]
    cell_shift_m: NDArray[np.float64]
    quality: tuple[Finding, ...]


def _findings(verdicts: Sequence[_Verdict], wall: int) -> list[Finding]:
    """Return the findings of one wall, or of several walls together (wall -1)."""
    sources = [item.sources for item in verdicts if item.sources is not None]
    samples = pooled([item.samples for item in verdicts])
    findings = sample_findings(samples, wall, sources_are_traced=bool(sources))
    return findings + (source_findings(pooled(sources), wall) if sources else [])


def _inspect_planes(inputs: InspectTruth.In, ctx: StepContext) -> Inspection:
    if inputs.planes is None:
        raise MethodError(
            "there is nothing to inspect: connect orthoimages and walls, or planes (inspect.truth)"
        )
    given = ("orthoimages", "walls", "cameras")
    dropped = [name for name in given if getattr(inputs, name) is not None]
    if dropped:
        missing = [name for name in given[:2] if name not in dropped]
        ctx.report(NOT_COMPARED, dropped=" and ".join(dropped), missing=" and ".join(missing))
    return inspect_planes(inputs.planes, inputs.labels, inputs.cloud, inputs.truth, ctx)


def _warn_of_untraced(images: Orthoimages, cameras: Cameras | None, ctx: StepContext) -> None:
    if cameras is None:
        return
    known = {camera.photo for camera in cameras.cameras if camera.status == "ok"}
    unknown = dict.fromkeys(name for image in images.images for name in image.sources)
    names = [name for name in unknown if name not in known]
    if names:
        ctx.report(NOT_TRACED, n=len(names), names=", ".join(names))


def _views(inputs: InspectTruth.In, cores: int) -> SceneCameras | None:
    if inputs.cameras is None:
        return None
    from orthoflow.geometry.scene_views import SceneCameras

    return SceneCameras(inputs.truth.scene, cores=cores)


@dataclass(frozen=True, kw_only=True)
class _Judge:
    """Comparison of walls, one by one; `views` is None if there are no cameras."""

    inputs: InspectTruth.In
    walls: Walls
    rule: SamplingRule
    views: SceneCameras | None
    ctx: StepContext

    def verdict_on(self, image: Orthoimage) -> _Verdict:
        """Compare one wall; large walls are compared in bands of whole blocks with a margin."""
        wall = wall_of(image, self.walls, in_files(self.ctx, f"{image.wall}.laid"))
        n_painted = sum(count_cells(image.mask, state) for state in PAINTED_STATES)
        cell_step = max(1, n_painted // _TRACED_POINTS)
        bands = [self._of_band(image, wall, band, cell_step) for band in _bands(image)]
        sources = [band.sources for band in bands if band.sources is not None]
        together = pooled(sources) if sources else None
        names = ("depth_m", "grey", "length_m", "cells", "cell_shift_m")
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(band, name) for band in bands]) for name in names
        }
        return _Verdict(
            samples=pooled([band.samples for band in bands]),
            sources=together if together is not None and together.n_traced else None,
            patches=PatchShifts.joined([band.patches for band in bands]),
            quality=tuple(quality_findings(image, wall, self.inputs.cameras)),
            **arrays,
        )

    def _of_band(self, image: Orthoimage, wall: Wall, band: Band, cell_step: int) -> _Verdict:
        """Compare a band of rows; the size of the result does not depend on the size of the wall.

        Args:
            image: orthoimage of the whole wall.
            wall: the wall, on the grid of the image.
            band: rows to compare.
            cell_step: n if every nth traced cell is kept.
        """
        part, surface = raster_rows(image, band.around), raster_rows(wall, band.around)
        chosen = sampling(part, self.rule, band.around.start)
        true = self._true_orthoimage(part, chosen)
        errors = wall_errors(part, surface, true, chosen, band.inner, self.rule.error_step)
        step = _draw_step(image)
        drawn = (slice(-band.rows.start % step, None, step), slice(None, None, step))
        above = np.array([0.0, band.rows.start])
        sources = None
        cells, shift_m, length_m = np.empty((0, 2), np.int64), np.empty((0, 2)), np.empty((0, 0))
        if self.inputs.cameras is not None and self.views is not None:
            traced = trace_sources(
                raster_rows(part, band.inner),
                raster_rows(surface, band.inner),
                raster_rows(true, band.inner),
                chosen.lattice[band.inner],
                self.inputs.cameras,
                self.inputs.truth,
                self.views,
            )
            sources = traced.samples(errors.steps, self.rule.error_step)
            length_m = np.linalg.norm(traced.displacement_m[drawn], axis=2)
            is_known = np.isfinite(traced.displacement_m).all(axis=2)
            cells = np.argwhere(is_known)[::cell_step]
            shift_m = traced.displacement_m[cells[:, 0], cells[:, 1]]
        return _Verdict(
            samples=errors.samples,
            sources=sources,
            patches=replace(errors.patches, centre=errors.patches.centre + above),
            depth_m=errors.depth_m[drawn],
            grey=errors.grey[drawn],
            length_m=length_m,
            cells=cells + np.array([band.rows.start, 0]),
            cell_shift_m=shift_m,
            quality=(),
        )

    def _true_orthoimage(self, image: Orthoimage, chosen: Sampling) -> TrueOrthoimage:
        from orthoflow.geometry.scene_views import render

        truth = self.inputs.truth
        viewers = Viewers(
            positions_world=np.unique(truth.stations, axis=0),
            up=truth.planes.up,
            lowest_elevation_deg=truth.lowest_elevation_deg,
            highest_elevation_deg=truth.highest_elevation_deg,
        )
        slab = self.walls.slab(image.wall)
        return render(
            truth.scene,
            image.frame,
            front_m=slab.front_m,
            behind_m=slab.behind_m,
            viewers=viewers,
            supersample=SUPERSAMPLE,
            coloured=chosen.coloured,
            judged=chosen.lattice,
            cores=self.ctx.cores,
        )


def _draw(image: Orthoimage, verdict: _Verdict, ctx: StepContext) -> None:
    ctx.figure(
        f"wall_{image.number}_depth_error",
        partial(depth_error_map, verdict.depth_m, image.frame),
        f"{image.name}: measured minus true depth. Fine grain is scanner noise; a uniform area "
        "shows a plane or surface at the wrong depth.",
    )
    ctx.figure(
        f"wall_{image.number}_colour_error",
        partial(colour_error_map, verdict.grey, image.frame),
        f"{image.name}: colour error. Bright "
        "outlines are displaced edges; bright areas have wrong content or a different exposure.",
    )
    if verdict.sources is not None:
        ctx.figure(
            f"wall_{image.number}_displacement",
            partial(displacement_map, verdict.length_m / image.frame.gsd_m, image.frame),
            f"{image.name}: true displacement of the {1e3 * image.frame.gsd_m:g} mm cells "
            "coloured from photos. Dark is good; a bright area with a sharp border comes from a "
            "photo that is oriented less accurately than its neighbours.",
        )


def _inspection(
    orthoimages: Orthoimages,
    verdicts: list[_Verdict],
    poses: tuple[PoseError, ...],
    findings: list[Finding],
    details: dict[str, JsonValue],
) -> Inspection:
    """Collect the displacements of all patches, and of a few thousand traced cells."""
    walls, points, shifts, kinds = [], [], [], []
    for image, item in zip(orthoimages.images, verdicts, strict=True):
        places = np.concatenate([item.patches.centre, item.cells[:, ::-1] + 0.5])
        walls.append(np.full(len(places), image.wall, dtype=np.int32))
        points.append(image.frame.world_from_wall(places))
        shifts.append(np.concatenate([item.samples.shift_m, item.cell_shift_m]))
        kinds.append(np.repeat([0, 1], [len(item.patches), len(item.cells)]))
    if poses:
        details["poses"] = pose_details(poses)
    return Inspection(
        wall=np.concatenate(walls),
        points_world=np.concatenate(points),
        displacement_m=np.concatenate(shifts),
        kind=np.concatenate(kinds).astype(np.uint8),
        kinds=("patch", "painted cell"),
        findings=tuple(findings),
        details=details,
    )


def _draw_step(image: Orthoimage) -> int:
    """Return n if figures show every nth row and column; 1 unless the wall is large."""
    return max(1, max(image.frame.shape) // _DRAWN_CELLS) if _is_large(image) else 1


def _is_large(image: Orthoimage) -> bool:
    return image.mask.size > BAND_CELLS


def _bands(image: Orthoimage) -> Iterator[Band]:
    """Yield bands of whole blocks, with a margin of one block; a small image is one band."""
    height, width = image.frame.shape
    rows = height
    if _is_large(image):
        rows = BLOCK_CELLS * max(1, BAND_CELLS // (width * BLOCK_CELLS) - 2)
    for first in range(0, height, rows):
        end = min(height, first + rows)
        around = slice(max(0, first - BLOCK_CELLS), min(height, end + BLOCK_CELLS))
        yield Band(rows=slice(first, end), around=around)
