"""`inspect.surfaces`: compare curved surfaces with those of a simulated scene."""

from __future__ import annotations

import math
from typing import ClassVar, Final

import numpy as np

from orthoflow.geometry import Cone, Sphere, angle_between_deg
from orthoflow.geometry.surfaces import along_and_across
from orthoflow.products import Finding, Inspection, Surface, Surfaces, Truth
from orthoflow.sdk import Determinism, Method, MethodParams, MetricSpec, Ports, StepContext
from orthoflow_plugins.inspect.findings import findings_of, higher, lower

# A surface matches a true one if the angle between the axes, the difference of the radii and the
# distance of the axes are at most these.
_SAME_ANGLE_DEG: Final = 1.0
_SAME_RADIUS_M: Final = 0.05


class InspectSurfaces(Method):
    """Compare curved surfaces with those of a simulated scene.

    A surface matches a true one of the same form if their axes agree within 1 degree and 5 cm, and
    their radii within 5 cm. The distance of the axes is measured at the middle of the detected
    surface; that of spheres is the distance of the centres.
    """

    id: ClassVar[str] = "inspect.surfaces"
    determinism: ClassVar[Determinism] = "exact"
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_true_surfaces", label="true curved surfaces"),
        higher("n_found_surfaces", label="true curved surfaces found"),
        lower("n_false_surfaces", label="false curved surfaces"),
        lower("axis_error_max_deg", label="direction error of an axis, largest"),
        lower("axis_offset_max_mm", label="position error of an axis, largest"),
        lower("radius_error_max_mm", label="error of a radius, largest"),
        MetricSpec(
            "radius_error_over_sigma",
            label="error of a radius divided by the predicted error, RMS",
            better="one",
        ),
    )

    class Params(MethodParams):
        """No parameters."""

    class In(Ports):
        """The surfaces to compare, and the truth."""

        truth: Truth
        surfaces: Surfaces

    class Out(Ports):
        """The errors of the surfaces."""

        inspection: Inspection

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Compare the surfaces."""
        del params
        ctx.progress(0.0, "curved surfaces")
        true = () if inputs.truth.surfaces is None else inputs.truth.surfaces.surfaces
        left = list(inputs.surfaces.surfaces)
        errors, ratios = [], []
        findings: list[Finding] = []
        for surface in true:
            found = min(left, key=lambda item: max(_errors(item, surface)), default=None)
            if found is None or not _is_same(found, surface):
                continue
            left = [item for item in left if item is not found]
            own = _errors(found, surface)
            errors.append(own)
            if found.sigma_radius_m > 0.0:
                ratios.append(own[2] / (1000.0 * found.sigma_radius_m))
            names = ("axis_error_deg", "axis_offset_mm", "radius_error_mm")
            findings += findings_of(
                (f"{name}[{surface.name}]", value, name.rpartition("_")[2])
                for name, value in zip(names, own, strict=True)
            )
        counts = (
            ("n_true_surfaces", float(len(true)), "1"),
            ("n_found_surfaces", float(len(errors)), "1"),
            ("n_false_surfaces", float(len(left)), "1"),
        )
        largest = np.max(errors, axis=0).tolist() if errors else []
        worst = zip(
            ("axis_error_max_deg", "axis_offset_max_mm", "radius_error_max_mm"),
            largest,
            ("deg", "mm", "mm"),
            strict=bool(largest),
        )
        findings += findings_of((*counts, *worst))
        if ratios:
            ratio = math.sqrt(float(np.mean(np.square(ratios))))
            findings += findings_of([("radius_error_over_sigma", ratio, "1")])
        for item in findings:
            if "[" not in item.name:
                ctx.metric(item.name, item.value, item.unit)
        return self.Out(
            inspection=Inspection(
                wall=np.zeros(0, dtype=np.int32),
                points_world=np.zeros((0, 3)),
                displacement_m=np.zeros((0, 2)),
                kind=np.zeros(0, dtype=np.uint8),
                kinds=(),
                findings=tuple(findings),
            )
        )


def _errors(found: Surface, true: Surface) -> tuple[float, float, float]:
    """Return errors of direction (degrees), position and radius (mm) of an axis."""
    axis = true.axis_world
    angle_deg = angle_between_deg(found.axis_world, axis)
    middle = found.middle_world
    _, across = along_and_across(middle[None], true.middle_world, axis)
    if isinstance(true.shape, Sphere):
        # The axis of a sphere only states which part of it was found.
        angle_deg, across = 0.0, middle - true.middle_world
    radius_m = true.radius_m
    if isinstance(true.shape, Cone):
        # The extents may differ, so the radii are compared at the same place.
        along_m = float((middle - true.shape.apex_world) @ axis)
        radius_m = along_m * math.tan(true.shape.half_angle_rad)
    return (
        min(angle_deg, 180.0 - angle_deg),
        1000.0 * float(np.linalg.norm(across)),
        1000.0 * abs(found.radius_m - radius_m),
    )


def _is_same(found: Surface, true: Surface) -> bool:
    angle_deg, offset_mm, radius_mm = _errors(found, true)
    if type(found.shape) is not type(true.shape):
        return False
    is_near = max(offset_mm, radius_mm) <= 1000.0 * _SAME_RADIUS_M
    return angle_deg <= _SAME_ANGLE_DEG and is_near
