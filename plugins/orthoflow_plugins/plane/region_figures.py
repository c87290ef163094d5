"""What the normals of neighbourhoods say about the first plane: a histogram and a map."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import wall_axes
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.regions import Regions

_BIN_DEG: Final = 1.0
# The map shows cells this near to the plane, so that niches and what stands before it are there.
_MAP_DEPTH_M: Final = 0.6
_MAP_MOST_DEG: Final = 15.0
_MAP_PIXELS_MOST: Final = 700


def draw_normals(ctx: StepContext, regions: Regions, planes: Planes, cloud: PointCloud) -> None:
    """Report how normals scatter about the first plane, and draw their histogram and map.

    Args:
        ctx: takes metrics and figure.
        regions: cells and their regions.
        planes: the planes, world.
        cloud: where they are from.
    """
    cells = regions.cells
    centroids_m = cells.centroids() @ cells.grid.basis
    normals = cells.normals.astype(np.float64) @ cells.grid.basis
    first = planes.normal[0]
    away_deg = np.degrees(np.arccos(np.clip(np.abs(normals @ first), 0.0, 1.0)))
    depth_m = centroids_m @ first - (planes.offset[0] - float(first @ cloud.origin))
    on_plane = (np.abs(depth_m) < 0.5 * cells.grid.cell_m) & (away_deg < 45.0)
    placed = (centroids_m - (planes.corners[0, 0] - cloud.origin)) @ wall_axes(first, planes.up).T
    size_m = np.linalg.norm(planes.corners[0, [3, 1]] - planes.corners[0, 0], axis=1)
    over = ((placed >= 0.0) & (placed < size_m)).all(axis=1)
    scatter_deg = float(np.median(away_deg[on_plane & over])) if (on_plane & over).any() else 0.0
    ctx.metric("n_regions", len(regions.planes), "1")
    ctx.metric("neighbourhood_mm", 1000.0 * cells.neighbourhood.size_m, "mm")
    ctx.metric("cell_mm", 1000.0 * cells.grid.cell_m, "mm")
    ctx.metric("normal_scatter_deg", scatter_deg, "deg")
    shown = over & (np.abs(depth_m) < _MAP_DEPTH_M) & np.isfinite(cells.spreads[:, 0])
    picture = _map(placed[shown], depth_m[shown], away_deg[shown], size_m, cells.grid.cell_m)
    _draw(ctx, away_deg, cells.counts, picture, size_m, planes.names[0])


def _map(
    placed: NDArray[np.float64],
    depth_m: NDArray[np.float64],
    away_deg: NDArray[np.float64],
    size_m: NDArray[np.float64],
    cell_m: float,
) -> NDArray[np.float64]:
    """(rows, columns) angle of the cell nearest to the viewer, NaN without one."""
    pixel_m = max(cell_m, float(size_m.max()) / _MAP_PIXELS_MOST)
    shape = np.maximum(1, np.ceil(size_m / pixel_m).astype(int))[::-1]
    picture = np.full(tuple(shape), np.nan)
    order = np.argsort(depth_m, kind="stable")
    columns, rows = (placed[order] / pixel_m).astype(np.int64).T
    picture[rows, columns] = away_deg[order]
    return picture


def _draw(
    ctx: StepContext,
    away_deg: NDArray[np.float64],
    counts: NDArray[np.int64],
    picture: NDArray[np.float64],
    size_m: NDArray[np.float64],
    name: str,
) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2.0, 3.0))
    edges_deg = np.arange(0.0, 90.0 + _BIN_DEG, _BIN_DEG)
    histogram, _ = np.histogram(away_deg, edges_deg, weights=counts.astype(np.float64))
    left.stairs(histogram / max(1.0, float(counts.sum())), edges_deg, fill=True, color="#9db8d2")
    left.set_xlabel(f"angle between normal and {name} [deg]", fontsize=9)
    left.set_ylabel("share of the points", fontsize=9)
    image = right.imshow(
        np.minimum(picture, _MAP_MOST_DEG),
        cmap="viridis",
        extent=(0.0, float(size_m[0]), float(size_m[1]), 0.0),
        vmin=0.0,
        vmax=_MAP_MOST_DEG,
    )
    figure.colorbar(image, ax=right, label="angle [deg]", shrink=0.8)
    right.set_xlabel("along the plane [m]", fontsize=9)
    ctx.figure(
        "normals",
        figure,
        "Left: how the normals of the neighbourhoods lie to the first plane, by points. Right: the "
        f"same over the plane's rectangle, up to {1000.0 * _MAP_DEPTH_M:.0f} mm before and behind "
        "it; what has the wall's colour is told from it by its distance alone.",
    )
