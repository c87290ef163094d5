"""Base class of the detectors of curved surfaces."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING, ClassVar, Final

from orthoflow.products import PointCloud, PointLabels, Surfaces
from orthoflow.sdk import (
    Determinism,
    DiagnosticSpec,
    Method,
    MetricSpec,
    Ports,
    StepContext,
)
from orthoflow_plugins.surface.parameters import DetectorParams

if TYPE_CHECKING:
    from orthoflow_plugins.surface.detection import Detection
    from orthoflow_plugins.surface.search import Form

STRIP: Final = DiagnosticSpec(
    code="plane-is-curved",
    severity="note",
    text="{subject} is a strip of a curved surface: it turns by {turn_deg:.1f} deg, with a sagitta "
    "of {sagitta_mm:.1f} mm and a noise of {sigma_mm:.1f} mm",
    rank_by="turn_deg",
)
REJECTED: Final = DiagnosticSpec(
    code="surface-rejected",
    severity="note",
    text="{subject} of radius {radius_m:.2f} m was rejected ({reason}): arc {arc_deg:.0f} deg, "
    "area {area_m2:.2f} m2, scatter {scatter_mm:.1f} mm, sagitta {sagitta_mm:.0f} mm, rotation of "
    "the normals divided by the angle {turning:.2f} (1 on a round surface, 0 on flat parts)",
    rank_by="area_m2",
)
NO_CIRCLE: Final = DiagnosticSpec(
    code="profile-no-circle",
    severity="warning",
    text="the profile of {subject} is no circle: along the arc, its radius of curvature differs "
    "from {radius_m:.2f} m by {differs_mm:.0f} mm (RMS), which its stated error includes",
    rank_by="differs_mm",
)
SIDE_GUESSED: Final = DiagnosticSpec(
    code="surface-sides-unknown",
    severity="warning",
    text="the positions of the scanner are unknown, and so are the sides from which the curved "
    "surfaces ({n}) were seen; those whose arc exceeds 200 deg are assumed to be seen from outside",
    remedy="set {step[read.scan]}.view_from",
    rank_by="n",
)


class DetectorIn(Ports):
    """The cloud, the labels of its points, and the earlier surfaces, to which others are added.

    Without earlier surfaces, labels are those of planes.
    """

    cloud: PointCloud
    labels: PointLabels | None = None
    surfaces: Surfaces | None = None


class DetectorOut(Ports):
    """All surfaces, and the surface of each point."""

    surfaces: Surfaces
    labels: PointLabels


class Detector(Method):
    """Base class of the detectors of curved surfaces."""

    result_version = 9
    determinism: ClassVar[Determinism] = "seeded"
    metrics: ClassVar[tuple[MetricSpec | str, ...]] = (
        MetricSpec("n_surfaces", label="curved surfaces found"),
        MetricSpec("labelled_share", label="share of points on a curved surface"),
        MetricSpec("noise_mm", label="scan noise normal to the surfaces"),
        MetricSpec("voxel_mm", label="size of the smallest voxels searched"),
        MetricSpec("n_curved_planes", label="planes that are strips of curved surfaces"),
        MetricSpec("n_rejected", label="hypotheses rejected by the tests"),
        MetricSpec("radius_m", label="radius of the first surface", headline=True),
        MetricSpec("arc_deg", label="arc of the first surface"),
        MetricSpec("rms_mm", label="distance of points from the first surface, RMS"),
        MetricSpec(
            "sigma_axis_deg",
            label="predicted standard deviation of the first axis's direction",
            better="lower",
        ),
        MetricSpec(
            "sigma_radius_mm",
            label="predicted standard deviation of the first radius",
            better="lower",
        ),
        MetricSpec("detection_s", label="detection time", better="lower"),
        MetricSpec("detection_cpu_s", label="CPU time of the detection", better="lower"),
    )
    In = DetectorIn
    Out = DetectorOut
    form: ClassVar[Form]

    def run(self, inputs: DetectorIn, params: DetectorParams, ctx: StepContext) -> DetectorOut:
        """Detect the curved surfaces of a cloud."""
        from orthoflow_plugins.surface.detection import detect

        cloud = inputs.cloud
        cloud.require_points(3)
        start_s, start_cpu_s = ctx.clock_s(), ctx.processor_s()
        found = detect(
            cloud,
            None if inputs.labels is None else inputs.labels.plane_index,
            inputs.surfaces,
            params,
            ctx,
            form=self.form,
        )
        ctx.metric("detection_s", ctx.clock_s() - start_s, "s")
        ctx.metric("detection_cpu_s", ctx.processor_s() - start_cpu_s, "s")
        self._report(found, cloud, ctx)
        earlier = inputs.surfaces
        surfaces = Surfaces(
            surfaces=(*(() if earlier is None else earlier.surfaces), *found.surfaces),
            up=cloud.up,
            planes=None if earlier is None else earlier.planes,
            details={
                "planes": [
                    asdict(test) | {"normal": test.normal.tolist()} for test in found.plane_tests
                ],
                "rejected": [{"reason": item.reason, **item.evidence} for item in found.rejected],
                "tests": [dict(item.evidence) for item in found.accepted],
            },
        )
        return self.Out(surfaces=surfaces, labels=PointLabels(plane_index=found.labels))

    def _report(self, found: Detection, cloud: PointCloud, ctx: StepContext) -> None:
        ctx.metric("n_surfaces", len(found.surfaces), "1")
        labelled = sum(surface.n_points for surface in found.surfaces)
        ctx.metric("labelled_share", labelled / max(1, len(cloud)), "1")
        ctx.metric("noise_mm", 1000.0 * found.noise_m, "mm")
        ctx.metric("voxel_mm", 1000.0 * found.voxel_m, "mm")
        strips = [test for test in found.plane_tests if test.is_strip]
        ctx.metric("n_curved_planes", len(strips), "1")
        ctx.metric("n_rejected", len(found.rejected), "1")
        for test in strips:
            ctx.report(
                STRIP,
                subject=f"plane {test.index}",
                sagitta_mm=test.sagitta_mm,
                sigma_mm=test.sigma_mm,
                turn_deg=test.turn_deg,
            )
        # For each reason, only the largest hypothesis is reported.
        tested = [item for item in found.rejected if "turning" in item.evidence]
        largest = {
            item.reason: item for item in sorted(tested, key=lambda item: item.evidence["area_m2"])
        }
        for item in largest.values():
            varied = 100.0 * item.evidence.get("variation", 0.0)
            reason = item.reason + (f", curvature differs by {varied:.0f} % RMS" if varied else "")
            ctx.report(REJECTED, subject=f"a {self.form}", reason=reason, **item.evidence)
        for surface, accepted in zip(found.surfaces, found.accepted, strict=True):
            if varied := accepted.evidence["variation"]:
                differs_mm = 1000.0 * varied * surface.radius_m
                ctx.report(
                    NO_CIRCLE,
                    subject=surface.name,
                    radius_m=surface.radius_m,
                    differs_mm=differs_mm,
                )
        if found.surfaces and (cloud.stations is None or not len(cloud.stations)):
            ctx.report(SIDE_GUESSED, n=len(found.surfaces))
        if found.surfaces:
            first = found.surfaces[0]
            ctx.metric("radius_m", first.radius_m, "m")
            ctx.metric("arc_deg", math.degrees(first.arc_rad[1] - first.arc_rad[0]), "deg")
            ctx.metric("rms_mm", 1000.0 * first.rms_m, "mm")
            if self.form != "sphere":
                ctx.metric("sigma_axis_deg", first.sigma_axis_deg, "deg")
            ctx.metric("sigma_radius_mm", 1000.0 * first.sigma_radius_m, "mm")
