"""Detection of curved surfaces: sampling, planes, voxels, search, fit to all points, and tests."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Cone, Cylinder
from orthoflow.products import PointCloud, Surface, surface_kind
from orthoflow_plugins.surface.fit import CYLINDER_SLOPE, fit_all
from orthoflow_plugins.surface.parameters import DetectorParams
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
# deviations of the curvature along the arc (97.5 %, one-sided).
_CURVED_SIGMAS: Final = 1.96
_OUTSIDE_RAD: Final = math.radians(200.0)


@dataclass(frozen=True, kw_only=True)
class Detection:
    """The result of a detection.

    Attributes:
        surfaces: the surfaces, in descending order of their numbers of points.
        accepted: the surfaces as found among voxels, in the same order, with the values of
            all tests.
        labels: (n,) int16 index of the surface of each point; -1 for none.
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
    params: DetectorParams,
    rng: np.random.Generator,
    progress: Callable[[float, str], None],
    *,
    form: Form,
    cores: int,
) -> Detection:
    """Detect the curved surfaces of a cloud.

    Args:
        cloud: the cloud.
        plane_index: (n,) index of the plane of each point, -1 for none; or None without planes.
        params: parameters of the search.
        rng: random generator for pairs of voxels.
        progress: receives the completed share of the work, and a text.
        form: the form of the surfaces.
        cores: number of threads.
    """
    progress(0.0, "sample")
    sample = draw_sample(cloud, plane_index, cores=cores)
    tests = [] if plane_index is None else tested_planes(sample)
    flat = [test.index for test in tests if not test.is_strip]
    searched = sample.take(~np.isin(sample.label, flat)) if flat else sample
    levels, noise_m = _levels(searched, cloud, params, cores=cores)
    limits = Limits(
        tolerance_m=max(params.tolerance_m, 3.0 * noise_m),
        noise_m=noise_m,
        radius_m=(params.min_radius_m, params.max_radius_m),
        min_arc_rad=math.radians(params.min_arc_deg),
        min_area_m2=params.min_area_m2,
        form=form,
    )
    is_cone = form == "cone"
    is_oriented = cloud.stations is not None and len(cloud.stations) > 0
    found, rejected = search(levels, limits, cloud.up, rng, progress, is_oriented=is_oriented)
    found = [with_bridged_gaps(item, _BRIDGED_RAD) for item in found[: params.max_surfaces]]
    progress(0.8, "fitting surfaces")
    planes = None
    if plane_index is not None and tests:
        planes = np.full((int(plane_index.max(initial=-1)) + 1, 4), np.nan)
        for test in tests:
            if not test.is_strip:
                planes[test.index] = np.append(test.normal, test.offset_m)
    fitted, labels = fit_all(
        found,
        cloud,
        None if plane_index is None or planes is None else (plane_index, planes),
        [limits.tolerance_at(item.round.radius_m) for item in found],
        noise_m,
        is_cone=is_cone,
        cores=cores,
    )
    counts = np.array([item.surface.n_points for item in fitted], dtype=np.int64)
    kept: dict[int, Found] = {}
    for index in np.argsort(-counts, kind="stable").tolist():
        fit, evidence = fitted[index], dict(found[index].evidence)
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
        elif counts[index] < _LEAST_POINTS or fit.shift_m > _LARGEST_SHIFT * limits.tolerance_m:
            rejected.append(Rejected(reason="unstable", evidence=evidence))
        elif _CURVED_SIGMAS * fit.variation > 1.0:
            rejected.append(Rejected(reason="no circle", evidence=evidence))
        elif fit.cell_scatter_m > largest_m:
            rejected.append(Rejected(reason="rough", evidence=evidence))
        else:
            kept[index] = replace(found[index], evidence=evidence)
    rank = np.full(len(found) + 1, -1, dtype=np.int16)
    rank[list(kept)] = np.arange(len(kept))
    return Detection(
        surfaces=tuple(
            _named(fitted[index].surface, place, cloud.up, is_oriented=is_oriented)
            for place, index in enumerate(kept)
        ),
        accepted=tuple(kept.values()),
        labels=rank[labels] if len(kept) < len(found) or list(kept) != sorted(kept) else labels,
        plane_tests=tests,
        rejected=rejected,
        noise_m=noise_m,
        voxel_m=levels[-1].size_m if levels else 0.0,
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
