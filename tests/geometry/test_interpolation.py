"""Cells between others against a regression solved cell by cell with numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.geometry.interpolation import CellValues, Surroundings, cell_values, interpolate

COLUMNS = 12
LAYER_M = 0.05


def lenders_of(
    row: int,
    column: int,
    places: NDArray[np.float32],
    depth_m: NDArray[np.float32],
    reach_cells: float,
) -> tuple[list[tuple[int, int]], float]:
    """Who lends to a cell, nearest rows first, and the standard deviation of their weights."""
    rows, columns = depth_m.shape
    own_m = depth_m[row, column]
    near = [
        ((r - row) ** 2 + (c - column) ** 2, r, c)
        for r in range(rows)
        for c in range(columns)
        if not np.isnan(places[r, c, 0]) and not abs(depth_m[r, c] - own_m) > LAYER_M
    ]
    # How far off anybody is looked for at all, and how much farther than the nearest one.
    searched = max(2.0, (reach_cells + 1.0) ** 2)
    near = sorted(item for item in near if item[0] <= searched)
    if not near:
        return [], 0.0
    nearest = np.sqrt(near[0][0])
    farthest = max(2.0, (nearest + 1.0) ** 2)
    lenders = [(r, c) for square, r, c in near if square <= farthest + 1e-9]
    if np.isnan(own_m):
        # The surface of the nearest point; of equally near ones that nearest to the viewer.
        def order(cell: tuple[int, int]) -> tuple[float, float]:
            x, y = offset(row, column, cell, places)
            return round(x * x + y * y, 5), -float(depth_m[cell])

        surface_m = depth_m[min(lenders, key=order)]
        lenders = [cell for cell in lenders if abs(depth_m[cell] - surface_m) <= LAYER_M]
    return lenders, 0.5 * max(1.0, nearest)


def offset(
    row: int, column: int, cell: tuple[int, int], places: NDArray[np.float32]
) -> tuple[float, float]:
    return (cell[1] - column + float(places[cell][0]), cell[0] - row + float(places[cell][1]))


def regressed(
    at: tuple[int, int],
    lenders: list[tuple[int, int]],
    sigma: float,
    places: NDArray[np.float32],
    values: NDArray[np.generic],
) -> float:
    """Weighted linear regression, its slopes held a little, within the range of the lenders."""
    xy = np.array([offset(*at, cell, places) for cell in lenders])
    held = np.array([float(values[cell]) for cell in lenders])
    weights = np.maximum(1e-6, np.maximum(0.0, 1.0 - (xy**2).sum(axis=1) / (16.0 * sigma**2)) ** 8)
    design = np.column_stack([np.ones(len(xy)), xy])
    normal = design.T @ (weights[:, None] * design)
    normal += 0.005 * sigma**2 * weights.sum() * np.diag([0.0, 1.0, 1.0])
    level, across, down = np.linalg.solve(normal, design.T @ (weights * held))
    own = places[at]
    if np.isnan(own[0]):
        found = level
    else:
        # What the cell holds, carried along the slope from where its points lie to its centre.
        found = float(values[at]) - across * float(own[0]) - down * float(own[1])
    return float(np.clip(found, held.min(), held.max()))


def rasters(
    seed: int, *, known: float, lending: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """Two surfaces 20 cm apart, some of whose cells lend what they hold."""
    rng = np.random.default_rng(seed)
    shape = (10, COLUMNS)
    depth_m = rng.normal(0.0, 0.01, shape)
    depth_m[:, 7:] += 0.2
    is_lender = rng.random(shape) < lending
    depth_m[~is_lender & (rng.random(shape) > known)] = np.nan
    places = rng.uniform(-0.5, 0.5, (*shape, 2))
    places[~is_lender] = np.nan
    return (
        places.astype(np.float32),
        depth_m.astype(np.float32),
        rng.random(shape).astype(np.float32),
        rng.integers(0, 256, (*shape, 3), dtype=np.uint8),
    )


@pytest.mark.parametrize(
    ("seed", "lending", "reach_cells"),
    [(0, 0.5, 3.0), (1, 0.1, 3.0), (2, 0.03, 2.0), (3, 0.2, 0.2)],
)
def test_cells_have_the_values_of_a_regression(
    seed: int, lending: float, reach_cells: float
) -> None:
    places, depth_m, intensity, rgb = rasters(seed, known=0.5, lending=lending)
    cells = np.arange(depth_m.size)
    around = Surroundings(places=places.reshape(-1, 2), width=COLUMNS, layer_m=LAYER_M)
    values = cell_values(depth_m.ravel(), intensity=intensity.ravel(), rgb=rgb.reshape(-1, 3))
    into = CellValues(depth_m.ravel().copy(), intensity.ravel().copy(), rgb.reshape(-1, 3).copy())
    is_found = interpolate(cells, around, values, into, reach_cells=reach_cells, threads=2)
    n_found = 0
    for cell in cells:
        at = divmod(int(cell), COLUMNS)
        lenders, sigma = lenders_of(*at, places, depth_m, reach_cells)
        assert is_found[cell] == bool(lenders), at
        if not lenders:
            assert into.intensity[cell] == intensity[at]
            np.testing.assert_array_equal(into.rgb[cell], rgb[at])
            continue
        n_found += 1
        expected = regressed(at, lenders, sigma, places, intensity)
        assert into.intensity[cell] == pytest.approx(expected, abs=2e-6)
        for band in range(3):
            shade = regressed(at, lenders, sigma, places, rgb[..., band])
            assert abs(float(into.rgb[cell, band]) - shade) <= 0.5 + 1e-6
        if np.isnan(depth_m[at]):
            expected = regressed(at, lenders, sigma, places, depth_m)
            assert into.depth_m[cell] == pytest.approx(expected, abs=1e-7)
        else:
            assert into.depth_m[cell] == depth_m[at]
    assert n_found > 5
    assert (n_found < depth_m.size) == (lending < 0.5)


def test_of_equally_near_points_that_nearest_the_viewer_tells_the_surface() -> None:
    places = np.full((1, 5, 2), np.nan, dtype=np.float32)
    places[0, [1, 3]] = 0.0
    for front in (1, 3):
        depth_m = np.array([[np.nan, 0.0, np.nan, 0.0, np.nan]], dtype=np.float32)
        depth_m[0, front] = 0.3
        into = cell_values(depth_m.ravel().copy())
        interpolate(
            np.array([2]),
            Surroundings(places=places.reshape(-1, 2), width=5, layer_m=LAYER_M),
            cell_values(depth_m.ravel()),
            into,
            reach_cells=2.0,
            threads=1,
        )
        assert into.depth_m[2] == np.float32(0.3)
