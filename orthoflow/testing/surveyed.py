"""Small inputs from the simulated room, for methods that use the results of other methods.

The room is simulated, but planes, rasters and orthoimages, which methods would compute from it, are
computed here by closed formulas. An example therefore does not change if another method changes,
and has the same bits on every processor: results of sums, roots and angles are rounded to far fewer
digits than they have, and all others are exact in any order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.geometry import WallFrame, frame_over
from orthoflow.products import (
    Layer,
    LayerMask,
    Layers,
    Opening,
    Openings,
    Orthoimage,
    Orthoimages,
    OrthoMask,
    OutlineSource,
    Planes,
    PointCloud,
    PointLabels,
    Product,
    SurfaceMask,
    Truth,
    Wall,
    Walls,
)
from orthoflow.sdk import StepContext

_SCAN_STEP_M: Final = 0.08
_GSD_M: Final = 0.05
_BUFFER_M: Final = 0.2
# The first two are the main wall and the floor.
_N_PLANES: Final = 2
# Decimals kept: rounding errors of metres and unit vectors are ten million times smaller.
_DECIMALS: Final = 9
# Decimals kept of axes: few enough to remove rounding errors, enough for orthogonal frames.
_AXIS_DECIMALS: Final = 11
# Cells between the random numbers of the stains; a power of two, so that weights are exact.
_STAIN_CELLS: Final = 8
# The right-hand image is lighter, as with a longer exposure.
_LIGHTER_GREY: Final = 6


def settled(values: NDArray[np.float64], decimals: int = _DECIMALS) -> NDArray[np.float64]:
    """Round away differences caused by the order of sums and by fused instructions."""
    # Adding zero converts minus zero, which has other bits than zero.
    return np.asarray(np.round(values, decimals) + 0.0)


@cache
def _room() -> tuple[PointCloud, Truth]:
    method = discover_catalog().method("simulate.room").load()
    with TemporaryDirectory(prefix="orthoflow-example-") as folder:
        ctx = StepContext(rng=np.random.default_rng(1), cores=1, scratch=Path(folder))
        outputs = method().run(
            method.In(), method.Params.model_validate({"scan_step_m": _SCAN_STEP_M}), ctx
        )
    made = vars(outputs)
    cloud, truth = made["cloud"], made["truth"]
    scene = replace(
        truth.scene,
        **{
            name: settled(getattr(truth.scene, name))
            for name in ("origin", "centre", "axis_a", "axis_b", "extent", "hole_extent")
        },
    )
    planes = replace(
        truth.planes,
        **{name: settled(getattr(truth.planes, name)) for name in ("normal", "offset", "corners")},
        rms_m=settled(truth.planes.rms_m),
    )
    return cloud, replace(truth, scene=scene, planes=planes, stations=settled(truth.stations))


@cache
def _planes() -> Planes:
    true = _room()[1].planes
    chosen = slice(0, _N_PLANES)
    return Planes(
        normal=true.normal[chosen],
        offset=true.offset[chosen],
        corners=true.corners[chosen],
        covariance=np.tile(1e-8 * np.eye(4), (_N_PLANES, 1, 1)),
        n_points=true.n_points[chosen],
        rms_m=true.rms_m[chosen],
        up=true.up,
        names=true.names[chosen],
        viewpoint=true.viewpoint,
    )


@cache
def _labels() -> PointLabels:
    true = _room()[1].labels
    return PointLabels(plane_index=np.where(true < _N_PLANES, true, -1).astype(np.int16))


def _frame(plane: int) -> WallFrame:
    planes = _planes()
    normal = planes.normal[plane]
    frame = frame_over(planes.corners[plane], normal, gsd_m=_GSD_M)
    u = settled(frame.u_world, _AXIS_DECIMALS)
    # Each component of a cross product is a difference of two products, the same everywhere.
    return replace(frame, u_world=u, v_world=np.cross(u, normal))


@cache
def _walls() -> Walls:
    return Walls(
        walls=tuple(_wall(plane) for plane in range(_N_PLANES)),
        up=_planes().up,
        intensity_source="laser",
        buffer_front_m=_BUFFER_M,
        buffer_behind_m=_BUFFER_M,
    )


def _wall(plane: int) -> Wall:
    frame = _frame(plane)
    rows, cols = frame.shape
    stains = _stains(frame.shape, seed=plane)
    # Waves of 8 mm, in steps that float32 represents exactly.
    depth = (np.abs(np.arange(cols) % 16 - 8)[None, :] + np.arange(rows)[:, None] % 4) / 1024.0
    window, rim = np.zeros(frame.shape, np.bool_), np.zeros(frame.shape, np.bool_)
    window[rows // 3 : rows // 2, cols // 2 : 2 * cols // 3] = True
    rim[rows // 3 : rows // 2, cols // 2 - 3 : cols // 2] = True
    mask = np.where(window, SurfaceMask.VOID, SurfaceMask.MEASURED)
    mask = np.where(rim, SurfaceMask.RECOVERED, mask)
    known = ~window
    return Wall(
        frame=frame,
        plane_index=plane,
        name=_planes().names[plane],
        depth_m=np.where(known, depth, np.nan).astype(np.float32),
        sigma_m=np.where(known, 1.0 / 512.0, np.nan).astype(np.float32),
        count=np.where(mask == SurfaceMask.MEASURED, 3, 0).astype(np.uint32),
        mask=mask.astype(np.uint8),
        intensity=np.where(known, stains / 256.0, np.nan).astype(np.float32),
        rgb=np.where(known[..., None], _colours(stains), 0).astype(np.uint8),
        rgb_mask=known.astype(np.uint8),
    )


def _stains(shape: tuple[int, int], *, seed: int) -> NDArray[np.float64]:
    """Return smooth stains, 40..215: hashed numbers on a coarse grid, interpolated linearly."""
    rows, cols = (np.arange(n) / _STAIN_CELLS for n in shape)
    coarse = np.random.default_rng(seed).integers(40, 216, [n // _STAIN_CELLS + 2 for n in shape])
    i, j = (np.floor(places).astype(int) for places in (rows, cols))
    s, t = (rows - i)[:, None], (cols - j)[None, :]
    upper = (1.0 - t) * coarse[i[:, None], j] + t * coarse[i[:, None], j + 1]
    lower = (1.0 - t) * coarse[i[:, None] + 1, j] + t * coarse[i[:, None] + 1, j + 1]
    stains: NDArray[np.float64] = (1.0 - s) * upper + s * lower
    return stains


def _colours(stains: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return a reddish colour for each grey value."""
    return np.floor(stains[..., None] * [1.0, 0.875, 0.75]).astype(np.uint8)


@cache
def _layers() -> Layers:
    return Layers(
        layers=tuple(
            layer
            for plane in range(_N_PLANES)
            for layer in (_layer(plane, is_right=False), _layer(plane, is_right=True))
        ),
        names=_planes().names,
    )


def _layer(plane: int, *, is_right: bool) -> Layer:
    """Return two thirds of a wall, left or right; the quality is best at the outer side.

    Three of its rows are filled from their neighbours.
    """
    wall = _walls().walls[plane]
    cols = wall.frame.width
    column = np.arange(cols)
    place = column if is_right else column[::-1]
    mask = np.where(place >= cols // 3, LayerMask.PAINTED, LayerMask.OUTSIDE)
    mask = np.broadcast_to(mask, wall.frame.shape).copy()
    mask[: wall.frame.height // 4, cols // 2 : cols // 2 + 5] = LayerMask.OCCLUDED
    mask[wall.mask == SurfaceMask.VOID] = LayerMask.NO_SURFACE
    painted = mask == LayerMask.PAINTED
    filled = np.zeros(wall.frame.shape, np.bool_)
    filled[wall.frame.height // 5 :][:3] = True
    assert wall.rgb is not None  # noqa: S101 - walls of this module have colours
    rgb = wall.rgb + np.uint8(_LIGHTER_GREY if is_right else 0)
    quality = np.where(painted, (place[None, :] + 1) / 256.0, 0.0)
    return Layer(
        frame=wall.frame,
        wall=plane,
        source="right.jpg" if is_right else "left.jpg",
        rgb=np.where(painted[..., None], rgb, 0).astype(np.uint8),
        mask=mask.astype(np.uint8),
        quality=quality.astype(np.float32),
        filled=(filled & painted).astype(np.uint8),
    )


@cache
def _orthoimages() -> Orthoimages:
    return Orthoimages(images=tuple(_orthoimage(plane) for plane in range(_N_PLANES)))


def _orthoimage(plane: int) -> Orthoimage:
    """Return the better layer in each cell; where both are hidden, one row in four is filled."""
    left, right = _layers().layers[2 * plane : 2 * plane + 2]
    frame = left.frame
    is_right = (right.quality > left.quality)[..., None]
    rgb = np.where(is_right, right.rgb, left.rgb)
    painted = (left.mask == LayerMask.PAINTED) | (right.mask == LayerMask.PAINTED)
    hidden = (left.mask == LayerMask.OCCLUDED) & ~painted
    filled = hidden & (np.arange(frame.height) % 4 == 0)[:, None]
    mask = np.where(painted, OrthoMask.PAINTED, OrthoMask.NO_SURFACE)
    mask = np.where(hidden, np.where(filled, OrthoMask.FILLED, OrthoMask.OCCLUDED), mask)
    return Orthoimage(
        frame=frame,
        wall=plane,
        name=_planes().names[plane],
        rgb=np.where(filled[..., None], 128, rgb).astype(np.uint8),
        mask=mask.astype(np.uint8),
        source=np.where(painted, is_right[..., 0], -1).astype(np.int16),
        sources=(left.source, right.source),
    )


@cache
def _openings() -> Openings:
    """Return the opening of the first wall."""
    wall = _walls().walls[0]
    frame = wall.frame
    rows, cols = frame.shape
    top, bottom, left, right = rows // 3, rows // 2, cols // 2, 2 * cols // 3
    cells = np.array([[left, top], [left, bottom], [right, bottom], [right, top]], dtype=np.float64)
    size_m = frame.gsd_m * (cells[2] - cells[0])
    opening = Opening(
        wall=wall.plane_index,
        wall_name=wall.name,
        kind="no data",
        outline_m=frame.gsd_m * cells * [1.0, -1.0],
        outline_world=settled(frame.world_from_wall(cells)),
        side_sigma_m=np.full(4, 1.0 / 64.0),
        side_source=np.full(4, OutlineSource.DEPTH, dtype=np.uint8),
        depth_m=None,
        area_m2=float(size_m.prod()),
        width_m=float(size_m[0]),
        height_m=float(size_m[1]),
        sill_m=frame.gsd_m * (rows - bottom),
        seen_share=1.0,
    )
    return Openings(openings=(opening,), walls=(wall.plane_index,))


SURVEYED: Final[Mapping[str, Callable[[], Product]]] = {
    "cloud": lambda: _room()[0],
    "truth": lambda: _room()[1],
    "planes": _planes,
    "labels": _labels,
    "walls": _walls,
    "layers": _layers,
    "orthoimages": _orthoimages,
    "openings": _openings,
}
