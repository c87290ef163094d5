"""The simulated room as an example for methods that use a scan or its ground truth.

Its values are bit-identical on all processors, because the results of sums, roots and angles are
rounded to far fewer digits than are accurate.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.geometry import up_vector
from orthoflow.products import Planes, PointCloud, PointLabels, Product, Surfaces, Truth
from orthoflow.sdk import StepContext

_SCAN_STEP_M: Final = 0.08
# Number of planes in the example, which are the main wall and the floor.
_N_PLANES: Final = 2
# Number of decimals kept; rounding errors of metres and unit vectors are ten million times smaller.
_DECIMALS: Final = 9


def settled(values: NDArray[np.float64], decimals: int = _DECIMALS) -> NDArray[np.float64]:
    """Round values so that neither the order of summation nor fused instructions affect them."""
    # Adding zero converts minus zero, whose bits differ from those of zero.
    return np.asarray(np.round(values, decimals) + 0.0)


def few_points(offsets_m: NDArray[np.floating], grey: int | NDArray[np.uint8] = 128) -> PointCloud:
    """Return a grey cloud of points at positions (n, 3) in metres, with a station at the origin."""
    x, y, z = np.ascontiguousarray(offsets_m.T, dtype=np.float32)
    greys = np.broadcast_to(np.uint8(grey), x.shape)
    return PointCloud(
        origin=np.zeros(3),
        x=x,
        y=y,
        z=z,
        up=up_vector("z"),
        intensity=(greys / 255.0).astype(np.float32),
        rgb=np.repeat(greys[:, np.newaxis], 3, axis=1),
        stations=np.zeros((1, 3)),
        stations_source="file",
    )


@cache
def _room() -> tuple[PointCloud, Truth]:
    method = discover_catalog().method("simulate.room").load()
    with TemporaryDirectory(prefix="orthoflow-example-") as folder:
        ctx = StepContext(rng=np.random.default_rng(1), cores=1, scratch=Path(folder))
        params = method.Params.model_validate({"scan_step_m": _SCAN_STEP_M})
        made = vars(method().run(method.In(), params, ctx))
    cloud, truth = made["cloud"], made["truth"]
    sides = ("origin", "centre", "axis_a", "axis_b", "extent", "hole_extent")
    scene = {name: settled(getattr(truth.scene, name)) for name in sides}
    fitted = ("normal", "offset", "corners", "rms_m")
    planes = {name: settled(getattr(truth.planes, name)) for name in fitted}
    return cloud, replace(
        truth,
        scene=replace(truth.scene, **scene),
        planes=replace(truth.planes, **planes),
        stations=settled(truth.stations),
    )


def _planes() -> Planes:
    true = _room()[1].planes
    per_plane = ("normal", "offset", "corners", "n_points", "rms_m", "names")
    # Any, because the fields have various types.
    first: dict[str, Any] = {name: getattr(true, name)[:_N_PLANES] for name in per_plane}
    return replace(true, covariance=np.tile(1e-8 * np.eye(4), (_N_PLANES, 1, 1)), **first)


def _labels() -> PointLabels:
    true = _room()[1].labels
    return PointLabels(plane_index=np.where(true < _N_PLANES, true, -1).astype(np.int16))


def _surfaces() -> Surfaces:
    planes = _planes()
    return Surfaces(surfaces=(), up=planes.up, planes=planes)


SURVEYED: Final[Mapping[str, Callable[[], Product]]] = {
    "cloud": lambda: _room()[0],
    "truth": lambda: _room()[1],
    "planes": cache(_planes),
    "labels": cache(_labels),
    "surfaces": cache(_surfaces),
}
