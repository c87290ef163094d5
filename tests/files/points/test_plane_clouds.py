"""LAZ files by plane, read back with laspy alone and with our own reader."""

from __future__ import annotations

import dataclasses
import datetime as dt
from pathlib import Path

import laspy
import numpy as np
import pytest

from orthoflow.errors import ArgumentError
from orthoflow.files.points import plane_clouds
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


def test_neighbouring_planes_have_hues_a_golden_section_apart() -> None:
    # 0.618 of the circle lies 0.708 of the way from cyan to blue, the next one, 0.236, near green.
    assert [plane_colour(k) for k in range(-1, 3)] == [
        *((128, 128, 128), (255, 102, 102)),
        *((102, 147, 255), (191, 255, 102)),
    ]


def small_cloud(**more: np.ndarray | None) -> PointCloud:
    points = np.array([[10.5, 20.25, 30.0], [11.0, 21.0, 31.0], [12.0, 22.0, 32.0]])
    return dataclasses.replace(scenes.cloud_of(points), **more)  # type: ignore[arg-type]


SMALL_LABELS = PointLabels(plane_index=np.array([-1, 0, 0], np.int16))


@pytest.mark.parametrize(
    ("more", "shades"),
    [
        ({"intensity": None, "rgb": None}, (1.0, 1.0, 1.0)),
        # Roots of the intensity, from the darkest (0.4) to the lightest; a scan goes from 0 to 1.
        ({"intensity": np.array([0.0, 0.25, 1.0], np.float32), "rgb": None}, (0.4, 0.7, 1.0)),
        ({"intensity": np.array([0.0, -4.0, 9.0], np.float32), "rgb": None}, (0.4, 0.4, 1.0)),
        (
            {
                "intensity": None,
                "rgb": np.array([[0, 0, 0], [90, 0, 60], [100, 100, 100]], np.uint8),
            },
            (0.4, 0.7, 1.0),
        ),
    ],
    ids=["neither", "intensity", "odd intensity", "colours"],
)
def test_a_colour_is_its_planes_shaded(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    more: dict[str, np.ndarray | None],
    shades: tuple[float, ...],
) -> None:
    monkeypatch.setattr(plane_clouds, "_CHUNK", 2)
    monkeypatch.setattr(plane_clouds, "_grey_range", exact_range)
    cloud = small_cloud(**more)
    write_plane_cloud(tmp_path / "a.laz", cloud, SMALL_LABELS)
    read = laspy.read(tmp_path / "a.laz")
    colours = np.array([(128, 128, 128), (255, 102, 102), (255, 102, 102)])
    expected = 257.0 * colours * np.array(shades)[:, None]
    np.testing.assert_allclose(np.column_stack([read.red, read.green, read.blue]), expected, atol=1)
    np.testing.assert_array_equal(read.xyz, cloud.points_world())
    assert set(read.return_number) == set(read.number_of_returns) == {1}
    header = read.header
    assert (header.version.minor, header.point_format.id) == (4, 7)
    assert header.generating_software.strip("\0") == "orthoflow"
    np.testing.assert_array_equal(header.scales, [1e-4] * 3)
    np.testing.assert_array_equal(header.offsets, np.floor(cloud.origin))
    if cloud.intensity is not None:
        np.testing.assert_array_equal(
            read.intensity, np.rint(65535.0 * np.clip(cloud.intensity, 0.0, 1.0))
        )


def exact_range(cloud: PointCloud) -> tuple[float, float]:
    grey = plane_clouds._grey(cloud, slice(0, len(cloud)))
    is_plain = cloud.intensity is None and cloud.rgb is None
    return (0.0, 1.0) if is_plain else (float(grey.min()), float(grey.max()))


def test_shades_go_from_the_first_to_the_last_hundredth() -> None:
    grey = np.tile(np.linspace(0.0, 1.0, 1001, dtype=np.float32), 20)
    cloud = scenes.cloud_of(np.zeros((len(grey), 3)), intensity=grey**2)
    low, high = plane_clouds._grey_range(cloud)
    assert low == pytest.approx(0.01, abs=2e-3)
    assert high == pytest.approx(0.99, abs=2e-3)
    assert plane_clouds._grey_range(small_cloud(intensity=None)) == (0.0, 1.0)
    nothing = np.zeros(0, np.float32)
    none = PointCloud(
        origin=np.zeros(3),
        x=nothing,
        y=nothing,
        z=nothing,
        up=np.array([0.0, 0.0, 1.0]),
        intensity=nothing,
    )
    assert plane_clouds._grey_range(none) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("far_m", "scale"), [(100_000.0, 1e-4), (107_374.0, 1e-4), (107_376.0, 1e-3), (2e6, 1e-2)]
)
def test_wide_clouds_are_kept_in_coarser_steps(tmp_path: Path, far_m: float, scale: float) -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.0, -far_m, 0.0]])
    still = np.zeros(2, np.float32)
    y = np.array([0.0, -far_m], np.float32)
    cloud = PointCloud(origin=np.zeros(3), x=still, y=y, z=still, up=np.array([0.0, 0.0, 1.0]))
    labels = PointLabels(plane_index=np.zeros(2, np.int16))
    write_plane_cloud(tmp_path / "a.laz", cloud, labels)
    read = laspy.read(tmp_path / "a.laz")
    np.testing.assert_allclose(read.header.scales, [scale] * 3, rtol=1e-12)
    np.testing.assert_allclose(read.xyz, points, atol=scale)
