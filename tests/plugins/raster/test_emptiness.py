"""Causes of empty cells: walls with known openings, objects in front and sparse points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.raster.emptiness import Sight, emptiness_of
from orthoflow_plugins.raster.extents import SampledPoints

from orthoflow.diagnostics import Diagnostic
from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud
from tests import raster_scenes as scenes
from tests import samples

CODES = {"wall-behind-buffer", "wall-front-left-out", "wall-hidden", "wall-sparse", "wall-unseen"}
CAUSES = ("behind", "before", "hidden", "sparse", "unseen")
# The wall of 4 m x 3 m is seen along +y, with points 8 mm apart and 2 cm cells; depth is -y.
WALL = scenes.KnownWall(
    normal=np.array([0.0, -1.0, 0.0]),
    top_left=np.array([0.0, 0.0, 3.0]),
    gsd_m=0.02,
    shape=(150, 200),
)
STEP_M = 0.008
# The tolerance is half a 5 cm tile on each side of openings of 0.8 m or more.
SHARE = 0.015


def grid(
    x: tuple[float, float], z: tuple[float, float], *, depth_m: float = 0.0, step_m: float = STEP_M
) -> NDArray[np.float64]:
    across, up = (
        axis.ravel() for axis in np.meshgrid(np.arange(*x, step_m), np.arange(*z, step_m))
    )
    return np.column_stack([across, np.full(across.size, -depth_m), up])


def without(
    points: NDArray[np.float64], x: tuple[float, float], z: tuple[float, float]
) -> NDArray[np.float64]:
    inside = (points[:, 0] > x[0]) & (points[:, 0] < x[1])
    return points[~(inside & (points[:, 2] > z[0]) & (points[:, 2] < z[1]))]


def causes(
    cloud: PointCloud, folder: Path, **params: object
) -> tuple[dict[str, float], list[Diagnostic]]:
    """Return the shares of empty cells by cause, and diagnostics."""
    _, ctx = scenes.rastered(cloud, WALL.planes(), folder, **{"gsd_m": WALL.gsd_m, **params})
    named = scenes.numbers(ctx)
    shares = {cause: named[f"empty_{cause}_share"] for cause in CAUSES}
    assert sum(shares.values()) == pytest.approx(named["empty_share"], abs=1e-9)
    return shares, [one for one in ctx.diagnostics if one.code in CODES]


def only(cause: str, share: float) -> dict[str, object]:
    expected = dict.fromkeys(CAUSES, 0.0) | {cause: share}
    return {name: pytest.approx(value, abs=SHARE) for name, value in expected.items()}


def test_what_lies_behind_the_buffer_is_told_with_its_depth(tmp_path: Path) -> None:
    wall = without(grid((0, 4), (0, 3)), (1.0, 2.5), (0.5, 2.0))
    alcove = grid((1.0, 2.5), (0.5, 2.0), depth_m=-1.3)
    shares, said = causes(scenes.cloud_of(np.vstack([wall, alcove])), tmp_path)
    assert shares == only("behind", 1.5 * 1.5 / 12.0)
    (one,) = said
    assert (one.code, one.values["behind_m"]) == ("wall-behind-buffer", 1.3)
    assert "buffer_behind_m=1.3" in one.remedy
    # For an opening that shows nothing, there is no setting to suggest.
    shares, said = causes(scenes.cloud_of(wall), tmp_path)
    assert shares == only("unseen", 1.5 * 1.5 / 12.0)
    assert [(one.code, one.remedy) for one in said] == [("wall-unseen", "")]


def test_cells_finer_than_the_scan_are_told_from_holes(tmp_path: Path) -> None:
    cloud = scenes.cloud_of(grid((0, 4), (0, 3), step_m=0.025))
    shares, said = causes(cloud, tmp_path, gsd_m=0.005, recover_gap_cells=0)
    assert shares["sparse"] > 0.9
    assert shares["unseen"] < SHARE
    assert [one.code for one in said] == ["wall-sparse"]
    assert "gsd_m" in said[0].remedy


# The void is in the middle of a wall of 40 x 40 cells of 2 cm. It has 4 x 4 tiles of 3 x 3 cells.
VOID = slice(9, 21)
VOID_SHARE = 144 / 1600


def stated(
    places_m: NDArray[np.float64],
    *,
    station: tuple[float, float, float] | None = None,
    others: tuple[tuple[float, float, float], ...] = (),
    free_m: float = 1.0,
) -> dict[str, float]:
    """Return the causes of the void, given points (n, 3): metres right, down and in front."""
    frame = samples.facing_south(0.02, 40, 40)
    count = np.ones(frame.shape, dtype=np.uint32)
    count[VOID, VOID] = 0
    depth = np.where(count > 0, np.float32(0.0), np.float32(np.nan))
    wall = samples.wall(frame, depth_m=depth, count=count)

    def world(places: NDArray[np.float64]) -> NDArray[np.float64]:
        return places[:, [0, 2, 1]] * [1.0, -1.0, -1.0]

    x, y, z = (np.ascontiguousarray(axis, dtype=np.float32) for axis in world(places_m).T)
    points = SampledPoints(origin=np.zeros(3), x=x, y=y, z=z, n_represented=1.0)
    stations = None if station is None else world(np.array([station, *others]))
    found = emptiness_of(
        wall,
        Slab(frame=frame, front_m=0.15, behind_m=0.25),
        Sight(points=points, stations=stations),
        free_m=free_m,
        threads=1,
    )
    assert found.share == pytest.approx(VOID_SHARE)
    depths_m = places_m[:, 2]
    if found.shares["before"]:
        before_m = depths_m[(depths_m > 0.15) & (depths_m < free_m)]
        assert found.before_m == pytest.approx(np.percentile(before_m, 95.0))
    if found.shares["behind"]:
        assert found.behind_m == pytest.approx(-np.median(depths_m[depths_m < -0.25]))
    return {cause: share / VOID_SHARE for cause, share in found.shares.items() if share}


def in_each_tile(depth_m: float, count: int = 2) -> NDArray[np.float64]:
    """Return a number of points at one depth in each tile of the void."""
    middles = 0.02 * (np.arange(VOID.start, VOID.stop, 3) + 1.5)
    right, down = (axis.ravel() for axis in np.meshgrid(middles, middles))
    tiles = np.column_stack([right, down, np.full(right.size, depth_m)])
    return np.repeat(tiles, count, axis=0)


@pytest.mark.parametrize(
    ("depth_m", "count", "cause"),
    [
        (-1.0, 2, "behind"),
        (-1.0, 1, "unseen"),
        (-0.26, 2, "behind"),
        (-0.24, 2, "unseen"),
        (-3.9, 2, "behind"),
        (-4.1, 2, "unseen"),
        (0.5, 2, "before"),
        (0.5, 1, "unseen"),
        (0.16, 2, "before"),
        (0.14, 2, "unseen"),
        (0.9, 2, "before"),
        (1.1, 2, "unseen"),
    ],
)
def test_two_points_give_the_cause_of_an_empty_tile(depth_m: float, count: int, cause: str) -> None:
    assert stated(in_each_tile(depth_m, count)) == {cause: pytest.approx(1.0)}
    # Objects count up to five metres in front of a wall.
    assert stated(in_each_tile(4.9), free_m=np.inf) == {"before": pytest.approx(1.0)}
    assert stated(in_each_tile(5.1), free_m=np.inf) == {"unseen": pytest.approx(1.0)}


def test_what_stands_before_counts_before_what_lies_behind() -> None:
    both = np.vstack([in_each_tile(-1.0), in_each_tile(0.5)[:16]])
    both[:24:2, 2] -= 0.3
    both[-4:, 2] += 0.2
    # Half of the tiles have points in front.
    assert stated(both) == {"before": pytest.approx(0.5), "behind": pytest.approx(0.5)}


@pytest.mark.parametrize(
    ("along_m", "cause"), [(0.15, "unseen"), (0.55, "hidden"), (3.6, "hidden"), (4.1, "unseen")]
)
def test_a_screen_hides_the_wall_behind_it_from_a_station(along_m: float, cause: str) -> None:
    # The void is seen at 45 degrees from 4.24 m; the screen is perpendicular to the rays.
    middle, station = np.array([0.3, 0.3, 0.0]), np.array([3.3, 0.3, 3.0])
    way = (station - middle) / np.linalg.norm(station - middle)
    across = np.array([way[2], 0.0, -way[0]])
    off = 0.02 * np.arange(-25, 26)
    side, up = (axis.ravel() for axis in np.meshgrid(off, off))
    screen = middle + along_m * way + side[:, None] * across + up[:, None] * [0.0, 1.0, 0.0]
    # Remove points directly in front of the void.
    screen = screen[(screen[:, 2] > 1.0) | (screen[:, 0] > 0.45) | (screen[:, 2] < 0.15)]
    room = np.array([[-3.0, -3.0, -1.0], [5.0, 4.0, 5.0]])
    points = np.vstack([screen, np.repeat(room, 40, axis=0)])
    found = stated(points, station=(3.3, 0.3, 3.0))
    assert found.get(cause, 0.0) > 0.8
    # No station sees the wall from behind, which hides nothing from the first.
    behind = 3.3, 0.3, -3.0
    assert stated(points, station=behind) == {"hidden": pytest.approx(1.0)}
    assert stated(points, station=(3.3, 0.3, 3.0), others=(behind,)).get(cause, 0.0) > 0.8


def screened(station: tuple[float, float, float], *stray: tuple[float, float, float]) -> float:
    """Return the share of the void that a screen 2 m in front of it hides from a station."""
    off = 0.05 * np.arange(-40, 41) + 0.3
    right, down = (axis.ravel() for axis in np.meshgrid(off, off))
    screen = np.repeat(np.column_stack([right, down, np.full(right.size, 2.0)]), 2, axis=0)
    points = np.vstack([screen, np.array(stray).reshape(-1, 3)])
    return stated(points, station=station).get("hidden", 0.0)


@pytest.mark.parametrize("far_m", [5.0, 5e6, 5e12])
def test_a_station_may_stand_anywhere(far_m: float) -> None:
    # A station may be at the origin of a survey grid.
    assert screened((0.3, 0.3, far_m)) == pytest.approx(1.0)
    # From the side, the rays pass the screen.
    assert screened((4.0 * far_m, 0.3, far_m)) == 0.0
    # Distant stray points do not enlarge the voxels.
    assert screened((0.3, 0.3, 5.0), (far_m, far_m, far_m)) == pytest.approx(1.0)
    assert screened((20.0, 0.3, 5.0), (far_m, far_m, far_m)) == 0.0
    # Single points in voxels are stray and hide nothing.
    lattice = 0.11 * np.stack(np.indices((20, 10, 10)), axis=-1).reshape(-1, 3) + [1.0, -0.2, 0.1]
    assert screened((20.0, 0.3, 5.0), *lattice) == 0.0
