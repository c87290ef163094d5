"""`inspect.surf`: compare orthoimages with the laser intensity by SURF key points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.products import (
    Cameras,
    Finding,
    Inspection,
    Orthoimage,
    Orthoimages,
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
from orthoflow_plugins.inspect.figures import draw_arrows
from orthoflow_plugins.inspect.findings import (
    COMPLETENESS,
    DISPLACEMENTS,
    IMAGE_QUALITY,
    displacement_findings,
    findings_of,
    lower,
    of_walls,
    prefixed,
    report,
)
from orthoflow_plugins.inspect.image_quality import (
    OrthoimageGrey,
    completeness,
    n_shown,
    quality_findings,
)
from orthoflow_plugins.inspect.key_pairs import find_key_pairs
from orthoflow_plugins.inspect.patches import GreyImage, IntensityGrey, PatchShifts, unrefined
from orthoflow_plugins.inspect.placing import in_files, on_walls, wall_of

# The accuracy of the comparison is measured by comparing the intensity with a copy shifted by this
# much.
_FLOOR_SHIFT_CELLS: Final = (0.5, 0.25)
# Maximum side of the tile that is compared with a shifted copy.
_FLOOR_CELLS: Final = 600
_FEWEST_PAIRS: Final = 10
_NO_PAIRS: Final = unrefined(*np.zeros((2, 0, 2)))
# Radius within which the counterpart of a key point is searched for; it is large enough for gross
# errors.
_RADIUS_CELLS: Final = 40.0
UNFIT: Final = DiagnosticSpec(
    code="surf-not-inspected",
    severity="warning",
    text="not inspected: {reason}",
)


class InspectSurf(Method):
    """Measure displacements between an orthoimage and the laser intensity of the same wall.

    This is the inspection of markiewicz2015: SURF key points of both images are paired, and the
    displacements of the pairs are the errors (Table 2), which are drawn as a map (Figure 25). Both
    images have the same grid, so the counterpart of a key point is searched for only within a
    radius. Each pair is then refined by least squares, because SURF alone is accurate to about a
    cell, which is as large as the errors to be measured. A comparison of the intensity with a
    shifted copy of itself gives the best possible accuracy (`floor_`). `x` points right along u,
    and `y` down along v. Displacements are positions in the orthoimage minus positions in the
    intensity. Metrics without a prefix describe the first wall, those with `all_` describe all
    walls together, and those with `surf_` describe the pairs before the refinement.

    Without laser intensity, the comparison is meaningless, since the colours of the scan may come
    from the same photos. The inspection then fails, or is skipped with a warning.
    """

    id: ClassVar[str] = "inspect.surf"
    determinism: ClassVar[Determinism] = "loose"
    result_version: ClassVar[int] = 2
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_walls_inspected", label="walls inspected"),
        *of_walls(
            (
                MetricSpec("n_pairs", label="key point pairs"),
                lower("surf_rmse_[xy]_mm", label="displacement along {0} by SURF, RMS"),
                MetricSpec(
                    "surf_beyond_2rmse_[xy]_share",
                    label="share of displacements beyond twice the RMS along {0} by SURF",
                ),
                MetricSpec(
                    "surf_floor_rmse_[xy]_mm",
                    label="displacement along {0} by SURF, intensity with itself, RMS",
                ),
                *DISPLACEMENTS,
                *prefixed(DISPLACEMENTS, "floor_", "intensity with itself"),
                COMPLETENESS,
                *IMAGE_QUALITY,
            )
        ),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (4.4, Table 2, Figure 25)",
        "Bay, Ess, Tuytelaars, Van Gool 2008, SURF: Speeded-Up Robust Features",
        "Gruen 1985, Adaptive least squares correlation, S. Afr. J. Photogramm. 14(3)",
    )

    class Params(MethodParams):
        """Handling of meaningless comparisons."""

        unfit: Literal["refuse", "warn"] = Field(
            "refuse",
            description="Behaviour without laser intensity or with too few pairs. refuse: the "
            "step fails; warn: the run continues without this inspection.",
        )

    class In(Ports):
        """The orthoimages, their walls, and cameras, which are needed to find stretched areas."""

        orthoimages: Orthoimages
        walls: Walls
        cameras: Cameras | None = None

    class Out(Ports):
        """The displacements."""

        inspection: Inspection

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Compare each wall, then compute the results for all walls together."""
        images = on_walls(inputs.orthoimages, inputs.walls).images
        if not images:
            raise MethodError("there is no orthoimage to inspect")
        reason = _unfit(inputs)
        verdicts: list[_Verdict] = []
        for place, image in enumerate(images if reason is None else ()):
            ctx.progress(place / len(images), image.name)
            wall = wall_of(image, inputs.walls, in_files(ctx, f"{place}.laid"))
            verdicts.append(_compared(image, wall, inputs.cameras, ctx.cores))
        fit = [item for item in verdicts if len(item.pairs) >= _FEWEST_PAIRS]
        if reason is None and not fit:
            most = max(len(item.pairs) for item in verdicts)
            reason = (
                f"orthoimage and intensity are too different: at least {_FEWEST_PAIRS} pairs of "
                f"SURF key points are needed on a wall, and the largest number found is {most}"
            )
        if reason is not None:
            if params.unfit == "refuse":
                raise MethodError(f"{reason} (to continue, set `unfit: warn` in inspect.surf)")
            ctx.report(UNFIT, reason=reason)
        findings = [finding for item in fit for finding in item.findings()]
        if fit:
            findings += _together(fit)
            numbers = {item.image.wall: item.image.number for item in fit}
            report(findings, fit[0].image.wall, numbers, ctx)
        for item in fit:
            item.draw(ctx)
        ctx.metric("n_walls_inspected", len(fit), "1")
        return self.Out(inspection=_inspection(fit, findings, reason))


@dataclass(frozen=True, kw_only=True)
class _Verdict:
    """Pairs of one wall, and pairs of the intensity with its shifted copy."""

    image: Orthoimage
    pairs: PatchShifts = _NO_PAIRS
    floor: PatchShifts = _NO_PAIRS
    quality: tuple[Finding, ...] = ()

    def findings(self) -> list[Finding]:
        wall = self.image.wall
        gsd_m = self.image.frame.gsd_m
        n_pairs = findings_of([("n_pairs", len(self.pairs), "1")], wall)
        return [*n_pairs, *_numbers([self], wall, gsd_m), *self.quality]

    def draw(self, ctx: StepContext) -> None:
        """Draw the displacements (markiewicz2015, Figure 25)."""
        draw_arrows(
            ctx,
            f"wall_{self.image.number}_displacements",
            self.image,
            self.pairs.centre,
            self.pairs.shift,
            title="displacements between orthoimage and intensity",
        )


def _unfit(inputs: InspectSurf.In) -> str | None:
    """Return why a comparison with the walls is meaningless, or None."""
    if inputs.walls.intensity_source == "laser":
        return None
    if inputs.walls.intensity_source == "luminance":
        return (
            "the walls have no laser intensity, so the grey of the scan's colours is used instead; "
            "if the scan was coloured from the same photos, wrong orientations are not detected"
        )
    return "the walls have neither intensity nor colour to compare with"


def _compared(image: Orthoimage, wall: Wall, cameras: Cameras | None, threads: int) -> _Verdict:
    """Return the pairs of a wall; other results are only computed if there are enough pairs."""
    if wall.intensity is None:
        raise MethodError(f"{wall.name} has no intensity to compare with")
    if not n_shown(image):
        return _Verdict(image=image)
    intensity = IntensityGrey(intensity=wall.intensity, of_roots=True)
    find = partial(find_key_pairs, radius_cells=_RADIUS_CELLS, threads=threads)
    pairs = find(OrthoimageGrey(image), intensity)
    if len(pairs) < _FEWEST_PAIRS:
        return _Verdict(image=image, pairs=pairs)
    part = intensity.fullest_part(_FLOOR_CELLS)
    floor = find(_set_aside(part), part)
    return _Verdict(
        image=image,
        pairs=pairs,
        floor=replace(
            floor, shift=floor.shift - _FLOOR_SHIFT_CELLS, found=floor.found - _FLOOR_SHIFT_CELLS
        ),
        quality=(completeness(image, wall), *quality_findings(image, wall, cameras)),
    )


def _set_aside(intensity: GreyImage) -> GreyImage:
    """Return a shifted copy of the intensity, which reveals the errors of the comparison."""
    import cv2

    right, down = _FLOOR_SHIFT_CELLS
    rows, columns = intensity.grey.shape
    move = np.array([[1.0, 0.0, right], [0.0, 1.0, down]])
    # Cubic interpolation keeps most of the detail, whereas linear interpolation would smooth the
    # shifted image.
    grey = cv2.warpAffine(
        intensity.grey.astype(np.float32), move, (columns, rows), flags=cv2.INTER_CUBIC
    )
    whole = cv2.warpAffine(
        intensity.valid.astype(np.float32), move, (columns, rows), flags=cv2.INTER_LINEAR
    )
    valid = np.asarray(whole) > 0.999
    return GreyImage(grey=np.asarray(grey, dtype=np.float64), valid=valid, region=valid)


def _numbers(items: list[_Verdict], wall: int, gsd_m: float) -> list[Finding]:
    def joined(which: str, what: str) -> list[NDArray[np.float64]]:
        return [item.image.frame.gsd_m * getattr(getattr(item, which), what) for item in items]

    findings = displacement_findings(np.concatenate(joined("pairs", "shift")), gsd_m, wall)
    for prefix, which, what in (
        ("surf_", "pairs", "found"),
        ("floor_", "floor", "shift"),
        ("surf_floor_", "floor", "found"),
    ):
        shift = np.concatenate(joined(which, what))
        if len(shift):
            wanted = {f"{prefix}rmse_{axis}_mm" for axis in "xy"}
            if prefix == "surf_":
                wanted |= {f"surf_beyond_2rmse_{axis}_share" for axis in "xy"}
            numbers = displacement_findings(shift, gsd_m, wall, prefix=prefix)
            findings += [finding for finding in numbers if finding.name in wanted]
    return findings


def _together(items: list[_Verdict]) -> list[Finding]:
    n_pairs = sum(len(item.pairs) for item in items)
    coarsest = max(item.image.frame.gsd_m for item in items)
    return [*findings_of([("n_pairs", n_pairs, "1")]), *_numbers(items, -1, coarsest)]


def _inspection(items: list[_Verdict], findings: list[Finding], reason: str | None) -> Inspection:
    points = [item.image.frame.world_from_wall(item.pairs.centre) for item in items]
    shifts = [item.image.frame.gsd_m * item.pairs.shift for item in items]
    walls = [np.full(len(item.pairs), item.image.wall, dtype=np.int32) for item in items]
    n_points = sum(len(item.pairs) for item in items)
    return Inspection(
        wall=np.concatenate([np.zeros(0, dtype=np.int32), *walls]),
        points_world=np.concatenate([np.zeros((0, 3)), *points]),
        displacement_m=np.concatenate([np.zeros((0, 2)), *shifts]),
        kind=np.zeros(n_points, dtype=np.uint8),
        kinds=("SURF pair",),
        findings=tuple(findings),
        details={
            "floor_shift_cells": list(_FLOOR_SHIFT_CELLS),
            "not_inspected_because": reason or "",
        },
    )
