"""Small walls whose every cell is known, for the tests of raster, ortho and mosaic."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.raster.grid import RasterGrid

from orthoflow.geometry import wall_axes
from orthoflow.products import Planes, PointCloud, Walls
from orthoflow.sdk import StepContext
from tests import samples

UP = np.array([0.0, 0.0, 1.0])
SURVEY = np.array([634512.347, 486215.781, 112.193])


def context(folder: Path, *, cores: int = 2) -> StepContext:
    """A context with a scratch folder of its own, as each step has one."""
    scratch = Path(mkdtemp(dir=folder))
    return StepContext(rng=np.random.default_rng(7), cores=cores, scratch=scratch)


def numbers(ctx: StepContext) -> dict[str, float]:
    """The metrics that a step reported."""
    return {metric.name: metric.value for metric in ctx.metrics}


def rastered(
    cloud: PointCloud, planes: Planes, folder: Path, *, cores: int = 2, **params: object
) -> tuple[Walls, StepContext]:
    """What `raster.grid` makes of a cloud, and what it reports."""
    ctx = context(folder, cores=cores)
    inputs = RasterGrid.In(cloud=cloud, planes=planes)
    return RasterGrid().run(inputs, RasterGrid.Params.model_validate(params), ctx).walls, ctx


@dataclass(frozen=True, kw_only=True)
class KnownWall:
    """A wall of `shape` cells; points are given by cell position and depth."""

    normal: NDArray[np.float64]
    top_left: NDArray[np.float64]
    gsd_m: float
    shape: tuple[int, int]

    @property
    def axes(self) -> NDArray[np.float64]:
        return wall_axes(self.normal, UP)

    def world(
        self, columns: NDArray[np.float64], rows: NDArray[np.float64], depths_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        u, v = self.axes
        in_plane = self.gsd_m * (np.outer(columns, u) + np.outer(rows, v))
        return self.top_left + in_plane + np.outer(depths_m, self.normal)

    def planes(self, *, name: str = "wall 0") -> Planes:
        rows, columns = self.shape
        outline = np.array([[0, 0], [0, rows], [columns, rows], [columns, 0]], dtype=np.float64)
        return samples.planes(
            normal=self.normal[np.newaxis],
            offset=np.array([self.normal @ self.top_left]),
            corners=self.world(outline[:, 0], outline[:, 1], np.zeros(4))[np.newaxis],
            n_points=np.array([1]),
            names=(name,),
        )


def leaning_wall(*, shape: tuple[int, int] = (30, 40), at_survey: bool = True) -> KnownWall:
    """A wall turned by 102 deg and leaning by 0.8 deg, as the one of markiewicz2015."""
    omega, phi = np.radians([102.0, 0.8])
    normal = np.array([np.cos(phi) * np.cos(omega), np.cos(phi) * np.sin(omega), np.sin(phi)])
    corner = np.array([1.0, 2.0, 3.0]) + (SURVEY if at_survey else 0.0)
    return KnownWall(normal=normal, top_left=corner, gsd_m=0.01, shape=shape)


def upright_wall(*, shape: tuple[int, int] = (30, 40), gsd_m: float = 0.125) -> KnownWall:
    """A wall seen along +y whose cell borders are exact in binary."""
    return KnownWall(
        normal=np.array([0.0, -1.0, 0.0]), top_left=np.zeros(3), gsd_m=gsd_m, shape=shape
    )


def cloud_of(
    points_world: NDArray[np.float64],
    *,
    rgb: NDArray[np.uint8] | None = None,
    intensity: NDArray[np.float32] | None = None,
) -> PointCloud:
    origin = np.round(points_world.mean(axis=0))
    x, y, z = (points_world - origin).astype(np.float32).T
    return PointCloud(
        origin=origin,
        x=np.ascontiguousarray(x),
        y=np.ascontiguousarray(y),
        z=np.ascontiguousarray(z),
        up=UP,
        rgb=rgb,
        intensity=intensity,
    )


def cell_centres(shape: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Columns and rows of all cell centres, flat, row by row."""
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    return columns.ravel(), rows.ravel()


def relief_m(columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Steps of +8 cm and -10 cm every ten columns."""
    return np.choose((columns // 10).astype(int) % 3, [0.0, 0.08, -0.10])


def checker(columns: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours (n, 3): every cell differs from its neighbours; black occurs."""
    odd = (columns.astype(int) + rows.astype(int)) % 2
    red, green = columns.astype(int) * 3 % 251, rows.astype(int) * 5 % 251
    return np.column_stack([odd * red, odd * green, odd * 90]).astype(np.uint8)


def waves(columns: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """A texture 0..1 without edges, with detail of six to thirty cells in all directions."""
    rng = np.random.default_rng(17)
    total = np.zeros(np.shape(columns))
    for cells in np.geomspace(6.0, 30.0, 12):
        direction, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        along = np.cos(direction) * columns + np.sin(direction) * rows
        total += np.sin(2.0 * np.pi * along / cells + phase)
    return 0.5 + total / 24.0


def shift_of_waves(values: NDArray[np.floating], *, rim_cells: int = 5) -> NDArray[np.float64]:
    """How far a raster that should show `waves` shows them to the right and down, in cells."""
    columns, rows = (
        grid.reshape(values.shape)[rim_cells:-rim_cells, rim_cells:-rim_cells].ravel()
        for grid in cell_centres(values.shape)
    )
    seen = values[rim_cells:-rim_cells, rim_cells:-rim_cells].ravel().astype(np.float64)
    known = np.isfinite(seen)
    step = 1e-3
    slopes = np.column_stack(
        [
            waves(columns + step, rows) - waves(columns - step, rows),
            waves(columns, rows + step) - waves(columns, rows - step),
        ]
    ) / (2.0 * step)
    off = seen - waves(columns, rows)
    moved: NDArray[np.float64] = np.linalg.lstsq(slopes[known], -off[known], rcond=None)[0]
    return moved


def points_apart(
    shape: tuple[int, int], cells: float, *, seed: int, in_rows: bool
) -> NDArray[np.float64]:
    """Places (n, 2) = (column, row) so many cells apart, in a scan's turned rows or anywhere."""
    rng = np.random.default_rng(seed)
    if not in_rows:
        count = round(shape[0] * shape[1] / cells**2)
        return rng.uniform((0, 0), shape[::-1], (count, 2))
    most = 2 * max(shape)
    across, down = (grid.ravel() for grid in np.mgrid[:most, :most] * cells - most / 2)
    angle = np.radians(rng.uniform(2.0, 8.0))
    places = np.column_stack(
        [
            np.cos(angle) * across - np.sin(angle) * down,
            np.sin(angle) * across + np.cos(angle) * down,
        ]
    )
    places = places[((places > 0.0) & (places < shape[::-1])).all(axis=1)]
    return rng.permutation(places)


@contextmanager
def peak_bytes() -> Iterator[Callable[[], int]]:
    """Measure the peak memory of arrays, without memory-mapped files."""
    tracemalloc.start()
    try:
        yield lambda: tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
