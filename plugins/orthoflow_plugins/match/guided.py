"""`match.guided`: match photos with walls, starting from approximate poses."""

from __future__ import annotations

from importlib.metadata import version
from typing import TYPE_CHECKING, ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.products import (
    PHOTOS_UPSIDE_DOWN,
    Camera,
    Cameras,
    JsonValue,
    Photos,
    PointCloud,
    Ties,
    Walls,
)
from orthoflow.sdk import DiagnosticSpec, Method, MethodParams, MetricSpec, Ports, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.match.pictures import one_by_one, require_photos
from orthoflow_plugins.match.ties import (
    paper_ties,
    ties_by_hand_alone,
    ties_of,
    with_ties_by_hand,
)

if TYPE_CHECKING:
    from orthoflow_plugins.match.tracing import Trace
    from orthoflow_plugins.match.warping import Before

# As in `ortho`, points of the cloud with fewer neighbours than this are outliers and do not hide
# walls.
_MIN_POINTS = 6
NOTHING_AGREES: Final = DiagnosticSpec(
    code="photo-without-matches",
    severity="warning",
    text="photo {subject} matches no part of the walls at its given pose",
    remedy="check its pose, or remove the photo",
)
AMBIGUOUS: Final = DiagnosticSpec(
    code="photo-ambiguous",
    severity="warning",
    text="photo {subject} is not matched again, since photos of identical walls match each of them"
    ": {reason}",
    remedy="measure ties by hand",
)


class MatchGuided(Method):
    """Project each photo onto the walls with its pose, and measure the remaining displacements.

    Only the visible part of a wall is searched, within a small radius (an extension of the mask of
    markiewicz2015). Since laser and camera have different wavelengths, oriented gradients, grey
    values and combinations of the colours of the photo are compared. The channels used for a photo
    are those with the smallest held-out error in relation to the number and spread of their ties.
    Cells finer than the point spacing are joined. Patches at relief steps are excluded, as are
    patches hidden by objects in front of the walls if the cloud is connected. The pose is estimated
    and the photo projected repeatedly, until held-out ties no longer improve. Photos without a pose
    are first matched with the other photos, projected onto the walls; if that fails, or if their
    pose was ambiguous, they get no ties.
    """

    id: ClassVar[str] = "match.guided"
    determinism: ClassVar[Determinism] = "exact"
    result_version: ClassVar[int] = 3
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_ties", label="ties"),
        MetricSpec("rejected_share", label="share of rejected ties"),
        MetricSpec("n_photos_matched", label="photos with accepted matches"),
        MetricSpec("ties_per_photo_median", label="ties per photo, median"),
        MetricSpec(
            "held_out_rmse_px_median",
            label="held-out matches, RMS per axis, median photo",
            better="lower",
            counted_by="n_photos_matched",
        ),
        MetricSpec(
            "held_out_rmse_px_worst",
            label="held-out matches, RMS per axis, worst photo",
            better="lower",
            counted_by="n_photos_matched",
        ),
        MetricSpec(
            "sigma_px_median",
            label="predicted standard deviation of a tie per axis, median",
            better="lower",
        ),
        MetricSpec("n_by_hand", label="ties measured by hand"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (4.3)",
        "Gruen 1985, Adaptive least squares correlation, S. Afr. J. Photogramm. 14(3)",
        "Shi, Tomasi 1994, Good features to track, doi:10.1109/CVPR.1994.323794",
        (
            "Ye et al. 2019, Fast and robust matching for multimodal images, "
            "doi:10.1109/TGRS.2019.2924684"
        ),
    )

    class Params(MethodParams):
        """The preset, the limit of the ratio test, and the maximum number of ties."""

        preset: Literal["none", "paper"] = Field(
            default="none",
            description="paper: as in markiewicz2015; each SIFT key point (OpenCV's defaults) in "
            "the part of a wall that the photo shows is matched with its nearest neighbour "
            "in the photo. Of the other parameters, only `ratio` is used.",
        )
        ratio: float | None = Field(
            default=None,
            gt=0,
            le=1,
            description="Only with preset: paper. Maximum ratio of the distances of the best and "
            "the second best match; 1 accepts any. Default: 0.8, as in openMVG.",
        )
        max_ties: int = Field(
            default=1200,
            ge=50,
            description="Number of positions measured per photo; they are evenly distributed.",
        )

    class In(Ports):
        """Photos, walls, approximate orientations, the cloud, and ties measured by hand."""

        photos: Photos
        walls: Walls
        cameras: Cameras
        cloud: PointCloud | None = None
        hand: Ties | None = None

    class Out(Ports):
        """Tie points between photos and walls."""

        ties: Ties

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Match the oriented photos with the walls first, then the photos without a pose."""
        photos, walls = inputs.photos, inputs.walls
        require_photos(photos)
        if inputs.cloud is not None:
            inputs.cloud.require_points(3)
        alone = ties_by_hand_alone(inputs.hand, photos, walls, ctx)
        if alone is not None:
            return self.Out(ties=alone)
        oriented = _oriented(inputs.cameras)
        if values := inputs.cameras.upside_down(walls.up):
            ctx.report(PHOTOS_UPSIDE_DOWN, **values)
        details: dict[str, JsonValue] = {"intensity_source": walls.intensity_source}
        traces: dict[str, Trace] = {}
        if params.preset == "paper":
            pieces, _ = paper_ties(photos, walls, oriented, params.ratio, ctx)
        else:
            traces = _traced(inputs, oriented, params, ctx)
            pieces = [piece for found in traces.values() for piece in found.pieces]
            details["photos"] = {name: found.json() for name, found in traces.items()}
        ties = ties_of(pieces, photos, walls, details)
        _report(ctx, ties, traces)
        return self.Out(ties=with_ties_by_hand(ties, inputs.hand, walls, ctx))

    @classmethod
    def tools(cls) -> dict[str, str]:
        """OpenCV for warping and filtering."""
        return {"opencv-python-headless": version("opencv-python-headless")}


def _traced(
    inputs: MatchGuided.In,
    oriented: dict[str, Camera],
    params: MatchGuided.Params,
    ctx: StepContext,
) -> dict[str, Trace]:
    """Match oriented photos with the walls first, then the others; return results by name."""
    from orthoflow_plugins.match.channels import WallTarget, in_cells_of_points
    from orthoflow_plugins.match.tracing import (
        Setup,
        estimated_lens,
        recovered_traces,
        trace_photo,
    )

    photos = inputs.photos.photos
    indices = [index for index, photo in enumerate(photos) if photo.name in oriented]
    ctx.progress(0.0, "walls")
    setup = Setup(
        targets=[WallTarget(in_cells_of_points(wall)) for wall in inputs.walls.walls],
        before=_before(inputs, [oriented[photos[index].name] for index in indices]),
        max_ties=params.max_ties,
        threads=max(1, ctx.cores // max(1, len(indices))),
    )

    def trace(index: int) -> Trace:
        photo = photos[index]
        lens = estimated_lens(photo, oriented[photo.name].intrinsics)
        return trace_photo(index, photo, oriented[photo.name].viewing(), setup, lens)

    traces: dict[str, Trace] = {}
    for index, found in zip(indices, one_by_one(trace, indices, ctx.cores), strict=True):
        name = photos[index].name
        traces[name] = found
        ctx.progress(len(traces) / (len(indices) + 1), name)
        if not any(len(piece) for piece in found.pieces):
            ctx.report(NOTHING_AGREES, subject=name)
    if len(indices) == len(photos):
        return traces
    ambiguous = {each.photo: each.status for each in inputs.cameras.cameras if each.is_ambiguous}
    for name, reason in ambiguous.items():
        ctx.report(AMBIGUOUS, subject=name, reason=reason)
    recovered = recovered_traces(
        inputs.photos, oriented, setup, list(traces.values()), ambiguous.keys()
    )
    for name in recovered:
        ctx.log(f"photo {name}: found by matching with other photos projected onto the walls")
    return traces | recovered


def _oriented(cameras: Cameras) -> dict[str, Camera]:
    """Return the cameras of oriented photos by photo name.

    Raises:
        MethodError: no photo is oriented.
    """
    oriented = {camera.photo: camera for camera in cameras.cameras if camera.status == "ok"}
    if not oriented:
        reasons = "; ".join(f"{camera.photo}: {camera.status}" for camera in cameras.cameras[:3])
        raise MethodError(
            "no photo is oriented, but guided matching needs the poses of the photos"
            + (f" ({reasons})" if reasons else "")
        )
    return oriented


def _before(inputs: MatchGuided.In, cameras: list[Camera]) -> Before | None:
    """Return the points in front of the walls, or None if no cloud is connected."""
    from orthoflow.geometry.occluders import occluders_before
    from orthoflow_plugins.match.warping import Before

    cloud, walls = inputs.cloud, inputs.walls
    if cloud is None or not walls.walls:
        return None
    slabs = [walls.slab(index) for index in range(len(walls.walls))]
    occluders = occluders_before(
        cloud,
        slabs,
        [camera.viewing() for camera in cameras],
        spacing_m=walls.points_apart_m(),
        stations_world=cloud.stations,
        n_least=_MIN_POINTS,
        # One thread is enough, since several photos are processed in parallel.
        threads=1,
    )
    return Before(occluders=occluders, front_m=tuple(slab.front_m for slab in slabs))


def _report(ctx: StepContext, ties: Ties, traces: dict[str, Trace]) -> None:
    per_photo = np.bincount(ties.photo, minlength=len(ties.photo_names))
    n_measured = sum(trace.n_measured for trace in traces.values())
    n_outliers = sum(trace.n_outliers for trace in traces.values())
    ctx.metric("n_ties", len(ties.photo), "1")
    ctx.metric("n_photos_matched", int((per_photo > 0).sum()), "1")
    ctx.metric("ties_per_photo_median", float(np.median(per_photo)), "1")
    ctx.metric("rejected_share", n_outliers / max(n_measured, 1), "1")
    held_out = [min(trace.held_out_px) for trace in traces.values() if trace.held_out_px]
    if held_out:
        ctx.metric("held_out_rmse_px_median", float(np.median(held_out)), "px")
        ctx.metric("held_out_rmse_px_worst", max(held_out), "px")
    if len(ties.photo):
        ctx.metric("sigma_px_median", float(np.median(ties.sigma_px)), "px")
