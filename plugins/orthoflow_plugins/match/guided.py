"""`match.guided`: photos already oriented roughly, matched where they must lie on the walls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from orthoflow.errors import MethodError
from orthoflow.products import Camera, Cameras, JsonValue, Photos, PointCloud, Ties, Walls
from orthoflow.sdk import Method, MethodParams, MetricSpec, Ports, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.match.hand_ties import (
    is_by_hand_alone,
    ties_by_hand_alone,
    with_ties_by_hand,
)
from orthoflow_plugins.match.opencv import one_by_one, opencv_version
from orthoflow_plugins.match.paper import (
    footprints,
    largest_ratio,
    paper_pieces,
    paper_wall_features,
    with_paper_ratio,
)
from orthoflow_plugins.match.pictures import require_photos
from orthoflow_plugins.match.tie_pieces import TiePiece, ties_of
from orthoflow_plugins.match.traced_photos import TracedPhoto, TracedPhotos
from orthoflow_plugins.match.warping import Before

if TYPE_CHECKING:
    from orthoflow_plugins.match.channels import WallTarget
    from orthoflow_plugins.match.tracing import Trace, TracingRule
    from orthoflow_plugins.match.warping import Before

# Points of the cloud with fewer about them are outliers and hide nothing, as in `ortho`.
_POINTS_LEAST = 6


class MatchGuided(Method):
    """Warp each photo into the walls by its pose and measure how far it is displaced there.

    Only what the photo shows of a wall is searched, within a small radius (the mask of
    markiewicz2015 taken to its end), in oriented gradients and in mixtures of the photo's colours,
    which survive that a laser sees another colour than a camera. Cells finer than points lie apart
    are joined for it; patches keep off steps of the relief and, with the cloud wired, off what
    stands free before the walls. The pose is refitted and the photo warped again until held-out
    ties stop improving. Photos without a pose are looked for on what the others show of the walls,
    then traced like these; those not found there give no ties.
    """

    id: ClassVar[str] = "match.guided"
    result_version: ClassVar[int] = 11
    determinism: ClassVar[Determinism] = "exact"
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_ties", label="ties"),
        MetricSpec("rejected_share", label="share of the ties that is rejected"),
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
            "sigma_px_median", label="stated sigma of a tie per axis, median", better="lower"
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
        """Search radius, patches, and how many ties."""

        preset: Literal["none", "paper"] = Field(
            default="none",
            description="paper: the mask of markiewicz2015 and no more: key points as OpenCV sets "
            "SIFT, those of a wall that the photo shows by its pose with their best match in "
            "the photo, once; of the other options `ratio` applies.",
        )
        ratio: float | None = Field(
            default=None,
            gt=0,
            le=1,
            description="With preset: paper alone: largest distance of the best match over the "
            "second best, 0.8 unless given, as its openMVG has it; null for any.",
        )
        search_radius_cells: int = Field(
            default=8,
            ge=2,
            le=64,
            description="How far a place is searched in the first round; halved in every next.",
        )
        half_patch_cells: int = Field(
            default=10, ge=4, le=40, description="Patches are (2 h + 1) cells wide."
        )
        channels: Literal["auto", "gradients", "grey", "colours"] = Field(
            default="auto",
            description="What is compared: oriented gradients; the grey itself, which is sharper "
            "where laser and camera see the same; colours, mixed in each patch as fits the wall "
            "best, where they do not. auto: gradients and grey, and colours where grey is not the "
            "better one; each photo keeps what has the smallest error of held-out ties over the "
            "root of their number and over how far apart they lie.",
        )
        score_min_share: float = Field(
            default=0.35, ge=0, lt=1, description="Smallest correlation of two patches."
        )
        distinct_min_share: float = Field(
            default=0.05,
            ge=0,
            lt=1,
            description="By how much the best correlation must exceed that of another place.",
        )
        n_ties_max: int = Field(
            default=1200, ge=50, description="Places measured per photo, spread evenly."
        )
        n_rounds_max: int = Field(
            default=4, ge=1, le=10, description="Photos are warped and measured at most so often."
        )
        finds_missing: bool = Field(
            default=True,
            description="Whether photos without a pose are looked for on what the others show of "
            "the walls.",
        )

        @model_validator(mode="before")
        @classmethod
        def _preset_fills_in(cls, given: Any) -> Any:
            return with_paper_ratio(given)

    class In(Ports):
        """Photos, the walls, where the photos were taken, roughly, the cloud, ties by hand."""

        photos: Photos
        walls: Walls
        cameras: Cameras
        cloud: PointCloud | None = None
        hand: Ties | None = None

    class Out(Ports):
        """Points of the photos known on the walls."""

        ties: Ties

    # What this very object laid out, if it traced photos.
    _desk: _Desk | None = None

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Trace the photos on the walls, find those without a pose, and make ties."""
        return self._ties(inputs, self._traced(inputs, params, ctx), params, ctx)

    def _traced(self, inputs: In, params: Params, ctx: StepContext) -> TracedPhotos:
        """Trace oriented photos on the walls."""
        from orthoflow_plugins.match.tracing import estimated_lens, trace_photo

        photos, walls = inputs.photos.photos, inputs.walls
        require_photos(inputs.photos)
        if inputs.cloud is not None:
            inputs.cloud.require_points(3)
        if is_by_hand_alone(inputs.hand, walls):
            return TracedPhotos()
        oriented = _oriented(inputs.cameras)
        indices = [index for index, photo in enumerate(photos) if photo.name in oriented]
        if params.preset == "paper":
            ratio = largest_ratio(params.ratio)
            return _masked(inputs.photos, walls, (oriented, indices), ratio, ctx)
        ctx.progress(0.0, "walls")
        rule = _rule(params, max(1, ctx.cores // max(1, len(indices))))
        desk = self._desk = _laid_out(inputs)

        def trace(index: int) -> Trace:
            photo = photos[index]
            lens = estimated_lens(photo, oriented[photo.name].intrinsics)
            camera = oriented[photo.name].viewing()
            return trace_photo(index, photo, camera, desk.targets, rule, desk.before, lens)

        is_any_missing = params.finds_missing and not _has_all(inputs.photos, oriented)
        traced: list[TracedPhoto] = []
        for index, found in zip(indices, one_by_one(trace, indices, ctx.cores), strict=True):
            name = photos[index].name
            traced.append(TracedPhoto.of(found, oriented[name].viewing()))
            if is_any_missing:
                desk.traces[index] = found
            ctx.progress(len(traced) / (len(indices) + 1), name)
            if not any(len(piece) for piece in found.pieces):
                ctx.warn(f"photo {name}: nothing on the walls agrees with it at its pose")
        return TracedPhotos(photos=tuple(traced))

    def _ties(self, inputs: In, found: TracedPhotos, params: Params, ctx: StepContext) -> Out:
        """Find the photos without a pose on what the others show, and make ties."""
        photos, walls = inputs.photos, inputs.walls
        alone = ties_by_hand_alone(inputs.hand, photos, walls, ctx)
        if alone is not None:
            return self.Out(ties=alone)
        if params.preset == "paper":
            ties = ties_of(
                found.pieces, photos, walls, {"intensity_source": walls.intensity_source}
            )
            _report(ctx, ties, {})
            return self.Out(ties=with_ties_by_hand(ties, inputs.hand, walls, ctx))
        traces = {photos.photos[one.photo].name: one for one in found.photos}
        if params.finds_missing:
            traces |= self._recovered(inputs, found.photos, params, ctx)
        ties = ties_of(
            [piece for found in traces.values() for piece in found.pieces],
            photos,
            walls,
            {
                "photos": {name: _note(found) for name, found in traces.items()},
                "intensity_source": walls.intensity_source,
            },
        )
        _report(ctx, ties, traces)
        return self.Out(ties=with_ties_by_hand(ties, inputs.hand, walls, ctx))

    def _recovered(
        self, inputs: In, traced: Sequence[TracedPhoto], params: Params, ctx: StepContext
    ) -> dict[str, TracedPhoto]:
        """Trace the photos without a pose that others help to find, by name."""
        from orthoflow_plugins.match.recovering import recovered_traces

        photos, oriented = inputs.photos, _oriented(inputs.cameras)
        if _has_all(photos, oriented):
            return {}
        desk = self._desk or _laid_out(inputs)
        walls = [target.wall for target in desk.targets]
        known = [
            desk.traces.get(found.photo)
            or found.trace(photos.photos[found.photo], walls, desk.before)
            for found in traced
        ]
        rule = _rule(params, max(1, ctx.cores // len(traced)))
        recovered = recovered_traces(photos, oriented, desk.targets, known, rule, desk.before)
        for name in recovered:
            ctx.log(f"photo {name}: found by what other photos show of the walls")
        return {name: TracedPhoto.of(found, found.view.camera) for name, found in recovered.items()}

    @classmethod
    def tools(cls) -> dict[str, str]:
        """OpenCV warps and correlates."""
        return opencv_version()


@dataclass(frozen=True, kw_only=True)
class _Desk:
    """What photos are laid on: the walls as targets, and what stands before them.

    Attributes:
        targets: the walls.
        before: what stands free before them, where the cloud is wired.
        traces: by index, of photos that lie there still, for those that are looked for with them.
    """

    targets: list[WallTarget]
    before: Before | None
    traces: dict[int, Trace] = field(default_factory=dict)


def _laid_out(inputs: MatchGuided.In) -> _Desk:
    """Prepare the walls, and what any oriented photo has before them."""
    from orthoflow_plugins.match.channels import target_of
    from orthoflow_plugins.match.joined_cells import in_cells_of_points

    oriented = _oriented(inputs.cameras)
    names = [photo.name for photo in inputs.photos.photos if photo.name in oriented]
    return _Desk(
        targets=[target_of(in_cells_of_points(wall)) for wall in inputs.walls.walls],
        before=_before(inputs, [oriented[name] for name in names]),
    )


def _has_all(photos: Photos, oriented: dict[str, Camera]) -> bool:
    return all(photo.name in oriented for photo in photos.photos)


def _masked(
    photos: Photos,
    walls: Walls,
    which: tuple[dict[str, Camera], list[int]],
    ratio_most: float,
    ctx: StepContext,
) -> TracedPhotos:
    """Match as markiewicz2015 did, within the footprint of each oriented photo."""
    oriented, indices = which
    on_walls = list(one_by_one(paper_wall_features, walls.walls, ctx.cores))
    pieces: list[TiePiece] = []
    for nth, index in enumerate(indices):
        photo = photos.photos[index]
        ctx.progress(nth / len(indices), photo.name)
        masks = footprints(oriented[photo.name].viewing(), walls)
        pieces += paper_pieces(index, photo, on_walls, walls, masks, ratio_most=ratio_most)
    return TracedPhotos(pieces=tuple(pieces))


def _oriented(cameras: Cameras) -> dict[str, Camera]:
    """Cameras of the oriented photos by name.

    Raises:
        MethodError: no photo is oriented.
    """
    oriented = {camera.photo: camera for camera in cameras.cameras if camera.status == "ok"}
    if not oriented:
        reasons = "; ".join(f"{camera.photo}: {camera.status}" for camera in cameras.cameras[:3])
        raise MethodError(
            "no photo is oriented, so none can be matched by its pose"
            + (f" ({reasons})" if reasons else "")
        )
    return oriented


def _before(inputs: MatchGuided.In, cameras: list[Camera]) -> Before | None:
    """What stands free before the walls, where the cloud is wired."""
    from orthoflow.geometry.occluders import occluders_before

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
        n_least=_POINTS_LEAST,
        # Photos share the processors already.
        threads=1,
    )
    return Before(occluders=occluders, front_m=tuple(slab.front_m for slab in slabs))


def _rule(params: MatchGuided.Params, threads: int) -> TracingRule:
    from orthoflow_plugins.match.tracing import CONTENTS, TracingRule

    return TracingRule(
        radius_cells=params.search_radius_cells,
        half_patch_cells=params.half_patch_cells,
        score_least=params.score_min_share,
        distinct_least=params.distinct_min_share,
        n_ties_most=params.n_ties_max,
        n_rounds_most=params.n_rounds_max,
        threads=threads,
        contents=CONTENTS if params.channels == "auto" else (params.channels,),
    )


def _note(trace: TracedPhoto) -> JsonValue:
    return {
        "n_ties": trace.n_ties,
        "n_measured": trace.n_measured,
        "n_outliers": trace.n_outliers,
        "channels": trace.content,
        "held_out_px": list(trace.held_out_px),
    }


def _report(ctx: StepContext, ties: Ties, traces: dict[str, TracedPhoto]) -> None:
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
