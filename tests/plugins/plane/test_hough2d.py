"""`plane.hough2d` finds the true planes, wherever they lie and however the points are ordered."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.hough2d import Hough2d
from pydantic import ValidationError

from orthoflow.errors import MethodError
from orthoflow.geometry import angle_between_deg, frame_over
from orthoflow.products import Planes, PointCloud
from tests.plane_scenes import (
    ROOM,
    cloud_of,
    context,
    sampled,
)

STATION = np.array([[0.3, -0.2, 0.1]])


def detect(cloud: PointCloud, folder: Path, *, cores: int = 2, **params: object) -> Hough2d.Out:
    return Hough2d().run(
        Hough2d.In(cloud=cloud), Hough2d.Params(**params), context(folder, cores=cores)
    )


def nearest(planes: Planes, normal: NDArray[np.float64], centre: NDArray[np.float64]) -> int:
    """The plane that passes nearest to a true one's centre among those with its direction."""
    angles = np.array([angle_between_deg(found, normal) for found in planes.normal])
    angles = np.minimum(angles, 180.0 - angles)
    misses = np.abs(planes.normal @ centre - planes.offset)
    return int(np.argmin(misses + np.where(angles < 1.0, 0.0, 1e6)))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Hough2d.Out:
    # To the last point: by the paper's rule the table, 3 % of the points, would be left.
    cloud = cloud_of(sampled(), stations=STATION)
    return detect(cloud, tmp_path_factory.mktemp("room"))


def test_planes_are_ordered_by_support_and_named_by_position(room: Hough2d.Out) -> None:
    planes = room.planes
    assert (np.diff(planes.n_points) <= 0).all()
    assert planes.names[0] == "wall 0"
    kinds = [name.split()[0] for name in planes.names]
    assert list(planes.names) == [f"{kind} {place}" for place, kind in enumerate(kinds)]
    floor, ceiling = kinds.index("floor"), kinds.index("ceiling")
    assert planes.normal[floor] @ planes.up > 0.99 > -0.99 > planes.normal[ceiling] @ planes.up
    assert [name for name in planes.names if name.startswith("level")] == [
        f"level {nearest(planes, ROOM[6].normal, np.array(ROOM[6].centre))}"
    ]


def test_rectangles_hold_the_entire_wall_and_little_more(room: Hough2d.Out) -> None:
    frame = frame_over(room.planes.corners[0], room.planes.normal[0], gsd_m=0.01)
    assert frame.u_world @ (1.0, 0.0, 0.0) > 0.99  # the front wall seen from inside: east is right
    front = sampled()[: ROOM[0].n_points]
    placed = frame.wall_from_world(front)
    assert (placed[:, 0] >= -0.1).all()
    assert (placed[:, 0] <= frame.width + 0.1).all()
    assert (placed[:, 1] >= -0.1).all()
    assert (placed[:, 1] <= frame.height + 0.1).all()
    assert frame.width * 0.01 == pytest.approx(6.0, abs=0.02)
    assert frame.height * 0.01 == pytest.approx(3.0, abs=0.02)


def test_the_number_of_threads_does_not_change_a_bit(tmp_path: Path) -> None:
    cloud = cloud_of(sampled())
    one = detect(cloud, tmp_path / "one", cores=1)
    three = detect(cloud, tmp_path / "three", cores=3)
    np.testing.assert_array_equal(one.labels.plane_index, three.labels.plane_index)
    for name in ("normal", "offset", "corners", "covariance", "rms_m"):
        np.testing.assert_array_equal(getattr(one.planes, name), getattr(three.planes, name))


def test_up_may_be_another_axis(room: Hough2d.Out, tmp_path: Path) -> None:
    swap = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]])  # (x, y, z) -> (y, z, x): up is y
    cloud = cloud_of(sampled() @ swap.T, up=(0.0, 1.0, 0.0), stations=STATION @ swap.T)
    moved = detect(cloud, tmp_path).planes
    assert angle_between_deg(moved.normal[0], swap @ room.planes.normal[0]) < 0.005
    assert set(moved.names) == set(room.planes.names)


@pytest.mark.parametrize(
    "options",
    [{"accumulator": "unit"}, {"accumulator": "canny"}, {"coordinates": "raw"}],
    ids=lambda options: "-".join(options.values()),
)
def test_other_accumulators_find_the_densest_wall(
    options: dict[str, str], room: Hough2d.Out, tmp_path: Path
) -> None:
    planes = detect(cloud_of(sampled(), stations=STATION), tmp_path, **options).planes
    index = nearest(planes, ROOM[0].normal, np.array(ROOM[0].centre))
    assert angle_between_deg(planes.normal[index], room.planes.normal[0]) < 0.005
    assert planes.offset[index] == pytest.approx(room.planes.offset[0], abs=5e-5)
    if "coordinates" in options:
        assert len(planes) == 7  # "identical result, considerably longer" (markiewicz2015)


def test_raw_coordinates_with_one_vote_per_cell_are_refused() -> None:
    with pytest.raises(ValidationError, match="accumulator: counts"):
        Hough2d.Params(coordinates="raw", accumulator="unit")


def test_floor_and_ceiling_alone_leave_no_smeared_wall(tmp_path: Path) -> None:
    planes = detect(cloud_of(sampled(ROOM[4:6])), tmp_path).planes
    assert sorted(planes.names) == ["ceiling 1", "floor 0"]


def test_a_rounded_body_is_no_wall(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    around = rng.uniform(0.0, 2.0 * np.pi, 10_000)
    barrel = np.column_stack(
        [0.6 * np.cos(around), 0.6 * np.sin(around), rng.uniform(0, 2, 10_000)]
    )
    with pytest.raises(MethodError, match=r"\(1.2 x 1.2 x 2 m\) with tolerance_m"):
        detect(cloud_of(barrel), tmp_path)
    with pytest.raises(MethodError, match=r"is small: .*unit of read.scan.* 0.1 m wide"):
        detect(cloud_of(0.1 * barrel), tmp_path)


def test_a_guessed_side_is_warned_about_and_names_view_from(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    out = Hough2d().run(Hough2d.In(cloud=cloud_of(sampled())), Hough2d.Params(), ctx)
    assert out.planes.viewpoint == "guess"
    assert any("set view_from of read.scan" in warning for warning in ctx.warnings)
    # Inside a room the guess is right all the same.
    assert (out.planes.normal @ STATION[0] > out.planes.offset).all()


def test_view_from_decides_the_side(tmp_path: Path) -> None:
    behind = np.array([[0.0, 9.0, 0.0]])
    cloud = cloud_of(sampled(ROOM[:1]), stations=behind, source="view_from")
    planes = detect(cloud, tmp_path).planes
    assert planes.viewpoint == "view_from"
    assert planes.normal[0] @ (0.0, 1.0, 0.0) > 0.99


def test_scan_numbers_of_the_points_outvote_a_nearer_station(tmp_path: Path) -> None:
    points = sampled(ROOM[:1])
    stations = np.array([[0.0, 2.5, 0.0], [0.0, -4.0, 0.0]])
    cloud = dataclasses.replace(
        cloud_of(points, stations=stations), scan=np.ones(len(points), dtype=np.uint16)
    )
    planes = detect(cloud, tmp_path).planes
    assert planes.normal[0] @ (0.0, 1.0, 0.0) < -0.99


def test_a_perfectly_flat_wall_is_found(tmp_path: Path) -> None:
    planes = detect(cloud_of(sampled(ROOM[1:2], noise_m=0.0)), tmp_path).planes
    np.testing.assert_allclose(np.abs(planes.normal[0]), [0, 1, 0], atol=1e-7)
    assert abs(planes.offset[0]) == pytest.approx(2.0, abs=1e-6)
