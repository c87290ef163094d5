"""`dense.sgm`: points of oriented photos are on the surface that the photos show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.dense.sgm import DenseSgm
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.errors import MethodError
from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import Cameras, PointCloud
from tests import raster_scenes as scenes

NEAR_FAR: Mapping[str, object] = {"nearest_m": 1.5, "farthest_m": 3.6}


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> SimulateRoom.Out:
    params = SimulateRoom.Params(
        scan_step_m=0.05,
        panorama_step_m=0.2,
        photo_layout="variant2",
        photo_gsd_m=0.008,
        photo_obliquity_deg=3.0,
    )
    ctx = scenes.context(tmp_path_factory.mktemp("room"))
    return SimulateRoom().run(SimulateRoom.In(), params, ctx)


def matched(
    folder: Path, inputs: DenseSgm.In, **params: object
) -> tuple[PointCloud, dict[str, float]]:
    folder.mkdir(exist_ok=True)
    ctx = scenes.context(folder)
    out = DenseSgm().run(inputs, DenseSgm.Params.model_validate({**NEAR_FAR, **params}), ctx)
    return out.cloud, {metric.name: metric.value for metric in ctx.metrics}


@pytest.fixture(scope="module")
def dense(
    room: SimulateRoom.Out, tmp_path_factory: pytest.TempPathFactory
) -> tuple[PointCloud, dict[str, float]]:
    inputs = DenseSgm.In(photos=room.photos, cameras=room.cameras)
    return matched(tmp_path_factory.mktemp("dense"), inputs)


def test_points_lie_on_the_surface(
    room: SimulateRoom.Out, dense: tuple[PointCloud, dict[str, float]]
) -> None:
    assert room.cameras == room.truth.cameras
    cloud, metrics = dense
    # There are three rows of six photos; the last photo of a row has no neighbour to its right.
    assert metrics["n_pairs"] == 15
    assert metrics["n_points"] == len(cloud)
    # Photos overlap by 70 %, but a margin as wide as the range of disparities is not matched.
    assert metrics["matched_share"] > 0.3
    assert cloud.stations is not None
    assert cloud.scan is not None
    assert cloud.rgb is not None
    chosen = np.random.default_rng(1).choice(len(cloud), 5_000, replace=False)
    points, stations = cloud.points_world(chosen), cloud.stations[cloud.scan[chosen]]
    # Compute the distance of the first surface on the ray from the station through each point.
    views = SceneCameras(room.truth.scene, cores=1)
    off = []
    for station in cloud.stations:
        rays = points[(stations == station).all(axis=1)] - station
        off.append(np.abs(views.cast(station, rays).t - 1.0) * np.linalg.norm(rays, axis=1))
    off_m = np.concatenate(off)
    # With 8 mm pixels and a base of a third of the distance, 0.3 px of disparity are 8 mm.
    assert np.median(off_m) < 0.008
    # The other points are at edges, where one photo shows areas that the other does not show.
    assert np.mean(off_m < 0.03) > 0.85


def test_of_points_in_one_cube_one_is_kept(
    tmp_path: Path, room: SimulateRoom.Out, dense: tuple[PointCloud, dict[str, float]]
) -> None:
    inputs = DenseSgm.In(photos=room.photos, cameras=room.cameras)
    coarse, _ = matched(tmp_path, inputs, spacing_m=0.05)
    assert coarse.scan is not None
    cubes = np.column_stack([coarse.scan, np.floor(coarse.points_world() / 0.05 + 1e-6)])
    # Offsets are float32, so a few points at the sides of cubes are in the next cube.
    assert len(np.unique(cubes, axis=0)) > 0.99 * len(coarse)
    assert len(coarse) < 0.2 * len(dense[0])
    given = {tuple(row) for row in np.round(dense[0].points_world(), 4)}
    assert all(tuple(row) in given for row in np.round(coarse.points_world()[:1000], 4))


def test_photos_without_a_neighbour_and_surfaces_elsewhere_are_refused(
    tmp_path: Path, room: SimulateRoom.Out
) -> None:
    first, second = room.cameras.cameras[:2]
    # The base of the first photo and the one above it is along the columns.
    for cameras, n_oriented in (
        ((first,), 1),
        ((replace(first, status="refused"), second), 1),
        ((first, room.cameras.cameras[6]), 2),
    ):
        inputs = DenseSgm.In(photos=room.photos, cameras=Cameras(cameras=cameras))
        with pytest.raises(MethodError, match=rf"oriented photos \({n_oriented}\): neighbouring"):
            matched(tmp_path, inputs)
    with pytest.raises(ValueError, match=r"farthest_m 1 must be greater than nearest_m 1\.5"):
        DenseSgm.Params(nearest_m=1.5, farthest_m=1.0)
