"""Detection of curved surfaces: sampling, planes, voxels, search, fit to all points, and tests."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import threadpoolctl
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry import Cone, Cylinder, Sphere
from orthoflow.geometry.slabs import read_only_view
from orthoflow.geometry.surfaces import zero_direction
from orthoflow.geometry.threads import in_parts
from orthoflow.products import PointCloud, Surface, Surfaces, surface_kind
from orthoflow.sdk import StepContext
from orthoflow_plugins.surface.fit import CYLINDER_SLOPE, fit_all
from orthoflow_plugins.surface.kernels import replace_labels
from orthoflow_plugins.surface.parameters import DetectorParams
from orthoflow_plugins.surface.rounds import Round
from orthoflow_plugins.surface.search import (
    MOST_RADIUS,
    Form,
    Found,
    Limits,
    Rejected,
    search,
    with_bridged_gaps,
)
from orthoflow_plugins.surface.strips import PlaneTest, tested_planes
from orthoflow_plugins.surface.voxels import Sample, Voxels, draw_sample, in_voxels, noise_of

# Minimum size of the smallest voxels: in metres, in multiples of the noise, and in multiples of the
# point spacing of the sample.
_VOXEL_M: Final = 0.04
_VOXEL_NOISES: Final = 3.0
_VOXEL_SPACINGS: Final = 2.0
# Size of the voxels in which spacing is measured, and minimum size of those in which noise is.
_NOISE_VOXEL_M: Final = 0.1
_FIRST_POINTS: Final = 60_000
# Gaps up to this angle, such as windows, belong to the arc of a surface.
_BRIDGED_RAD: Final = math.radians(15.0)
_LEAST_POINTS: Final = 100
# A surface found among voxels is rejected if the fit to all points moves it by more than the
# tolerance times this factor.
_LARGEST_SHIFT: Final = 1.0
# The profile of a surface is curved everywhere if its mean curvature is at least this many standard
# deviations of the curvature along the arc, and its radius as many of its own (97.5 %, one-sided).
_CURVED_SIGMAS: Final = 1.96
_OUTSIDE_RAD: Final = math.radians(200.0)
# Number of parts into which the circle around an earlier surface is divided.
_OPEN_CELLS: Final = 360


@dataclass(frozen=True, kw_only=True)
class Detection:
    """The result of a detection.

    Attributes:
        surfaces: the new surfaces, in descending order of their numbers of points.
        accepted: the surfaces as found among voxels, in the same order, with the values of
            all tests.
        labels: (n,) int16 index of the surface of each point, counted from the first of the earlier
            ones; -1 for none.
        plane_tests: tests of the given planes.
        rejected: hypotheses that failed the tests.
        noise_m: standard deviation of the points, normal to the surfaces.
        voxel_m: size of the smallest voxels.
    """

    surfaces: tuple[Surface, ...]
    accepted: tuple[Found, ...]
    labels: NDArray[np.int16]
    plane_tests: list[PlaneTest]
    rejected: list[Rejected]
    noise_m: float
    voxel_m: float


def detect(
    cloud: PointCloud,
    plane_index: NDArray[np.int16] | None,
    earlier: Surfaces | None,
    params: DetectorParams,
    ctx: StepContext,
    *,
    form: Form,
) -> Detection:
    """Detect the curved surfaces of a cloud.

    Args:
        cloud: the cloud.
        plane_index: (n,) index of the plane or earlier surface of each point, -1 for none; or None
            if unknown.
        earlier: surfaces that were found before; None if `plane_index` counts planes only.
        params: parameters of the search.
        ctx: context of the step.
        form: the form of the surfaces.

    Raises:
        MethodError: `plane_index` contains the index of a surface that is not in `earlier`.
    """
    ctx.progress(0.0, "sample")
    is_oriented = cloud.stations is not None and len(cloud.stations) > 0
    known = _known(earlier, plane_index, cloud, is_oriented=is_oriented)
    sample = draw_sample(cloud, plane_index, cores=ctx.cores)
    tests = [] if plane_index is None else tested_planes(sample)
    if earlier is not None:
        tests = [test for test in tests if test.index < earlier.n_planes]
    flat = [test.index for test in tests if not test.is_strip]
    searched = sample.take(~np.isin(sample.label, flat)) if flat else sample
    levels, noise_m = _levels(searched, cloud, params, cores=ctx.cores)
    limits = Limits(
        tolerance_m=max(params.tolerance_m, 3.0 * noise_m),
        noise_m=noise_m,
        radius_m=(params.min_radius_m, params.max_radius_m),
        min_arc_rad=math.radians(params.min_arc_deg),
        min_area_m2=params.min_area_m2,
        form=form,
    )
    is_cone = form == "cone"
    # Threads of the linear algebra library would cost more than they save for such small systems.
    with threadpoolctl.threadpool_limits(1):
        found, rejected = search(
            levels, limits, cloud.up, ctx.rng, ctx.progress, is_oriented=is_oriented, earlier=known
        )
        found = [with_bridged_gaps(item, _BRIDGED_RAD) for item in found[: params.max_surfaces]]
        ctx.progress(0.8, "fitting surfaces")
        fitted, labels = fit_all(
            [*found, *known],
            cloud,
            None if plane_index is None else (plane_index, _rows_of(tests, plane_index)),
            [limits.tolerance_at(item.round.radius_m) for item in (*found, *known)],
            noise_m,
            is_cone=is_cone,
            cores=ctx.cores,
        )
    counts = np.array([item.surface.n_points if item else 0 for item in fitted], dtype=np.int64)
    kept: dict[int, tuple[Found, Surface]] = {}
    for index in np.argsort(-counts, kind="stable").tolist():
        fit, evidence = fitted[index], dict(found[index].evidence)
        if fit is None:
            rejected.append(Rejected(reason="unstable", evidence=evidence))
            continue
        evidence |= {
            "scatter_mm": 1000.0 * fit.cell_scatter_m,
            "radius_m": fit.surface.radius_m,
            "shift_mm": 1000.0 * fit.shift_m,
            "half_angle_deg": math.degrees(math.atan(abs(fit.slope))),
            "sigma_radius_mm": 1000.0 * fit.surface.sigma_radius_m,
            "variation": fit.variation,
        }
        shape = fit.surface.shape
        is_steep = abs(fit.slope) > CYLINDER_SLOPE
        is_straight = isinstance(shape, Cone) and shape.half_angle_rad < CYLINDER_SLOPE
        largest_m = params.max_scatter_share * fit.surface.radius_m + noise_m
        if is_steep or (is_cone and (is_straight or isinstance(shape, Cylinder))):
            rejected.append(Rejected(reason="cone" if is_steep else "cylinder", evidence=evidence))
        elif _CURVED_SIGMAS * fit.variation > 1.0:
            rejected.append(Rejected(reason="no circle", evidence=evidence))
        elif (
            counts[index] < _LEAST_POINTS
            or fit.shift_m > _LARGEST_SHIFT * limits.tolerance_m
            or _CURVED_SIGMAS * fit.surface.sigma_radius_m > fit.surface.radius_m
        ):
            rejected.append(Rejected(reason="unstable", evidence=evidence))
        elif fit.cell_scatter_m > largest_m:
            rejected.append(Rejected(reason="rough", evidence=evidence))
        else:
            kept[index] = replace(found[index], evidence=evidence), fit.surface
    n_before = 0 if earlier is None else len(earlier)
    numbers = np.full(len(found) + len(known), -1, dtype=np.int16)
    numbers[list(kept)] = n_before + np.arange(len(kept))
    numbers[len(found) :] = n_before + np.arange(-len(known), 0)
    before = plane_index if earlier is not None and plane_index is not None else labels[:0]
    before = read_only_view(before)

    def renumber(first: int, end: int) -> None:
        replace_labels(labels[first:end], numbers, before[first:end])

    in_parts(renumber, len(labels), threads=ctx.cores)
    return Detection(
        surfaces=tuple(
            _named(surface, n_before + place, cloud.up, is_oriented=is_oriented)
            for place, (_, surface) in enumerate(kept.values())
        ),
        accepted=tuple(item for item, _ in kept.values()),
        labels=labels,
        plane_tests=tests,
        rejected=rejected,
        noise_m=noise_m,
        voxel_m=levels[-1].size_m if levels else 0.0,
    )


def _rows_of(tests: list[PlaneTest], plane_index: NDArray[np.int16]) -> NDArray[np.float64]:
    """Return normal and offset (k, 4) of each plane; NaN for strips and earlier surfaces."""
    rows = np.full((int(plane_index.max(initial=-1)) + 1, 4), np.nan)
    for test in tests:
        if not test.is_strip:
            rows[test.index] = np.append(test.normal, test.offset_m)
    return rows


def _known(
    earlier: Surfaces | None,
    plane_index: NDArray[np.int16] | None,
    cloud: PointCloud,
    *,
    is_oriented: bool,
) -> list[Found]:
    if earlier is None:
        return []
    last = -1 if plane_index is None else int(plane_index.max(initial=-1))
    if last >= len(earlier):
        raise MethodError(
            f"the labels contain surface {last}, but there are only {len(earlier)} surfaces: "
            "connect labels and surfaces to the same step, which for planes is surface.planes"
        )
    return [_as_found(item, cloud, is_oriented=is_oriented) for item in earlier.surfaces]


def _as_found(surface: Surface, cloud: PointCloud, *, is_oriented: bool) -> Found:
    """Return an earlier surface as if it had been found among voxels now."""
    shape, zero = surface.shape, surface.zero_world
    low_m, high_m = surface.along_m
    slope = middle_m = 0.0
    if isinstance(shape, Cone):
        slope, middle_m = math.tan(shape.half_angle_rad), 0.5 * (low_m + high_m)
        low_m, high_m = low_m - middle_m, high_m - middle_m
    is_sphere = isinstance(shape, Sphere)
    if is_sphere:
        zero = zero_direction(surface.axis_world, cloud.up)
        low_m, high_m = (
            surface.radius_m * math.cos(it / surface.radius_m) for it in (high_m, low_m)
        )
    start = shape.point_world if isinstance(shape, Cylinder) else surface.middle_world
    angles = (np.arange(_OPEN_CELLS) + 0.5) * math.tau / _OPEN_CELLS - math.pi
    turned = (angles - surface.arc_rad[0]) % math.tau
    return Found(
        round=Round(
            point=start - cloud.origin,
            axis=surface.axis_world,
            radius_m=surface.radius_m,
            slope=slope,
            is_sphere=is_sphere,
        ),
        zero=zero,
        side=(1.0 if shape.is_concave else -1.0) * is_oriented,
        is_open=is_sphere | (turned < surface.arc_rad[1] - surface.arc_rad[0]),
        along_m=(low_m, high_m),
        evidence={"scatter_mm": 1000.0 * surface.rms_m},
        is_earlier=True,
    )


def _levels(
    sample: Sample, cloud: PointCloud, params: DetectorParams, *, cores: int
) -> tuple[list[Voxels], float]:
    """Return voxels of several sizes, largest first, and the noise of the cloud."""
    if len(sample) < _LEAST_POINTS:
        return [], 0.0
    every = max(1, len(sample) // _FIRST_POINTS)
    first = in_voxels(sample.take(slice(None, None, every)), _NOISE_VOXEL_M)
    # On a surface, the points of a voxel cover an area of about the square of its size.
    per_voxel = max(1.0, every * float(first.moments[:, 0].mean()))
    spacing_m = _NOISE_VOXEL_M / math.sqrt(per_voxel)
    grid = in_voxels(sample, max(_VOXEL_M, _VOXEL_SPACINGS * spacing_m))
    levels = [grid.voxels(cloud, cores=cores)]
    # Voxels of the next size are used to find radii up to twice as large.
    while grid.size_m < max(_NOISE_VOXEL_M, params.max_radius_m / MOST_RADIUS):
        grid = grid.coarser()
        levels.append(grid.voxels(cloud, cores=cores))
    noise_m = noise_of(next(it for it in levels if it.size_m >= _NOISE_VOXEL_M))
    fine = [it for it in levels if it.size_m >= _VOXEL_NOISES * noise_m] or levels[-1:]
    return [it.without_edges(noise_m) for it in fine[::-1]], noise_m


def _named(surface: Surface, index: int, up: NDArray[np.float64], *, is_oriented: bool) -> Surface:
    """Return a surface with its name; if no stations are known, its side follows from its arc."""
    shape = surface.shape
    if not is_oriented:
        start, end = surface.arc_rad
        shape = replace(shape, is_concave=end - start < _OUTSIDE_RAD)
    kind = surface_kind(shape, up, surface.zero_world)
    return replace(surface, shape=shape, name=f"{kind} {index}")
