"""`plane.hough2d`: walls from the plan of the cloud, floors and ceilings from its heights."""

from __future__ import annotations

from typing import ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.geometry import basis_from_up
from orthoflow.products import Planes, PointCloud, PointLabels
from orthoflow.sdk import Method, MethodParams, Ports, StepContext

_LABELS_AT_ONCE: Final = 1 << 20


class Hough2d(Method):
    """Find walls, floors and ceilings by markiewicz2015's modified 2D Hough transform.

    Points are counted in the cells of a plan; every occupied cell votes, with as many votes as it
    has points, for all lines through it. The best line is refined on a sample of the points, with a
    tolerance that shrinks from `tolerance_m` to `fit_tolerance_m`, then fitted to all points at
    once (total least squares of cell means), given a rectangle, and its points are taken away.
    Floors, ceilings and other level planes come from the histogram of heights in the same race.

    The covariance of (normal, offset) respects that neighbouring points share errors; it is
    estimated from the scatter of tiles between 10 and 80 cm, the size with the largest variance.
    """

    id = "plane.hough2d"
    result_version = 1
    determinism = "exact"
    citations = (
        (
            "Markiewicz, Podlasiak, Zawieska 2015: A New Approach to the Generation of Orthoimages "
            "of Cultural Heritage Objects. Remote Sensing 7(12), doi:10.3390/rs71215869"
        ),
    )

    class Params(MethodParams):
        """What may be set; the defaults suit rooms and facades scanned at millimetres."""

        cell_m: float = Field(
            0.02, gt=0.0, le=1.0, description="Side of a cell of the plan and of a distance bin."
        )
        angle_step_deg: float = Field(
            1.0, ge=0.1, le=15.0, description="Step between the directions that are voted for."
        )
        tolerance_m: float = Field(
            0.05, gt=0.0, description="Points this near to a plane belong to it."
        )
        fit_tolerance_m: float = Field(
            0.015, gt=0.0, description="Points this near to a plane take part in its final fit."
        )
        constraint: Literal["free", "exact"] = Field(
            "free",
            description="`exact` keeps walls exactly vertical and levels exactly level; `free` "
            "lets each plane lean as its points say.",
        )
        max_tilt_deg: float = Field(
            10.0,
            gt=0.0,
            le=45.0,
            description="Walls may be off vertical, and levels off level, by this angle.",
        )
        horizontal: bool = Field(
            default=True, description="Find floors, ceilings and other level planes too."
        )
        n_planes_max: int = Field(16, ge=1, le=100, description="Stop after so many planes.")
        min_share: float = Field(
            0.005, gt=0.0, lt=1.0, description="Share of all points that a plane must hold."
        )
        stop_unclassified_share: float = Field(
            0.10,
            ge=0.0,
            lt=1.0,
            description="Stop when a smaller share of the points is on no plane yet.",
        )

    class In(Ports):
        """What it works on."""

        cloud: PointCloud

    class Out(Ports):
        """What it finds."""

        planes: Planes
        labels: PointLabels

    _no_plane: ClassVar[str] = (
        "no plane holds {share:.2%} of the {count} points within {tolerance} m: raise tolerance_m "
        "or fit_tolerance_m for rough or noisy walls, lower min_share for small ones, or raise "
        "max_tilt_deg (plane.hough2d)"
    )

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Detect the planes of a cloud."""
        from orthoflow_plugins.plane.accumulators import PlanProposer
        from orthoflow_plugins.plane.assembling import assemble
        from orthoflow_plugins.plane.deviations import measure_planes
        from orthoflow_plugins.plane.examining import Rules
        from orthoflow_plugins.plane.figures import draw_accumulator, draw_deviations
        from orthoflow_plugins.plane.peeling import find_planes
        from orthoflow_plugins.plane.preparing import prepare
        from orthoflow_plugins.plane.reporting import report_planes

        cloud = inputs.cloud
        rules = Rules(
            find_m=params.tolerance_m,
            fit_m=min(params.fit_tolerance_m, params.tolerance_m),
            n_planes_most=params.n_planes_max,
            least_share=params.min_share,
            stop_unclassified_share=params.stop_unclassified_share,
            tilt_most_deg=params.max_tilt_deg,
            is_exact=params.constraint == "exact",
        )
        ctx.progress(0.0, "counting points over the plan")
        remainder = prepare(
            cloud,
            basis_from_up(cloud.up),
            cell_m=params.cell_m,
            least_share=params.min_share,
            parts=ctx.cores,
        )
        plan = remainder.cells.copy()
        proposer = PlanProposer(
            remainder.grid,
            angle_step_deg=params.angle_step_deg,
            least_points=params.min_share * len(cloud),
            with_levels=params.horizontal,
        )
        found = find_planes(
            remainder, proposer, rules, lambda part, text: ctx.progress(0.1 + 0.7 * part, text)
        )
        if not found:
            raise MethodError(
                self._no_plane.format(
                    share=params.min_share, count=len(cloud), tolerance=params.tolerance_m
                )
            )
        ctx.progress(0.8, "measuring deviations")
        deviations = measure_planes(
            remainder,
            np.array([item.raster.slab() for item in found]),
            np.array([item.footprint.bounds_m for item in found]),
            find_m=rules.find_m,
            fit_m=rules.fit_m,
        )
        assembly = assemble(found, remainder, deviations, cloud)
        labels = ctx.allocate("labels", "plane_index", (len(cloud),), np.int16).view(np.int16)
        # In pieces: numpy widens an index to 64 bits, four times the labels themselves.
        for start in range(0, len(cloud), _LABELS_AT_ONCE):
            piece = slice(start, start + _LABELS_AT_ONCE)
            labels[piece] = assembly.labels_from_claims[remainder.claims[piece]]
        report_planes(ctx, assembly, n_points=len(cloud))
        ctx.progress(0.9, "drawing")
        draw_deviations(ctx, assembly)
        if proposer.first is not None:
            draw_accumulator(ctx, remainder.grid, plan, proposer.first, assembly.planes, cloud)
        return self.Out(planes=assembly.planes, labels=PointLabels(plane_index=labels))
