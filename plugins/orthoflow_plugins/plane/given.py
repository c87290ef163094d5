"""`plane.given`: the reference plane of skarlatos2012, which the user states."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from orthoflow.errors import GeometryError, MethodError
from orthoflow.geometry import Plane, basis_from_up, plane_through
from orthoflow.products import PointCloud, PointLabels
from orthoflow.sdk import Method, MethodParams, MetricSpec, StepContext
from orthoflow_plugins.plane.parameters import DetectorIn, DetectorOut

if TYPE_CHECKING:
    from orthoflow_plugins.plane.reference import Reference
    from orthoflow_plugins.plane.sample import PreparedCloud

Vector = tuple[float, float, float]

# The horizontal plane lies below this share of the points: below the scene, above stray echoes.
_GROUND_SHARE: Final = 0.01
# So many points beside the rectangle are no few echoes.
_STRAY_TOLD: Final = 1e-3
# The paper's buffer of three tolerances on either side of a wall.
_BUFFER_TOLERANCES: Final = 3.0


class StatedPlane(MethodParams):
    """One plane, stated in exactly one of three ways."""

    normal: Vector | None = Field(
        None, description="Direction towards the viewer, world axes; any length."
    )
    offset_m: float | None = Field(
        None, description="Distance of the plane from the world origin along the unit normal."
    )
    points: tuple[Vector, Vector, Vector] | None = Field(
        None, description="Three points on the plane, world metres."
    )
    horizontal: bool = Field(
        default=False,
        description="The plane across `up`, seen from above; also what holds by default.",
    )
    height_m: float | None = Field(
        None,
        description="Height of the horizontal plane along `up`, world metres; by default the "
        "height that 1 % of the points are below.",
    )

    @property
    def ways(self) -> tuple[str, ...]:
        """In which of the three ways something is said."""
        ways = {
            "normal": self.normal is not None or self.offset_m is not None,
            "points": self.points is not None,
            "horizontal": self.horizontal or self.height_m is not None,
        }
        return tuple(way for way, is_used in ways.items() if is_used)

    @model_validator(mode="after")
    def _one_way_only(self) -> Self:
        if len(self.ways) > 1:
            raise ValueError(
                f"plane.given takes one of normal with offset_m, points, or horizontal, got "
                f"{' and '.join(self.ways)}"
            )
        if (self.normal is None) != (self.offset_m is None):
            raise ValueError("plane.given needs normal and offset_m together, got only one")
        if self.normal is not None and math.hypot(*self.normal) < 1e-9:
            raise ValueError("normal must have a length, got (0, 0, 0)")
        return self


class GivenPlane(Method):
    """Lay the reference plane, or several, where the user says.

    Each in exactly one of three ways: `normal` with `offset_m` (the side of the normal is the
    viewer's and is never turned), three `points` (world metres; the normal is turned towards the
    viewer), or the `horizontal` plane seen from above, which is also the default, as in
    skarlatos2012. Without `height_m` it lies at the height that 1 % of the points are below.
    Several planes are listed in `planes`; a point near several belongs to the nearest.

    The rectangle spans the points within `buffer_m` of the plane (every point for the horizontal
    one), without parts too small to matter, such as stray echoes beside the scene.
    """

    id = "plane.given"
    result_version = 2
    determinism = "exact"
    metrics = (
        MetricSpec("n_planes", label="planes found"),
        MetricSpec("labelled_share", label="points that lie on a plane"),
        MetricSpec(
            "rms_mm",
            label="points to the first plane, RMS",
            headline=True,
            description="the relief of the wall counts in full: it is no error of the image",
        ),
        MetricSpec("omega_deg", label="direction of the first normal (omega)"),
        MetricSpec("phi_deg", label="inclination of the first normal (phi)"),
        MetricSpec("offset_m", label="offset of the first plane"),
    )
    citations = (
        (
            "Skarlatos, Kiparissi, Theodoridou 2012: Direct orthophoto generation from color point "
            "clouds of complex scenes"
        ),
    )

    class Params(StatedPlane):
        """Where the plane is, or the planes are."""

        planes: tuple[StatedPlane, ...] = Field(
            (),
            max_length=100,
            description="Several planes instead of one, each with its own normal and offset_m, "
            "points, or horizontal and height_m.",
        )
        tolerance_m: float = Field(
            0.05, gt=0.0, description="Points this near to the plane are labelled with it."
        )
        buffer_m: float | None = Field(
            None,
            gt=0.0,
            description="Points this near to the plane span its rectangle; by default three "
            "times tolerance_m, and every point for the horizontal plane.",
        )
        part_min_share: float = Field(
            0.03,
            ge=0.0,
            lt=1.0,
            description="Points that hang together but cover a smaller share of what all of them "
            "cover are taken for stray and left out of the rectangle; 0 keeps every part, but for "
            "the few echoes that a sample of the cloud does not show.",
        )

        @model_validator(mode="after")
        def _one_or_several(self) -> Self:
            if self.planes and self.ways:
                raise ValueError(
                    f"plane.given takes one plane, or several in planes, got {self.ways[0]} beside "
                    "planes: move it into the list"
                )
            return self

    In = DetectorIn
    Out = DetectorOut

    _too_far: ClassVar[str] = (
        "no point of the cloud lies within {buffer:g} m of the plane; along its normal the "
        "points lie between {low:.3f} m and {high:.3f} m of it: check normal and offset_m, points "
        "or height_m, or raise buffer_m (plane.given)"
    )

    def run(self, inputs: DetectorIn, params: Params, ctx: StepContext) -> DetectorOut:
        """Lay the planes and find which points are on them."""
        from orthoflow_plugins.plane.reference import lay_references, prepare_for_references

        cloud = inputs.cloud
        if len(cloud) < 3:
            cloud.require_points(3)
        ctx.progress(0.0, "placing the plane")
        prepared = prepare_for_references(cloud, parts=ctx.cores, part_share=params.part_min_share)
        references = []
        for nth, stated in enumerate(params.planes or (params,)):
            which = f"planes[{nth}]" if params.planes else "the given plane"
            try:
                references.append(self._placed(stated, params, cloud, prepared))
            except MethodError as error:
                raise MethodError(f"{which}: {error}") from error
        ctx.progress(0.4, "labelling points")
        for reference in references:
            _warn_of_stray(reference.n_beside, len(cloud), params.part_min_share, ctx)
        labels = ctx.allocate("labels", "plane_index", (len(cloud),), np.int16).view(np.int16)
        planes = lay_references(
            references, cloud, prepared, labels, tolerance_m=params.tolerance_m, ctx=ctx
        )
        return DetectorOut(planes=planes, labels=PointLabels(plane_index=labels))

    @classmethod
    def _placed(
        cls, stated: StatedPlane, params: Params, cloud: PointCloud, prepared: PreparedCloud
    ) -> Reference:
        from orthoflow_plugins.plane.reference import place_reference

        plane, is_settled = cls._stated(stated, cloud)
        buffer_m = params.buffer_m
        if buffer_m is None and (stated.normal is not None or stated.points is not None):
            buffer_m = _BUFFER_TOLERANCES * params.tolerance_m
        reference = place_reference(
            plane,
            cloud,
            prepared,
            buffer_m=buffer_m,
            keeps_side=is_settled,
            part_share=params.part_min_share,
        )
        if reference is None:
            low_m, high_m = _reach(plane, cloud)
            raise MethodError(
                cls._too_far.format(buffer=buffer_m or math.inf, low=low_m, high=high_m)
            )
        return reference

    @staticmethod
    def _stated(params: StatedPlane, cloud: PointCloud) -> tuple[Plane, bool]:
        """The plane in the cloud's offsets, and whether its side is settled."""
        if params.normal is not None and params.offset_m is not None:
            normal = np.array(params.normal) / math.hypot(*params.normal)
            normal = normal / np.linalg.norm(normal)
            offset_m = params.offset_m - float(normal @ cloud.origin)
            return Plane(normal=normal, offset_m=offset_m), True
        if params.points is not None:
            try:
                return plane_through(np.array(params.points) - cloud.origin), False
            except GeometryError as error:
                raise MethodError(
                    f"plane.given needs three points that span a plane, got {params.points}, "
                    "which lie on one line"
                ) from error
        up = basis_from_up(cloud.up)[2]
        if params.height_m is not None:
            return Plane(normal=up, offset_m=params.height_m - float(up @ cloud.origin)), True
        return Plane(normal=up, offset_m=_ground_m(cloud, up)), True


def _warn_of_stray(n_beside: int, n_points: int, part_share: float, ctx: StepContext) -> None:
    if n_beside > _STRAY_TOLD * n_points:
        ctx.warn(
            f"{n_beside} points ({n_beside / n_points:.2%}) lie beside the rectangle of the plane, "
            f"in parts that cover less than {part_share:.0%} of what all cover: part_min_share "
            "set to 0 keeps them"
        )


def _ground_m(cloud: PointCloud, up: NDArray[np.float64]) -> float:
    from orthoflow_plugins.plane.sample import draw_sample

    return float(np.quantile(draw_sample(cloud).offsets_m @ up, _GROUND_SHARE))


def _reach(plane: Plane, cloud: PointCloud) -> tuple[float, float]:
    from orthoflow_plugins.plane.sample import draw_sample

    distances_m = plane.distances_m(draw_sample(cloud).offsets_m)
    return float(distances_m.min()), float(distances_m.max())
