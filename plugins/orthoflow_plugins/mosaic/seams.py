"""`mosaic.seams`: join the layers of each wall into one orthoimage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import ClassVar, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from orthoflow.errors import MethodError
from orthoflow.files.drawing import (
    encode_chart,
    in_column_style,
    picture_figure,
    plane_ink,
)
from orthoflow.files.polygons import NamedPolygon
from orthoflow.geometry.bands import Allocate, count_cells, holds_cells, row_bands
from orthoflow.geometry.levels import eight_bits, plain_tone
from orthoflow.products import (
    SHOWN_STATES,
    Camera,
    Cameras,
    InputFiles,
    JsonValue,
    Layer,
    LayerMask,
    Layers,
    Orthoimage,
    Orthoimages,
    OrthoMask,
    Walls,
)
from orthoflow.sdk import DiagnosticSpec, Method, MetricSpec, Ports, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.mosaic.agreement import (
    count_seams,
    is_seam,
    overlaps_of,
    seam_steps,
)
from orthoflow_plugins.mosaic.balance import Balance, balance_of, with_seams
from orthoflow_plugins.mosaic.consensus import consensus
from orthoflow_plugins.mosaic.drawn_seams import read_seams, seams_of
from orthoflow_plugins.mosaic.expected_errors import expected_errors_m, ties_on
from orthoflow_plugins.mosaic.joining import (
    NOBODY,
    coloured,
    joined,
    require_one_raster,
    require_sources,
)
from orthoflow_plugins.mosaic.parameters import SeamsParams

# Length of the longer side of the figure of the sources, in pixels.
LONGEST_PX: Final = 900
# Maximum number of sources in the legend.
_NAMED_MOST: Final = 24
# The legend has two columns instead of three if a name has at least this many characters.
_LONG_NAME: Final = 16
# Weight of the source colours when they are blended with the grey image.
_TINT: Final = 0.45
# Minimum shares of cells that are empty, that are contradicted, and that are empty for the same
# reason, for a report.
_EMPTY_WORTH_WORDS: Final = 0.1
_CONTRADICTED_WORTH_WORDS: Final = 0.002
_CAUSE_LEAST: Final = 0.01


CONTRADICTED: Final = DiagnosticSpec(
    code="photo-against-scan",
    severity="warning",
    text="{subject}: {share:.1%} of its cells come from a single photo that contradicts the "
    "colours of the scan: the orthoimage may show a passer-by",
    remedy="take another photo of this area, or exclude the photo there with the input seams",
    rank_by="share",
)
PLAIN: Final = DiagnosticSpec(
    code="orthoimage-of-one-tone",
    severity="warning",
    text="{subject}: {share:.0%} of its orthoimage is {tone}, as are its sources ({sources})",
    remedy="check these photos, or the colours of the scan",
    rank_by="share",
)
UNCHECKED: Final = DiagnosticSpec(
    code="accuracy-not-checked",
    severity="note",
    text="{subject}: the accuracy of its orthoimage is unknown, since no photo has a tie on this "
    "wall",
    remedy="measure points on this wall in a photo (input ties), or take a photo that shows it "
    "together with a wall that has ties",
)
EMPTY_IMAGE: Final = DiagnosticSpec(
    code="orthoimage-empty",
    severity="error",
    text="the orthoimage of {subject} is empty: no source shows it",
)
EMPTY_CELLS: Final = DiagnosticSpec(
    code="orthoimage-cells-empty",
    severity="warning",
    text="{share:.0%} of the cells of the orthoimage of {subject} are empty: {causes}",
    rank_by="share",
)


class MosaicSeams(Method):
    """Take each cell from the layer that shows it best, and balance photos where they differ.

    If there is only one layer, it is used unchanged. If there are several, each cell is taken from
    the layer that the rule `seams` prefers, or from the first of equal layers. Filled cells are
    used only where no layer has a measured colour. Small patches are assigned to the source around
    them if that source also shows them.

    `best-view` selects each cell by the angle of incidence, the resolution and the distance from
    the border of the photo. `voronoi` puts seams in the middle of overlaps. `graph-cut` puts seams
    where photos look similar and, if the walls are connected, away from depth edges. `priority`
    uses a given order of photos. Displacements between overlapping photos and colour differences
    along seams are reported.

    If photos contradict each other in a region, the photo that other photos and the colours of the
    scan confirm is used (`robust`). People who appear in one photo only are removed in this way.

    Colours are balanced unless `gains` is none. The corrections consist of the exposure of each
    photo, the vignetting of its lens (if the cameras are connected), a smooth field per photo, and
    a blend of the remaining differences near seams. Corrections are smooth and each cell is taken
    from one photo, so the details of photos are never blended. Photos that agree within 2 % are
    unchanged.
    """

    id: ClassVar[str] = "mosaic.seams"
    repeatable: ClassVar[tuple[str, ...]] = ("seams",)
    determinism: ClassVar[Determinism] = "exact"
    result_version: ClassVar[int] = 2
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_orthoimages", label="orthoimages"),
        MetricSpec("n_sources", label="photos used"),
        MetricSpec("none_share", label="empty cells"),
        MetricSpec("painted_share", label="covered cells"),
        MetricSpec("filled_share", label="cells filled from neighbours"),
        MetricSpec("occluded_share", label="cells hidden from every photo"),
        MetricSpec("no_surface_share", label="cells without a surface"),
        MetricSpec("gain_min", label="smallest gain of a photo"),
        MetricSpec("gain_max", label="largest gain of a photo"),
        MetricSpec("seam_share", label="cells along seams"),
        MetricSpec("seam_on_depth_edge_share", label="share of seam cells on depth edges"),
        MetricSpec(
            "seam_step_rms_grey", label="brightness difference at seams, RMS", better="lower"
        ),
        MetricSpec("seam_step_mean_delta_e", label="colour difference at seams (Delta E), mean"),
        MetricSpec(
            "seam_step_untouched_delta_e",
            label="colour difference at seams before balancing (Delta E), mean",
        ),
        MetricSpec("n_overlap_patches", label="patches compared where photos overlap"),
        MetricSpec(
            "overlap_[uv]_rms_cells",
            label="offset of overlapping photos along {0}, RMS",
            better="lower",
        ),
        MetricSpec(
            "overlap_[uv]_rms_mm",
            label="offset of overlapping photos along {0}, RMS on the wall",
            better="lower",
        ),
        MetricSpec("outvoted_share", label="cells whose colour contradicts the other photos"),
        MetricSpec(
            "contradicted_share", label="cells from a single photo that contradicts the scan"
        ),
        MetricSpec(
            "expected_mm_median",
            label="expected error of a point measured in the orthoimages, median",
        ),
        MetricSpec(
            "expected_mm_p95",
            label="expected error of a point measured in the orthoimages, 95th percentile",
        ),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (4.4)",
        "Kwatra et al. 2003, doi:10.1145/882262.882264 (graph-cut seams)",
    )

    Params = SeamsParams

    class In(Ports):
        """The layers; optionally also walls, cameras (for lenses) and hand-drawn seams."""

        layers: Layers
        walls: Walls | None = None
        cameras: Cameras | None = None
        seams: InputFiles | None = None

    class Out(Ports):
        """One orthoimage per wall."""

        orthoimages: Orthoimages

    def run(self, inputs: In, params: SeamsParams, ctx: StepContext) -> Out:
        """Join the layers of each wall."""
        layers = sorted(inputs.layers.layers, key=lambda layer: layer.wall)
        if not layers:
            raise MethodError("there are no layers, but at least one is needed for an orthoimage")
        require_sources(layers, params.priority)
        polygons = read_seams(inputs.seams, {layer.source for layer in layers})
        verdicts: list[_Joined] = []
        for index, members in groupby(layers, key=lambda layer: layer.wall):
            ctx.progress(index / (layers[-1].wall + 1), inputs.layers.name(index))
            group, allocate = tuple(members), partial(_allocated, ctx, index)
            verdicts.append(_join(inputs, group, params, polygons, ctx, allocate))
            _show(ctx, verdicts[-1].image)
        _report(ctx, verdicts)
        gains: dict[str, JsonValue] = {
            item.image.name: dict(
                zip(
                    item.image.sources,
                    np.exp(item.balance.exposures.exposures).round(4).tolist(),
                    strict=True,
                )
            )
            for item in verdicts
            if item.balance is not None
        }
        return self.Out(
            orthoimages=Orthoimages(
                images=tuple(item.image for item in verdicts),
                icc_profile=inputs.layers.icc_profile,
                layers=inputs.layers.layers if params.publish_layers else None,
                details={"gains": gains} if gains else {},
            )
        )


@dataclass(frozen=True, kw_only=True)
class _Joined:
    """The orthoimage of one wall, and the agreement between its sources.

    Attributes:
        image: the orthoimage.
        shifts_cells: (n, 2) displacements, in cells, between the two best photos in sampled
            patches.
        steps: luminance differences and colour distances along seams.
        n_seam: number of seam cells.
        n_edge_seam: number of seam cells on depth edges; None if the surface is unknown.
        untouched: `steps` before colour balancing.
        balance: the colour balance; None if colours are unchanged.
        n_outvoted: number of cells excluded from photos because other photos contradict them.
    """

    image: Orthoimage
    shifts_cells: NDArray[np.float64]
    steps: tuple[NDArray[np.float64], NDArray[np.float64]]
    n_seam: int
    n_edge_seam: int | None
    untouched: tuple[NDArray[np.float64], NDArray[np.float64]]
    balance: Balance | None
    n_outvoted: int = 0


def _allocated(
    ctx: StepContext, wall: int, name: str, shape: tuple[int, ...], dtype: DTypeLike
) -> NDArray[np.generic]:
    return ctx.allocate("orthoimages", f"{wall}.{name}", shape, dtype).view(np.ndarray)


def _join(
    inputs: MosaicSeams.In,
    group: tuple[Layer, ...],
    params: SeamsParams,
    polygons: Sequence[NamedPolygon],
    ctx: StepContext,
    allocate: Allocate,
) -> _Joined:
    """Join the layers of one wall; `polygons` are the hand-drawn areas of all walls."""
    frame, index = group[0].frame, group[0].wall
    name, number = inputs.layers.name(index), inputs.layers.number(index)
    walls = () if inputs.walls is None else inputs.walls.walls
    wall = walls[index] if index < len(walls) else None
    cameras = {} if inputs.cameras is None else _oriented(inputs.cameras)
    require_one_raster(group, name)
    # A layer without coloured cells is not a source, but it shows which cells are hidden.
    painters = [layer for layer in group if holds_cells(layer.mask, LayerMask.PAINTED)]
    others = [layer for layer in group if all(layer is not painter for painter in painters)]
    n_outvoted, contradicted = 0, None
    if params.robust and painters:
        # Remove people and vehicles before colours are balanced.
        painters, n_outvoted, contradicted = consensus(painters, wall, allocate=allocate)
    sources = [layer.source for layer in painters]
    balance = None
    if params.gains != "none" and len(painters) > 1:
        seen = [cameras.get(source) for source in sources]
        balance = balance_of(painters, wall, seen)
    mask, source = joined(
        painters,
        others,
        params,
        drawn=seams_of(polygons, number, frame, sources),
        wall=wall,
        balance=balance,
        allocate=allocate,
    )
    if contradicted is not None:
        for rows in row_bands(mask.shape):
            is_alone = contradicted[rows] & (mask[rows] == OrthoMask.PAINTED)
            mask[rows][is_alone] = OrthoMask.CONTRADICTED
    steps = untouched = seam_steps(source, painters)
    if balance is not None:
        balance = with_seams(balance, source, wall)
        steps = seam_steps(source, painters, balance)
    n_control, n_check = ties_on(inputs.cameras, number)
    error_m: NDArray[np.float32] | None = None
    if wall is not None and cameras and n_control + n_check:
        overlaps = overlaps_of(group, of_all_pairs=True)
        error_m = expected_errors_m(wall, source, sources, cameras, overlaps, allocate=allocate)
    elif wall is not None and cameras:
        # If no ties are on the wall, its accuracy is unknown.
        error_m = np.asarray(allocate("error_m", frame.shape, np.float32), np.float32)
        error_m[...] = np.nan
        ctx.report(UNCHECKED, subject=name)
    image = Orthoimage(
        frame=frame,
        wall=index,
        name=name,
        plane_index=number,
        rgb=coloured(painters, source, balance, allocate=allocate),
        mask=mask,
        source=source,
        sources=tuple(sources),
        error_m=error_m,
        n_check_points=n_check if wall is not None and cameras else 0,
    )
    n_seam, n_edge_seam = count_seams(source, None if wall is None else wall.depth_m)
    return _Joined(
        image=image,
        shifts_cells=overlaps_of(group).shifts_cells,
        steps=steps,
        n_seam=n_seam,
        n_edge_seam=None if wall is None else n_edge_seam,
        untouched=untouched,
        balance=balance,
        n_outvoted=n_outvoted,
    )


def _oriented(cameras: Cameras) -> dict[str, Camera]:
    return {camera.photo: camera for camera in cameras.cameras if camera.status == "ok"}


def _show(ctx: StepContext, image: Orthoimage) -> None:
    if not image.sources:
        ctx.report(EMPTY_IMAGE, subject=image.name)
    else:
        _report_empty(ctx, image)
        white = 255.0 if image.rgb.dtype == np.uint8 else 65535.0
        if (plain := plain_tone(image.rgb, image.mask, SHOWN_STATES, white=white)) is not None:
            sources = ", ".join(image.sources[:3]) + (" ..." if len(image.sources) > 3 else "")
            tone, share = plain
            ctx.report(PLAIN, subject=image.name, tone=tone, share=share, sources=sources)
    if len(image.sources) > 1:
        ctx.figure(f"wall_{image.number}_sources", partial(_source_map, image), _caption(image))


def _report_empty(ctx: StepContext, image: Orthoimage) -> None:
    words = {
        OrthoMask.NONE: "are in no oriented photo (check why photos were refused, or take another)",
        OrthoMask.OCCLUDED: "are hidden in all photos, or seen too obliquely (take a "
        "photo from another side)",
        OrthoMask.NO_SURFACE: "have no surface (see the step that computed the raster of the wall)",
    }
    shares = {state: count_cells(image.mask, state) / image.mask.size for state in words}
    if shares[OrthoMask.NONE] + shares[OrthoMask.OCCLUDED] < _EMPTY_WORTH_WORDS:
        return
    ordered = sorted(words, key=lambda state: -shares[state])
    causes = "; ".join(
        f"{shares[state]:.0%} {words[state]}" for state in ordered if shares[state] >= _CAUSE_LEAST
    )
    ctx.report(EMPTY_CELLS, subject=image.name, share=sum(shares.values()), causes=causes)


@in_column_style()
def _source_map(image: Orthoimage) -> bytes:
    """Draw an orthoimage tinted by source, with white seams and black empty cells.

    This is Figure 24 of markiewicz2015.
    """
    from matplotlib.patches import Patch

    step = max(1, -(-max(image.source.shape) // LONGEST_PX))
    source = image.source[::step, ::step]
    colours = [plane_ink(k) for k in range(len(image.sources))]
    tint = 255.0 * np.array([*colours, (0.0, 0.0, 0.0)])[source]
    grey = eight_bits(image.rgb[::step, ::step]).mean(axis=2, keepdims=True)
    picture = np.where(source[..., None] >= 0, _TINT * tint + (1.0 - _TINT) * grey, 0.0)
    picture[is_seam(source)] = 255.0
    # List the photos that have the most cells.
    counts = np.bincount(source[source >= 0], minlength=len(image.sources))
    named = sorted(np.argsort(-counts, kind="stable")[:_NAMED_MOST].tolist())
    handles = [Patch(color=colours[k], label=image.sources[k]) for k in named if counts[k]]
    abreast = 3 if max((len(name) for name in image.sources), default=0) < _LONG_NAME else 2
    legend_in = 0.1 + 0.13 * -(-len(handles) // abreast)
    figure, _ = picture_figure(
        np.rint(picture).astype(np.uint8), extra_inches=legend_in, frame=image.frame
    )
    figure.legend(handles=handles, loc="outside lower center", ncols=abreast)
    return encode_chart(figure)


def _caption(image: Orthoimage) -> str:
    n_more = max(0, len(image.sources) - _NAMED_MOST)
    more = f" (the legend omits {n_more} with few cells)" if n_more else ""
    return (
        f"{image.name}, coloured by source{more}; seams in white. Large uniform areas are good; "
        "small patches of many colours mark areas that no photo shows well, where edges may appear "
        "twice."
    )


def _report(ctx: StepContext, verdicts: Sequence[_Joined]) -> None:
    images = [item.image for item in verdicts]
    n_cells = sum(image.mask.size for image in images)
    ctx.metric("n_orthoimages", len(images), "1")
    for state in OrthoMask:
        share = sum(count_cells(image.mask, state) for image in images) / n_cells
        ctx.metric(f"{state.name.lower()}_share", share, "1")
    ctx.metric("n_sources", len({name for image in images for name in image.sources}), "1")
    n_shown = n_cells - sum(count_cells(image.source, NOBODY) for image in images)
    n_seam = sum(item.n_seam for item in verdicts)
    ctx.metric("seam_share", n_seam / max(1, n_shown), "1")
    edges = [item.n_edge_seam for item in verdicts if item.n_edge_seam is not None]
    if edges and n_seam:
        ctx.metric("seam_on_depth_edge_share", sum(edges) / n_seam, "1")
    shifts_cells = np.concatenate([item.shifts_cells for item in verdicts])
    ctx.metric("n_overlap_patches", len(shifts_cells), "1")
    if len(shifts_cells):
        # In millimetres, runs with different cell sizes can be compared.
        shifts_mm = np.concatenate(
            [1e3 * item.image.frame.gsd_m * item.shifts_cells for item in verdicts]
        )
        rms = np.sqrt(np.mean(np.hstack([shifts_cells, shifts_mm]) ** 2, axis=0))
        ctx.metric("overlap_u_rms_cells", rms[0], "cells")
        ctx.metric("overlap_v_rms_cells", rms[1], "cells")
        ctx.metric("overlap_u_rms_mm", rms[2], "mm")
        ctx.metric("overlap_v_rms_mm", rms[3], "mm")
    grey = np.concatenate([item.steps[0] for item in verdicts])
    if len(grey):
        delta_e = np.concatenate([item.steps[1] for item in verdicts])
        ctx.metric("seam_step_rms_grey", float(np.sqrt(np.mean(grey**2))), "grey")
        ctx.metric("seam_step_mean_delta_e", float(delta_e.mean()), "1")
        if any(item.balance is not None for item in verdicts):
            untouched = np.concatenate([item.untouched[1] for item in verdicts])
            ctx.metric("seam_step_untouched_delta_e", float(untouched.mean()), "1")
    n_cells = sum(item.image.mask.size for item in verdicts)
    ctx.metric("outvoted_share", sum(item.n_outvoted for item in verdicts) / n_cells, "1")
    for image in images:
        share = count_cells(image.mask, OrthoMask.CONTRADICTED) / image.mask.size
        if share >= _CONTRADICTED_WORTH_WORDS:
            ctx.report(CONTRADICTED, subject=image.name, share=share)
    known = [
        image.error_m[np.isfinite(image.error_m)] for image in images if image.error_m is not None
    ]
    errors_m = np.concatenate([np.empty(0, np.float32), *known])
    if errors_m.size:
        median, high = 1e3 * np.percentile(errors_m, (50.0, 95.0))
        ctx.metric("expected_mm_median", float(median), "mm")
        ctx.metric("expected_mm_p95", float(high), "mm")
    _report_gains(ctx, verdicts)


def _report_gains(ctx: StepContext, verdicts: Sequence[_Joined]) -> None:
    balances = [item.balance.exposures for item in verdicts if item.balance is not None]
    if balances:
        exposures = np.exp(np.concatenate([item.exposures for item in balances]))
        ctx.metric("gain_min", float(exposures.min()), "1")
        ctx.metric("gain_max", float(exposures.max()), "1")
