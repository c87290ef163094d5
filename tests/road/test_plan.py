"""A plan of a site in survey coordinates, walked with the command line, against the truth."""

from __future__ import annotations

import html
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.geometry.frames import rotation_from_vector
from tests.road.conftest import Shell, metrics_of
from tests.scan_files import write_las

WEST, SOUTH, GROUND = 634512.0, 486215.0, 112.0
CORNER = np.array([WEST, SOUTH, GROUND])
# East and north of the middle, north-west corner of the ground: no whole number of cells.
WIDTH, HEIGHT, GSD = 6.011, 4.007, 0.02
# A block 1.2 m high, which hides ground from nowhere but above, and a tile painted on its top.
TILE = (2.507, 1.313, 3.104, 2.118)
SCALE = 2.7
TURN = rotation_from_vector(np.array([0.2, -0.3, 1.1]))


def site(seed: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points (n, 3) in survey coordinates, and their colours with 16 bits."""
    rng = np.random.default_rng(seed)
    spots = rng.uniform([0.0, 0.0], [WIDTH, HEIGHT], (300_000, 2))
    corners = np.array([[0.0, 0.0], [WIDTH, 0.0], [0.0, HEIGHT], [WIDTH, HEIGHT]])
    spots = np.vstack([spots, np.clip(corners, 0.001, [WIDTH - 0.001, HEIGHT - 0.001])])
    on_block = ((spots >= [2.0, 1.0]) & (spots <= [4.0, 3.0])).all(axis=1)
    height = np.where(on_block, 1.2, 0.0)
    # Ground beneath the block, which the plan must not show.
    hidden = np.column_stack([rng.uniform([2.0, 1.0], [4.0, 3.0], (50_000, 2)), np.zeros(50_000)])
    left, bottom, right, top = TILE
    x, y = spots.T
    on_tile = (x > left) & (x < right) & (y > bottom) & (y < top)
    grey = np.where(on_tile, 230, np.where(on_block, 90, 140))
    points = np.vstack([np.column_stack([spots, height]), hidden]) + CORNER
    greys = np.concatenate([grey, np.full(50_000, 250)])
    rgb = np.column_stack([greys, greys - np.where(greys == 250, 250, 0), greys]) * 257
    return points, rgb


def into_cloud(points_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Survey coordinates as a cloud from photos has them: turned, without scale, anywhere."""
    return (points_world - CORNER) @ TURN / SCALE + [3.0, -7.0, 1.0]


def write_points(path: Path, points: NDArray[np.float64]) -> None:
    rows = [f"P{k},{x!r},{y!r},{z!r}" for k, (x, y, z) in enumerate(points.tolist())]
    path.write_text("\n".join(["name,x,y,z", *rows]) + "\n")


def edge(profile: NDArray[np.float64], low: float, high: float) -> float:
    """Place, in cells, where a profile of cells crosses from one level to the other."""
    return float(len(profile) - np.sum((profile - low) / (high - low)))


@pytest.fixture(scope="module", params=["coordinates of the survey", "cloud from photos"])
def plan(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, store: Path
) -> Path:
    """Folder of a finished run of `plan.yaml` on the site."""
    shell = Shell(tmp_path_factory.mktemp("plan"), store)
    points, rgb = site(1)
    options: tuple[str, ...] = ()
    if request.param == "cloud from photos":
        corners = np.array([[0, 0, 0], [6, 0, 0], [0, 4, 0], [6, 4, 0], [3, 2, 1.2]])
        surveyed = corners + CORNER
        write_points(shell.folder / "picked.csv", into_cloud(surveyed))
        write_points(shell.folder / "control.csv", surveyed)
        points = into_cloud(points)
        options = ("--input", "points=picked.csv", "--input", "control=control.csv")
    write_las(shell.folder / "site.laz", points, rgb=rgb, scale=0.00001)
    # The corners of the tile, as somebody measured them in the map: 3 mm east, 4 mm south.
    left, bottom, right, top = TILE
    rows = ["name,x,y,z,class,map_x,map_y"]
    for k, (x, y) in enumerate([(left, bottom), (left, top), (right, top), (right, bottom)]):
        east, north = WEST + x, SOUTH + y
        height = GROUND + 1.2
        rows.append(f"T{k},{east},{north},{height},flat,{east + 0.003},{north - 0.004}")
    (shell.folder / "check.csv").write_text("\n".join(rows))
    shell(
        *("run", "plan.yaml", "--input", "scan=site.laz", "--input", "checkpoints=check.csv"),
        *options,
        *("--set", "wall.crs=EPSG:2100", "-o", "run", "--executor", "inline"),
    )
    return shell.folder / "run"


def test_the_report_states_what_was_read(plan: Path) -> None:
    page = html.unescape((plan / "report.html").read_text())
    inputs = page.partition("Inputs and environment</h2>")[2].partition("</p>")[0]
    (scan,) = json.loads((plan / "products" / "cloud" / "scans.json").read_text())["scans"]
    assert f"LAS/LAZ: 1 scan, {scan['n_points']:,} points; fields read: X, Y, Z" in inputs
    assert "unit: m (assumed); up: z; extent" in inputs


def test_the_map_lies_where_the_site_does(plan: Path) -> None:
    import rasterio

    with rasterio.open(plan / "products" / "mosaic" / "wall_0_ortho.tif") as dataset:
        assert dataset.crs.to_epsg() == 2100
        bounds = np.array(dataset.bounds)
    true = np.array([WEST, SOUTH, WEST + WIDTH, SOUTH + HEIGHT])
    assert np.abs(bounds - true).max() < 0.5 * GSD
    left, top = (
        float(line)
        for line in (plan / "products" / "mosaic" / "wall_0_ortho.tfw").read_text().split()[-2:]
    )
    assert (left, top) == pytest.approx((bounds[0] + 0.5 * GSD, bounds[3] - 0.5 * GSD), abs=1e-6)
    about = json.loads((plan / "products" / "wall" / "wall_0_depth.json").read_text())
    assert about["map_crs"] == "EPSG:2100"
    assert (about["u_world"], about["v_world"]) == ([1.0, 0.0, 0.0], [0.0, -1.0, 0.0])
    assert about["raster"]["geotiff"].startswith("X = x_of_left_m + gsd_m * column (east)")


def test_what_is_painted_reaches_the_corners_and_the_tile_lies_in_its_place(plan: Path) -> None:
    import rasterio

    folder = plan / "products" / "mosaic"
    with rasterio.open(folder / "wall_0_ortho_mask.tif") as dataset:
        painted = dataset.read(1) == 1
        to_world = dataset.transform
    rows, columns = np.flatnonzero(painted.any(axis=1)), np.flatnonzero(painted.any(axis=0))
    west, north = to_world @ (columns[0], rows[0])
    east, south = to_world @ (columns[-1] + 1, rows[-1] + 1)
    true = [WEST, SOUTH, WEST + WIDTH, SOUTH + HEIGHT]
    assert [west, south, east, north] == pytest.approx(true, abs=0.5 * GSD)
    with rasterio.open(folder / "wall_0_ortho.tif") as dataset:
        grey = dataset.read(1).astype(np.float64)
    left, bottom, right, top = TILE
    middle = (~to_world) @ (WEST + 0.5 * (left + right), SOUTH + 0.5 * (bottom + top))
    column, row = int(middle[0]), int(middle[1])
    reach = 22
    across = grey[row - 10 : row + 10].mean(axis=0)
    down = grey[:, column - 8 : column + 8].mean(axis=1)
    found = [
        column - reach + edge(across[column - reach : column], 90, 230),
        column + reach - edge(across[column : column + reach][::-1], 90, 230),
        row + reach - edge(down[row : row + reach][::-1], 90, 230),
        row - reach + edge(down[row - reach : row], 90, 230),
    ]
    west, south = to_world @ (found[0], found[2])
    east, north = to_world @ (found[1], found[3])
    true = [WEST + left, SOUTH + bottom, WEST + right, SOUTH + top]
    # The topmost of about five points of a cell, which may lie anywhere in it.
    assert [west, south, east, north] == pytest.approx(true, abs=0.5 * GSD)


def test_points_measured_in_east_and_north_give_their_residuals(plan: Path) -> None:
    metrics = metrics_of(plan)
    assert metrics["points", "n_found"] == 4
    assert metrics["points", "rms_mm"] == pytest.approx(5.0, abs=0.01)
    assert metrics["points", "mean_x_mm"] == pytest.approx(3.0, abs=0.01)
    assert metrics["points", "mean_y_mm"] == pytest.approx(4.0, abs=0.01)
    if ("register", "scale") in metrics:
        assert metrics["register", "scale"] == pytest.approx(SCALE, rel=1e-5)
        assert metrics["register", "rms_mm"] < 0.1
