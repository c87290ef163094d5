"""LAZ files by plane, read back with laspy alone and with our own reader."""

from __future__ import annotations

import dataclasses
import datetime as dt
from pathlib import Path

import laspy
import numpy as np
import pytest

from orthoflow.errors import ArgumentError
from orthoflow.files.points.las import open_las
from orthoflow.files.points.plane_clouds import plane_colour, write_plane_cloud
from orthoflow.products import PointCloud, PointLabels
from tests import raster_scenes as scenes

N_POINTS = 5000


def cloud_and_labels() -> tuple[PointCloud, PointLabels]:
    rng = np.random.default_rng(5)
    points = scenes.SURVEY + rng.uniform(-20.0, 20.0, (N_POINTS, 3))
    cloud = scenes.cloud_of(points, intensity=rng.random(N_POINTS).astype(np.float32))
    cloud = dataclasses.replace(cloud, scan=rng.integers(0, 3, N_POINTS).astype(np.uint16))
    return cloud, PointLabels(plane_index=rng.integers(-1, 4, N_POINTS).astype(np.int16))


def test_points_come_back_with_plane_scan_and_intensity(tmp_path: Path) -> None:
    cloud, labels = cloud_and_labels()
    write_plane_cloud(tmp_path / "planes.laz", cloud, labels)
    read = laspy.read(tmp_path / "planes.laz")
    np.testing.assert_array_equal(read["plane"], labels.plane_index)
    np.testing.assert_array_equal(read.point_source_id, cloud.scan)
    # Rounded to a tenth of a millimetre.
    np.testing.assert_allclose(np.asarray(read.xyz), cloud.points_world(), atol=0.51e-4)
    assert cloud.intensity is not None
    intensity = np.asarray(read.intensity, dtype=np.float64) / 65535.0
    np.testing.assert_allclose(intensity, cloud.intensity.astype(np.float64), atol=1e-5)
    assert open_las(tmp_path / "planes.laz").n_most == N_POINTS


def test_each_plane_has_a_colour_of_its_own_that_intensity_only_shades(tmp_path: Path) -> None:
    cloud, labels = cloud_and_labels()
    write_plane_cloud(tmp_path / "planes.laz", cloud, labels)
    read = laspy.read(tmp_path / "planes.laz")
    colours = np.column_stack([read.red, read.green, read.blue]) / 257.0
    for plane in range(-1, 4):
        mine = colours[labels.plane_index == plane]
        shade = mine.max(axis=1) / max(plane_colour(plane))
        assert shade.min() >= 0.39
        assert shade.max() == pytest.approx(1.0, abs=0.01)
        pure = mine / shade[:, None]
        np.testing.assert_allclose(pure, np.tile(plane_colour(plane), (len(mine), 1)), atol=0.5)
    apart = [np.array(plane_colour(k)) for k in range(-1, 12)]
    gaps = [np.abs(a - b).max() for i, a in enumerate(apart) for b in apart[:i]]
    assert min(gaps) >= 20


def test_the_same_cloud_gives_the_same_bytes(tmp_path: Path) -> None:
    cloud, labels = cloud_and_labels()
    for name in ("a.laz", "b.laz"):
        write_plane_cloud(tmp_path / name, cloud, labels)
    assert (tmp_path / "a.laz").read_bytes() == (tmp_path / "b.laz").read_bytes()
    # No date of today's in it.
    assert laspy.read(tmp_path / "a.laz").header.creation_date == dt.date(1970, 1, 1)


def test_labels_of_another_cloud_are_refused(tmp_path: Path) -> None:
    cloud, _ = cloud_and_labels()
    other = PointLabels(plane_index=np.zeros(7, dtype=np.int16))
    with pytest.raises(ArgumentError, match="labels are of 7 points, but the cloud has 5000"):
        write_plane_cloud(tmp_path / "planes.laz", cloud, other)
