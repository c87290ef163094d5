"""Small inputs for testing methods: an analytic room, and an example of each product type."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp

import numpy as np
from numpy.typing import NDArray

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.errors import OrthoflowError
from orthoflow.geometry import up_vector, wall_axes
from orthoflow.geometry.frames import rotation_from_vector
from orthoflow.products import InputFiles, Planes, PointCloud, Product
from orthoflow.sdk import Method, port_specs
from orthoflow.testing.photographed import PHOTOGRAPHED
from orthoflow.testing.surveyed import SURVEYED, few_points
from orthoflow.testing.trials import Trial, run_trial


class ExampleError(OrthoflowError, LookupError):
    """There is no example of a product type, so the caller must provide one."""


def example_inputs(
    method: type[Method], *, besides: Collection[str] = (), within: tuple[str, ...] = ()
) -> dict[str, Product | InputFiles]:
    """Return the required inputs of a method, all from one scene: a photographed wall or a room.

    The ground truth and the planes of the room are included if the method has ports for them.
    Products of types that neither scene contains are created by an installed method that outputs
    them.

    Args:
        method: class of the method.
        besides: ports for which no example is needed.
        within: types whose examples depend on this one, to prevent infinite recursion.

    Raises:
        ExampleError: there is no example for a port.
    """
    ports = port_specs(method.In)
    required = {port.type_name for port in ports.values() if port.required}
    is_photographed = bool(required & {*PHOTOGRAPHED, "orthoimages", "openings"} - {*SURVEYED})
    scene = PHOTOGRAPHED if is_photographed else SURVEYED
    found: dict[str, Product | InputFiles] = {}
    for name, port in ports.items():
        is_known = port.type_name in {"truth", "planes"} and not is_photographed
        if name not in besides and (port.required or is_known):
            make = scene.get(port.type_name)
            found[name] = make() if make else example(port.type_name, within=within)
    return found


def example(type_name: str, *, within: tuple[str, ...] = ()) -> Product | InputFiles:
    """Return a small product of a type, identical in every process.

    Args:
        type_name: the product type.
        within: types whose examples depend on this one, to prevent infinite recursion.

    Raises:
        ExampleError: the type belongs to a plugin, and no installed method creates it from other
            examples.
    """
    if type_name == "files":
        return _example_files()
    make = SURVEYED.get(type_name) or PHOTOGRAPHED.get(type_name)
    if make is not None:
        return make()
    for entry in discover_catalog().methods.values() if type_name not in within else ():
        kind = entry.kind
        if kind is None or not (kind.is_source or type_name in kind.outputs.values()):
            continue
        try:
            method = entry.load()
            ports = port_specs(method.Out).values()
            name = next(port.name for port in ports if port.type_name == type_name)
            inputs = example_inputs(method, within=(*within, type_name))
            with TemporaryDirectory(prefix="orthoflow-example-") as folder:
                trial = Trial(method=method, inputs=inputs)
                return run_trial(trial, Path(folder), draws=False).outputs[name]
        except Exception:  # noqa: BLE001 - a third-party method may raise anything
            continue
    raise ExampleError(
        f"there is no example of a {type_name} product, and no installed method makes one from "
        "the suite's examples: add one to `inputs` of conformance_cases"
    )


def example_room(
    *,
    seed: int = 1,
    n_points: int = 40_000,
    turned_deg: float = 0.0,
    shift_m: NDArray[np.float64] | None = None,
) -> tuple[PointCloud, Planes]:
    """Return a box-shaped room with exactly known planes.

    Args:
        seed: seed of the noise and of the positions of points in the room, both of which are
            independent of rotation and shift.
        n_points: total number of points on the six sides.
        turned_deg: angle by which the room is rotated about the vertical before it is shifted.
        shift_m: (3,) shift in metres.

    Returns:
        The cloud (with 2 mm noise, grey colours and a station in the centre), and its true planes
        in this order: the two long walls, the two short walls, the floor and the ceiling. The
        normals point into the room.
    """
    rng = np.random.default_rng(seed)
    size = np.array([5.0, 3.6, 2.6])
    areas = size.prod() / size  # of sides across each axis
    turn = rotation_from_vector(np.array([0.0, 0.0, math.radians(turned_deg)]))
    origin = np.zeros(3) if shift_m is None else np.asarray(shift_m, dtype=np.float64)
    points, normals, offsets, corners = [], [], [], []
    for axis, direction in ((1, -1), (1, 1), (0, -1), (0, 1), (2, 1), (2, -1)):
        normal = np.eye(3)[axis] * direction + 0.0  # no minus zeros
        count = int(n_points * areas[axis] / (2.0 * areas.sum()))
        local = (rng.random((count, 3)) - 0.5) * size
        distance = -0.5 * size[axis]
        local[:, axis] = direction * (distance + 0.002 * rng.normal(size=count))
        points.append(local @ turn.T)
        normals.append(normal @ turn.T)
        offsets.append(distance + float(normals[-1] @ origin))
        # The corners begin at the top left and continue down, to the right and up.
        u, v = (0.5 * (size @ np.abs(side)) * side for side in wall_axes(normal, up_vector("z")))
        steps = np.array([-u - v, v - u, u + v, u - v])
        corners.append((distance * normal + steps) @ turn.T + origin)
    grey = rng.integers(60, 200, sum(map(len, points))).astype(np.uint8)
    cloud = few_points(np.concatenate(points), grey)
    planes = Planes(
        normal=np.array(normals),
        offset=np.array(offsets),
        corners=np.array(corners),
        covariance=np.zeros((6, 4, 4)),
        n_points=np.array([*map(len, points)], dtype=np.int64),
        rms_m=np.full(6, 0.002),
        up=up_vector("z"),
        names=("wall 0", "wall 1", "wall 2", "wall 3", "floor 4", "ceiling 5"),
        viewpoint="stations",
    )
    return replace(cloud, origin=origin, stations=origin[np.newaxis]), planes


def _example_files() -> InputFiles:
    cloud, _ = example_room(n_points=3000)
    path = Path(mkdtemp(prefix="orthoflow-example-")) / "room.xyz"
    rows = np.column_stack([cloud.points_world(), np.full((len(cloud), 3), 128)])
    np.savetxt(path, rows, fmt="%.4f %.4f %.4f %d %d %d", header="x y z r g b", comments="//")
    return InputFiles(name="scan", paths=(path,))
