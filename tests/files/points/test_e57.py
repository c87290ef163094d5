"""E57: scans where their poses put them, and every field as it was written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points import open_scan
from tests import scan_files
from tests.scan_files import read_all


def cartesian(points: NDArray[np.float64], **more: NDArray[np.generic]) -> dict[str, object]:
    return {
        "cartesianX": points[:, 0],
        "cartesianY": points[:, 1],
        "cartesianZ": points[:, 2],
        **more,
    }


HALF = np.sqrt(0.5)
# Quaternion w, x, y, z and where the axes x, y, z of the scan point to in the world.
POSES = {
    "90 degrees about x": ((HALF, HALF, 0, 0), [(1, 0, 0), (0, 0, 1), (0, -1, 0)]),
    "90 degrees about y": ((HALF, 0, HALF, 0), [(0, 0, -1), (0, 1, 0), (1, 0, 0)]),
    "90 degrees about z": ((HALF, 0, 0, HALF), [(0, 1, 0), (-1, 0, 0), (0, 0, 1)]),
    "180 degrees about x": ((0, 1, 0, 0), [(1, 0, 0), (0, -1, 0), (0, 0, -1)]),
    "120 degrees about the diagonal": ((0.5, 0.5, 0.5, 0.5), [(0, 1, 0), (0, 0, 1), (1, 0, 0)]),
    "the other way about the diagonal": (
        (0.5, -0.5, -0.5, -0.5),
        [(0, 0, 1), (1, 0, 0), (0, 1, 0)],
    ),
    # Cosine 0.28 and sine 0.96; about x, then about y: 3-4-5 halves of the angles, exact.
    "tilted about x": ((0.8, 0.6, 0, 0), [(1, 0, 0), (0, 0.28, 0.96), (0, -0.96, 0.28)]),
    "tilted about y": ((0.8, 0, 0.6, 0), [(0.28, 0, -0.96), (0, 1, 0), (0.96, 0, 0.28)]),
    "tilted about x, then y": (
        (0.64, 0.48, 0.48, -0.36),
        [(0.28, 0, -0.96), (0.9216, 0.28, 0.2688), (0.2688, -0.96, 0.0784)],
    ),
    "not of length 1": ((8, 6, 0, 0), [(1, 0, 0), (0, 0.28, 0.96), (0, -0.96, 0.28)]),
    "very short": ((8e-170, 6e-170, 0, 0), [(1, 0, 0), (0, 0.28, 0.96), (0, -0.96, 0.28)]),
    "very long": ((8e170, 6e170, 0, 0), [(1, 0, 0), (0, 0.28, 0.96), (0, -0.96, 0.28)]),
    "of no direction": ((0, 0, 0, 0), [(1, 0, 0), (0, 1, 0), (0, 0, 1)]),
}


@pytest.mark.parametrize(("rotation", "axes_world"), POSES.values(), ids=POSES.keys())
def test_a_tilted_e57_scanner_turns_each_axis_where_its_pose_says(
    tmp_path: Path, rotation: tuple[float, ...], axes_world: list[tuple[float, ...]]
) -> None:
    station = np.array([4.0, -2.0, 1.0])
    scan = {
        "fields": cartesian(np.vstack([np.eye(3), [[2.0, 3.0, 5.0]]])),
        "rotation": rotation,
        "translation": station,
    }
    (block,) = read_all(scan_files.write_e57(tmp_path / "a.e57", [scan]))
    x, y, z = np.array(axes_world)
    expected = station + np.array([x, y, z, 2.0 * x + 3.0 * y + 5.0 * z])
    np.testing.assert_allclose(block.points, expected, atol=1e-14)


def test_e57_leaves_out_points_without_a_position(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    state = np.arange(40) % 3
    fields = cartesian(points, cartesianInvalidState=state, intensity=np.arange(40.0))
    (block,) = read_all(scan_files.write_e57(tmp_path / "a.e57", [{"fields": fields}]))
    np.testing.assert_allclose(block.points, points[state == 0], atol=1e-6)
    np.testing.assert_array_equal(block.intensity, np.flatnonzero(state == 0))
    assert (block.n_read, block.left_out) == (40, {"invalid": 26})


def test_e57_spherical_coordinates_become_cartesian(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    distance = np.linalg.norm(points, axis=1)
    fields = {
        "sphericalRange": distance,
        "sphericalAzimuth": np.arctan2(points[:, 1], points[:, 0]),
        "sphericalElevation": np.arcsin(points[:, 2] / distance),
    }
    (block,) = read_all(scan_files.write_e57(tmp_path / "a.e57", [{"fields": fields}]))
    np.testing.assert_allclose(block.points, points, atol=1e-12)


def test_an_e57_file_without_points_is_refused(tmp_path: Path) -> None:
    path = scan_files.write_e57(tmp_path / "a.e57", [])
    with pytest.raises(InputError, match=r"a\.e57 holds no points"):
        open_scan(path)


def test_a_changed_byte_in_an_e57_file_is_found(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    path = scan_files.write_e57(tmp_path / "a.e57", [{"fields": cartesian(points)}])
    content = bytearray(path.read_bytes())
    content[200] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(InputError, match=r"a\.e57 cannot be read as E57: .*export it again"):
        read_all(path)


def test_an_e57_scan_without_coordinates_is_refused(tmp_path: Path) -> None:
    scan = {"fields": {"intensity": np.arange(3.0)}}
    path = scan_files.write_e57(tmp_path / "a.e57", [scan])
    with pytest.raises(InputError, match="scan 0 has the fields intensity, expected cartesianX"):
        open_scan(path)
