"""Measure the processing of large walls: inspections of an orthoimage and of openings.

    python benchmarks/large_walls.py FOLDER [--side 10000] [--only surf checkpoints openings]

creates in FOLDER a wall of side x side cells, with an orthoimage and an intensity that show the
same waves, displaced by half a cell. A second wall has a niche, which is detected
(`segment.openings`) and inspected (`inspect.openings`). Each method runs in a separate process on
memory-mapped files. The output is the processor time and the anonymous memory of each; the exit
code is 1 if a number differs from its true value.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import DTypeLike, NDArray
from orthoflow_plugins.inspect.checkpoints import InspectCheckpoints
from orthoflow_plugins.inspect.openings import InspectOpenings
from orthoflow_plugins.inspect.surf import InspectSurf
from orthoflow_plugins.segment.openings import SegmentOpenings
from orthoflow_plugins.simulate.building import Paint, SceneDraft, wall_side
from plane_streaming import measured

from orthoflow.geometry import WallFrame, frame_over
from orthoflow.geometry.scenes import SurfaceRole, TextureKind
from orthoflow.products import (
    CheckPoints,
    Orthoimage,
    Orthoimages,
    SurfaceMask,
    Wall,
    Walls,
)
from orthoflow.sdk import StepContext
from orthoflow.testing.examples import example

GSD_M = 0.001
UP = np.array([0.0, 0.0, 1.0])
SHIFT_CELLS = 0.5
ROWS_AT_ONCE = 256
NICHE_M = 0.2
PAINT = Paint(kind=TextureKind.PLAIN, rgb=(200, 200, 200), reflectance=0.5)


def main() -> None:
    """Run each method in a separate process; with --run, run one method in this process."""
    methods = {"surf": run_surf, "checkpoints": run_checkpoints, "openings": run_openings}
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--side", type=int, default=10_000)
    parser.add_argument("--only", nargs="+", choices=[*methods], default=[*methods])
    parser.add_argument("--run", choices=[*methods], help=argparse.SUPPRESS)
    wanted = parser.parse_args()
    wanted.folder.mkdir(parents=True, exist_ok=True)
    if wanted.run:
        methods[wanted.run](wanted.folder, wanted.side)
        return
    for name in wanted.only:
        with TemporaryDirectory(dir=wanted.folder) as folder:
            arguments = [folder, "--side", str(wanted.side), "--run", name]
            cost = measured([sys.executable, __file__, *arguments])
        print(
            f"{name}, {wanted.side} x {wanted.side} cells: {cost.wall_s:.0f} s, processor "
            f"{cost.cpu_s:.0f} s, anonymous {cost.anonymous_mib:.0f} MiB",
            flush=True,
        )


def run_surf(folder: Path, side: int) -> None:
    """Compare the orthoimage with the intensity."""
    image, walls = pictures(folder, side)
    inputs = InspectSurf.In(orthoimages=Orthoimages(images=(image,)), walls=walls)
    ctx = StepContext(rng=np.random.default_rng(1), cores=2, scratch=folder)
    InspectSurf().run(inputs, InspectSurf.Params(), ctx)
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    expect(
        f"more than a thousand pairs, not {metrics['n_pairs']:.0f}",
        is_met=bool(metrics["n_pairs"] > 1000),
    )
    off = metrics["mean_x_mm"] - 1e3 * GSD_M * SHIFT_CELLS
    expect(
        f"the displacement is measured within 0.05 cells, not {off:.3f}",
        is_met=bool(abs(off) < 0.05),
    )


def run_checkpoints(folder: Path, side: int) -> None:
    """Measure points in the orthoimage."""
    image, walls = pictures(folder, side)
    places = np.random.default_rng(2).uniform(0.1 * side, 0.9 * side, (50, 2))
    points = CheckPoints(
        names=tuple(f"P{k}" for k in range(len(places))),
        points_world=image.frame.world_from_wall(places),
        classes=("",) * len(places),
        wall=np.zeros(len(places), dtype=np.int32),
        pixels_wall=places + 0.25,
    )
    inputs = InspectCheckpoints.In(
        checkpoints=points, walls=walls, orthoimages=Orthoimages(images=(image,))
    )
    ctx = StepContext(rng=np.random.default_rng(1), cores=2, scratch=folder)
    InspectCheckpoints().run(inputs, InspectCheckpoints.Params(), ctx)
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    off = metrics["mean_x_mm"] - 1e3 * GSD_M * 0.25
    expect(f"points are where they were measured, not {off:g} mm off", is_met=bool(abs(off) < 1e-6))


def run_openings(folder: Path, side: int) -> None:
    """Detect a niche, and compare it with the scene."""
    half_m = 0.5 * GSD_M * side
    full, niche = (-half_m, half_m, -half_m, half_m), (-0.2 * half_m, 0.3 * half_m) * 2
    draft = SceneDraft()
    flat = wall_side(draft, omega_deg=90.0, phi_deg=0.0, distance_m=2.0)
    plane = flat.true_plane("wall", full)
    hole = flat.recess(niche, NICHE_M, PAINT)
    flat.place(full, 0.0, PAINT, SurfaceRole.WALL, plane=plane, holes=[hole])
    outline = draft.planes[plane]
    raster = frame_over(outline.outline, outline.plane.normal, gsd_m=GSD_M)
    allocate = partial(new, folder)
    depth_m = allocate("depth", raster.shape)
    rows, columns = (slice(round(first * side), round(last * side)) for first, last in
                     ((0.35, 0.6), (0.4, 0.65)))  # fmt: skip
    depth_m[rows, columns] = -NICHE_M
    mask, count = allocate("mask", raster.shape, np.uint8), allocate("count", raster.shape, "u4")
    for first in range(0, side, ROWS_AT_ONCE):
        part = slice(first, first + ROWS_AT_ONCE)
        mask[part], count[part] = SurfaceMask.MEASURED, 1
    wall = made_wall(raster, depth_m, count, mask)
    walls = Walls(
        walls=(wall,), up=UP, intensity_source="none", buffer_front_m=0.1, buffer_behind_m=0.3
    )
    truth = replace(example("truth"), scene=draft.finished(spectral_gap=0.0))
    ctx = StepContext(rng=np.random.default_rng(1), cores=2, scratch=folder)
    params = SegmentOpenings.Params(width_least_m=0.1, area_least_m2=0.01)
    found = SegmentOpenings().run(SegmentOpenings.In(walls=walls), params, ctx)
    inputs = InspectOpenings.In(truth=truth, openings=found.openings, walls=walls)
    InspectOpenings().run(inputs, InspectOpenings.Params(area_least_m2=0.01), ctx)
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    expect("the niche is found", is_met=bool(metrics["n_found_openings"] == 1))
    off = metrics["side_max_mm"]
    expect(f"its sides are within a cell, not {off:.2f} mm off", is_met=bool(off <= 1e3 * GSD_M))


def made_wall(cells: WallFrame, depth_m: NDArray, count: NDArray, mask: NDArray) -> Wall:
    """Return a wall with the given cells."""
    return Wall(
        frame=cells,
        plane_index=0,
        name="wall",
        depth_m=depth_m,
        sigma_m=depth_m,
        count=count,
        mask=mask,
    )


def pictures(folder: Path, side: int) -> tuple[Orthoimage, Walls]:
    """Return an orthoimage and its wall."""
    allocate = partial(new, folder)
    rgb, intensity = allocate("rgb", (side, side, 3), np.uint8), allocate("intensity", (side,) * 2)
    depth_m, count = allocate("depth", (side,) * 2), allocate("count", (side,) * 2, np.uint32)
    mask, source = (allocate(name, (side,) * 2, kind) for name, kind in
                    (("mask", np.uint8), ("source", np.int16)))  # fmt: skip
    for first in range(0, side, ROWS_AT_ONCE):
        rows = slice(first, min(first + ROWS_AT_ONCE, side))
        down = np.arange(rows.start, rows.stop, dtype=np.float64)[:, np.newaxis]
        right = np.arange(side, dtype=np.float64)
        rgb[rows] = np.rint(waves(right - SHIFT_CELLS, down))[:, :, np.newaxis]
        intensity[rows] = (waves(right, down) / 255.0) ** 2
        mask[rows], count[rows] = 1, 1
    wall = replace(made_wall(frame(side), depth_m, count, mask), intensity=intensity)
    walls = Walls(
        walls=(wall,),
        up=UP,
        intensity_source="laser",
        buffer_front_m=0.1,
        buffer_behind_m=0.1,
    )
    image = Orthoimage(
        frame=wall.frame,
        wall=0,
        name="wall",
        rgb=rgb,
        mask=mask,
        source=source,
        sources=("photo",),
    )
    return image, walls


def waves(right: NDArray[np.float64], down: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return grey levels without repetition: waves with many lengths and directions."""
    rng = np.random.default_rng(11)
    total = np.zeros(np.broadcast_shapes(right.shape, down.shape))
    for length in np.geomspace(6.0, 60.0, 14):
        turn, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        total += np.sin((right * np.cos(turn) + down * np.sin(turn)) * 2 * np.pi / length + phase)
    return np.clip(128.0 + 30.0 * total, 0.0, 255.0)


def new(folder: Path, name: str, shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray:
    """Return a zeroed array in a file."""
    return np.memmap(folder / name, dtype=dtype, mode="w+", shape=shape).view(np.ndarray)


def frame(side: int) -> WallFrame:
    """Return the frame of a wall that faces -y, with its lower left corner at the origin."""
    return WallFrame(
        origin_world=np.array([0.0, 0.0, GSD_M * side]),
        u_world=np.array([1.0, 0.0, 0.0]),
        v_world=-UP,
        normal_world=np.array([0.0, -1.0, 0.0]),
        gsd_m=GSD_M,
        width=side,
        height=side,
    )


def expect(what: str, *, is_met: bool) -> None:
    """Exit if a condition is not met."""
    if not is_met:
        sys.exit(f"not met: {what}")


if __name__ == "__main__":
    main()
