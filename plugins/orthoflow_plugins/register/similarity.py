"""`register.similarity`: transform a cloud to the coordinate system of surveyed points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import GeometryError, MethodError
from orthoflow.geometry import UpDirection, up_vector
from orthoflow.products import CheckPoints, Finding, Inspection, JsonValue, PointCloud
from orthoflow.sdk import Method, MethodParams, MetricSpec, Ports, StepContext

_AT_ONCE: Final = 1 << 20
# Points are considered mirrored if the residuals of their mirror image are smaller by this factor.
_MIRRORED_TIMES: Final = 10.0
# Points are considered collinear if the second-largest of their principal spreads is below this
# share of the largest.
_LINE_SHARE: Final = 1e-6


class RegisterSimilarity(Method):
    """Fit translation, rotation and scale to pairs of points, and transform the cloud.

    This is the seven-parameter transformation of skarlatos2012. `points` contains positions in the
    coordinates of the cloud, and `control` contains the surveyed positions. Points with the same
    name form a pair, and all pairs have the same weight. `sigma0_mm` is the standard deviation of a
    coordinate. `left_out_rms_mm` is the RMS distance between each control point and its position
    predicted from the other pairs, so that no pair affects its own distance. The transformed cloud
    has the up direction of the control points.
    """

    id: ClassVar[str] = "register.similarity"
    determinism = "loose"
    metrics = (
        MetricSpec("n_pairs", label="pairs of points"),
        MetricSpec("sigma0_mm", label="standard deviation of a coordinate"),
        MetricSpec(
            "rms_mm", label="residuals of the point pairs, RMS", better="lower", headline=True
        ),
        MetricSpec("max_mm", label="largest residual"),
        MetricSpec("scale", label="scale of the transformation"),
        MetricSpec("scale_ppm", label="deviation of the scale from 1"),
        MetricSpec("left_out_rms_mm", label="leave-one-out residuals, RMS", better="lower"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Umeyama 1991, doi:10.1109/34.88573 (least squares of a similarity)",
        (
            "Skarlatos, Kiparissi, Theodoridou 2012, Direct orthophoto generation from color "
            "point clouds of complex scenes (4.3)"
        ),
    )

    class Params(MethodParams):
        """Parameters of the transformation."""

        with_scale: bool = Field(
            default=True,
            description="Also estimate the scale, for clouds from photos; for laser scans it is 1.",
        )
        up: UpDirection = Field(
            default="z", description="Up direction in the coordinate system of the control points."
        )

    class In(Ports):
        """The cloud, and the same points in both coordinate systems."""

        cloud: PointCloud
        points: CheckPoints
        control: CheckPoints

    class Out(Ports):
        """The transformed cloud, and the residuals in the system of the control points."""

        cloud: PointCloud
        inspection: Inspection

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Pair the points by name, fit the transformation and apply it to the cloud."""
        inputs.cloud.require_points(2)
        names = [name for name in inputs.points.names if name in inputs.control.names]
        source, target = (
            product.points_world[[product.names.index(name) for name in names]]
            for product in (inputs.points, inputs.control)
        )
        n_free = 3 * len(names) - (7 if params.with_scale else 6)
        if n_free < 1:
            raise MethodError(
                "at least 3 names must be in both lists of points, but only these are: "
                f"{', '.join(names) or 'none'} (register.similarity)"
            )
        try:
            fitted = fit_similarity(source, target, with_scale=params.with_scale)
            left_out = _left_out(source, target, with_scale=params.with_scale)
            _require_same_hand(source, target, fitted, with_scale=params.with_scale)
        except GeometryError as error:
            raise MethodError(f"{error} (register.similarity)") from error
        residual_m = fitted.apply(source) - target
        findings = _findings(residual_m, left_out, n_free, fitted)
        for finding in findings:
            ctx.metric(finding.name, finding.value, finding.unit)
        details = _details(names, residual_m, fitted)
        inspection = Inspection(
            wall=np.full(len(names), -1, dtype=np.int32),
            points_world=target,
            displacement_m=residual_m[:, :2].copy(),
            kind=np.zeros(len(names), dtype=np.uint8),
            kinds=("control",),
            findings=tuple(findings),
            details=details,
        )
        moved = replace(_moved(inputs.cloud, fitted, ctx), up=up_vector(params.up))
        return self.Out(cloud=moved, inspection=inspection)


@dataclass(frozen=True, kw_only=True)
class Similarity:
    """`target = translation + scale * rotation @ source`.

    Attributes:
        scale: dimensionless, positive.
        rotation: (3, 3) float64, determinant +1.
        translation: (3,) float64 metres.
    """

    scale: float
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    def apply(self, points_source: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points (n, 3) in target coordinates."""
        return self.scale * points_source @ self.rotation.T + self.translation


def fit_similarity(
    points_source: NDArray[np.float64], points_target: NDArray[np.float64], *, with_scale: bool
) -> Similarity:
    """Fit target_from_source by least squares with equal weights (Umeyama 1991).

    Args:
        points_source: (n, 3) metres, n >= 3, not collinear.
        points_target: (n, 3) metres, the same points in the same order.
        with_scale: whether to fit seven parameters; otherwise, six are fitted and the scale is 1.

    Raises:
        GeometryError: there are too few points, or they are collinear.
    """
    if len(points_source) < 3 or points_source.shape != points_target.shape:
        raise GeometryError(
            f"a similarity needs at least 3 pairs of points, got {len(points_source)}"
        )
    middle_source, middle_target = points_source.mean(axis=0), points_target.mean(axis=0)
    source, target = points_source - middle_source, points_target - middle_target
    spread = np.linalg.svd(source, compute_uv=False)
    if not spread[1] > _LINE_SHARE * spread[0]:
        raise GeometryError(
            "the points of a similarity are on one line: the rotation about this line is "
            "undetermined"
        )
    u, values, vt = np.linalg.svd(target.T @ source)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation: NDArray[np.float64] = u @ np.diag(signs) @ vt
    scale = float(values @ signs / np.sum(source**2)) if with_scale else 1.0
    return Similarity(
        scale=scale,
        rotation=rotation,
        translation=middle_target - scale * rotation @ middle_source,
    )


def _require_same_hand(
    source: NDArray[np.float64],
    target: NDArray[np.float64],
    fitted: Similarity,
    *,
    with_scale: bool,
) -> None:
    """Check that the points are not mirrored; the fit would be poor, and the scale wrong.

    Raises:
        GeometryError: the fit is far better if the source points are mirrored.
    """
    if len(source) < 4:
        return
    mirror = np.array([1.0, 1.0, -1.0])
    mirrored = fit_similarity(source * mirror, target, with_scale=with_scale)
    off_m = float(np.linalg.norm(fitted.apply(source) - target))
    mirrored_off_m = float(np.linalg.norm(mirrored.apply(source * mirror) - target))
    if off_m > _MIRRORED_TIMES * mirrored_off_m and off_m > 1e-3:
        raise GeometryError(
            f"one list of points is a mirror image of the other: residuals are {off_m:.3g} m as "
            f"given, but {mirrored_off_m:.3g} m if the sign of one axis is changed; swap x and y, "
            "or change that sign, in one of the lists"
        )


def _left_out(
    source: NDArray[np.float64], target: NDArray[np.float64], *, with_scale: bool
) -> NDArray[np.float64]:
    """Return the distances (n,) of points from the positions predicted from the others."""
    if len(source) < 4:
        return np.zeros(0)
    apart = []
    for k in range(len(source)):
        others = np.arange(len(source)) != k
        fitted = fit_similarity(source[others], target[others], with_scale=with_scale)
        apart.append(np.linalg.norm(fitted.apply(source[k : k + 1])[0] - target[k]))
    return np.array(apart)


def _findings(
    residual_m: NDArray[np.float64],
    left_out: NDArray[np.float64],
    n_free: int,
    fitted: Similarity,
) -> list[Finding]:
    length_mm = 1e3 * np.linalg.norm(residual_m, axis=1)
    numbers = [
        ("n_pairs", float(len(residual_m)), "1"),
        ("sigma0_mm", 1e3 * float(np.sqrt(np.sum(residual_m**2) / n_free)), "mm"),
        ("rms_mm", float(np.sqrt(np.mean(length_mm**2))), "mm"),
        ("max_mm", float(length_mm.max()), "mm"),
        ("scale", fitted.scale, "1"),
        ("scale_ppm", 1e6 * (fitted.scale - 1.0), "ppm"),
    ]
    if len(left_out):
        numbers.append(("left_out_rms_mm", 1e3 * float(np.sqrt(np.mean(left_out**2))), "mm"))
    return [Finding(name=name, value=value, unit=unit) for name, value, unit in numbers]


def _details(
    names: list[str], residual_m: NDArray[np.float64], fitted: Similarity
) -> dict[str, JsonValue]:
    residuals: list[JsonValue] = [
        {
            "name": name,
            **{f"d{axis}_mm": round(1e3 * float(d), 4) for axis, d in zip("xyz", row, strict=True)},
        }
        for name, row in zip(names, residual_m, strict=True)
    ]
    return {
        "target_from_source": {
            "scale": fitted.scale,
            "rotation": [[float(value) for value in row] for row in fitted.rotation],
            "translation_m": [float(value) for value in fitted.translation],
        },
        "residuals": residuals,
    }


def _moved(cloud: PointCloud, fitted: Similarity, ctx: StepContext) -> PointCloud:
    """Return the cloud in target coordinates; its origin is transformed, too."""
    origin = fitted.apply(cloud.origin[None])[0]
    turn = fitted.scale * fitted.rotation
    offsets = {
        name: np.asarray(ctx.allocate("cloud", name, cloud.x.shape, np.float32)) for name in "xyz"
    }
    for start in range(0, len(cloud), _AT_ONCE):
        ctx.progress(start / len(cloud), "moving the cloud")
        part = slice(start, start + _AT_ONCE)
        old = np.column_stack([cloud.x[part], cloud.y[part], cloud.z[part]]).astype(np.float64)
        for axis, name in enumerate("xyz"):
            offsets[name][part] = old @ turn[axis]
    stations = None if cloud.stations is None else fitted.apply(cloud.stations)
    return replace(
        cloud, origin=origin, x=offsets["x"], y=offsets["y"], z=offsets["z"], stations=stations
    )
