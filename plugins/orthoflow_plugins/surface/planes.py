"""`surface.planes`: planes as the first of a scene's surfaces."""

from __future__ import annotations

from typing import ClassVar

from orthoflow.products import Planes, PointLabels, Surfaces
from orthoflow.sdk import Determinism, Method, MethodParams, MetricSpec, Ports, StepContext
from orthoflow_plugins.surface.detector import DetectorOut


class SurfacePlanes(Method):
    """Make planes the first surfaces of a scene, to which detectors of curved surfaces add theirs.

    All surfaces and the labels of points then have the same numbers as the walls.
    """

    id: ClassVar[str] = "surface.planes"
    determinism: ClassVar[Determinism] = "exact"
    metrics: ClassVar[tuple[MetricSpec, ...]] = (MetricSpec("n_planes", label="planes"),)

    class Params(MethodParams):
        """No parameters."""

    class In(Ports):
        """The planes, and the plane of each point."""

        planes: Planes
        labels: PointLabels

    Out = DetectorOut

    def run(self, inputs: In, params: Params, ctx: StepContext) -> DetectorOut:
        """Return the planes as surfaces."""
        del params
        ctx.progress(0.0, "planes")
        ctx.metric("n_planes", len(inputs.planes), "1")
        surfaces = Surfaces(surfaces=(), up=inputs.planes.up, planes=inputs.planes)
        return self.Out(surfaces=surfaces, labels=inputs.labels)
