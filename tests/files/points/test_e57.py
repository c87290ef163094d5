"""E57: scans where their poses put them, and every field as it was written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points import Scan, e57, open_scan
from tests import scan_files
from tests.scan_files import read_all


def cartesian(points: NDArray[np.float64], **more: NDArray[np.generic]) -> dict[str, object]:
    return {
        "cartesianX": points[:, 0],
        "cartesianY": points[:, 1],
        "cartesianZ": points[:, 2],
        **more,
    }


def test_e57_scans_are_placed_by_their_poses(tmp_path: Path, points: NDArray[np.float64]) -> None:
    half = np.sqrt(0.5)
    scans = [
        {"fields": cartesian(points)},
        {
            "fields": cartesian(points),
            # 90 deg about z: x -> y, y -> -x.
            "rotation": (half, 0.0, 0.0, half),
            "translation": (634512.347, 486215.781, 112.193),
        },
    ]
    opened = open_scan(scan_files.write_e57(tmp_path / "a.e57", scans))
    first, second = opened.read()
    np.testing.assert_allclose(first.points, points, atol=1e-6)
    turned = np.column_stack([-points[:, 1], points[:, 0], points[:, 2]])
    expected = turned + np.array([634512.347, 486215.781, 112.193])
    np.testing.assert_allclose(second.points, expected, atol=1e-6)
    assert (first.scan, second.scan) == (0, 1)
    np.testing.assert_array_equal(opened.scans[1].station, [634512.347, 486215.781, 112.193])
    assert [scan.station_is_posed for scan in opened.scans] == [False, True]


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


def test_e57_rows_columns_colours_and_limits_are_kept(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    index = np.arange(40)
    scan = {
        "fields": cartesian(
            points,
            intensity=index / 10.0,
            colorRed=index,
            colorGreen=index + 1,
            colorBlue=index + 2,
            rowIndex=index + 70000,
            columnIndex=index * 2,
        ),
        "intensity_limits": (0.0, 8.0),
        "rgb_limit": 255,
    }
    opened = open_scan(scan_files.write_e57(tmp_path / "a.e57", [scan]))
    (block,) = opened.read()
    assert opened.fields == {"intensity", "rgb", "grid"}
    (scan_read,) = opened.scans
    assert scan_read.intensity_limits == (0.0, 8.0)
    assert scan_read.rgb_limit == 255.0
    np.testing.assert_allclose(block.intensity, index / 10.0, rtol=1e-6)
    np.testing.assert_array_equal(block.rgb, np.column_stack([index, index + 1, index + 2]))
    # 16 bits would have overflowed.
    np.testing.assert_array_equal(block.row, index + 70000)
    np.testing.assert_array_equal(block.column, index * 2)


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


def test_e57_is_read_in_blocks(
    tmp_path: Path, points: NDArray[np.float64], monkeypatch: pytest.MonkeyPatch
) -> None:
    from orthoflow.files.points import e57

    monkeypatch.setattr(e57, "BLOCK_POINTS", 16)
    path = scan_files.write_e57(tmp_path / "a.e57", [{"fields": cartesian(points)}] * 2)
    blocks = read_all(path)
    assert [len(block.points) for block in blocks] == [16, 16, 8, 16, 16, 8]
    assert [block.scan for block in blocks] == [0, 0, 0, 1, 1, 1]


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


# --- what headers say ---


class Node(dict[str, Any]):
    """What a file has at some place, by name."""

    def isDefined(self, name: str) -> bool:  # noqa: N802 - the library's name
        return name in self


class Number:
    def __init__(self, value: float, scaled: float | None = None) -> None:
        self._value = value
        if scaled is not None:
            self.scaledValue = lambda: scaled

    def value(self) -> float:
        return self._value


def numbers(**values: float) -> Node:
    return Node({name: Number(value) for name, value in values.items()})


def test_a_number_is_what_it_stands_for() -> None:
    assert e57.number_of(Number(7)) == 7.0
    assert e57.number_of(Number(7, scaled=0.007)) == 0.007


@pytest.mark.parametrize(
    ("stated", "limits"),
    [
        ({"low": 1.0, "high": 5.0}, (1.0, 5.0)),
        ({"low": -1.0, "high": 0.0}, (-1.0, 0.0)),
        ({"low": 5.0, "high": 5.0}, None),
        ({"low": 5.0, "high": 1.0}, None),
        ({"low": 1.0}, None),
        ({"high": 1.0}, None),
        ({"low": -np.inf, "high": 1.0}, None),
        ({"low": 1.0, "high": np.inf}, None),
        ({"low": np.nan, "high": 1.0}, None),
        (None, None),
    ],
)
def test_limits_hold_where_both_are_stated_and_differ(
    stated: dict[str, float] | None, limits: tuple[float, float] | None
) -> None:
    node = Node() if stated is None else Node(group=numbers(**stated))
    assert e57._limits(node, "group", "low", "high") == limits


def test_colours_are_full_at_the_largest_of_three_limits() -> None:
    stated = {"colorRedMinimum": 0.0, "colorGreenMinimum": 0.0, "colorBlueMinimum": 0.0}
    full = {"colorRedMaximum": 200.0, "colorGreenMaximum": 255.0, "colorBlueMaximum": 100.0}
    assert e57._rgb_limit(Node(colorLimits=numbers(**stated, **full))) == 255.0
    del full["colorBlueMaximum"]
    assert e57._rgb_limit(Node(colorLimits=numbers(**stated, **full))) is None
    assert e57._rgb_limit(Node()) is None


def test_a_scanner_stands_where_its_pose_says() -> None:
    rotation, translation = e57.pose_of(Node())
    np.testing.assert_array_equal(rotation, np.eye(3))
    np.testing.assert_array_equal(translation, np.zeros(3))
    # A quarter turn about z, of a length that squares to nothing.
    turn = numbers(w=1e-200, x=0.0, y=0.0, z=1e-200)
    rotation, translation = e57.pose_of(
        Node(pose=Node(rotation=turn, translation=numbers(z=3.0, x=1.0, y=2.0)))
    )
    np.testing.assert_allclose(rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_array_equal(translation, [1.0, 2.0, 3.0])
    nothing = numbers(w=0.0, x=0.0, y=0.0, z=0.0)
    rotation, translation = e57.pose_of(Node(pose=Node(rotation=nothing)))
    np.testing.assert_array_equal(rotation, np.eye(3))
    np.testing.assert_array_equal(translation, np.zeros(3))


def header_of(**known: Any) -> e57.ScanHeader:
    plain: dict[str, Any] = {
        "index": 0,
        "n_points": 3,
        "names": frozenset({"cartesianX", "cartesianY", "cartesianZ"}),
        "rotation": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
        "translation": np.array([10.0, 20.0, 30.0]),
        "intensity": None,
        "scan": Scan(),
    }
    return e57.ScanHeader(**{**plain, **known})


FULL = header_of(intensity="intensity", scan=Scan(fields=frozenset({"intensity", "rgb", "grid"})))
ARRAYS = {
    "cartesianX": np.array([1.0, 2.0, 3.0]),
    "cartesianY": np.array([4.0, 5.0, 6.0]),
    "cartesianZ": np.array([7.0, 8.0, 9.0]),
}
MORE = {
    "intensity": np.array([0.25, 0.5, 0.75]),
    "colorRed": np.array([1.0, 2.0, 3.0]),
    "colorGreen": np.array([4.0, 5.0, 6.0]),
    "colorBlue": np.array([7.0, 8.0, 9.0]),
    "rowIndex": np.array([0.0, 1.0, 2.0]),
    "columnIndex": np.array([5.0, 6.0, 7.0]),
}


def test_a_block_has_what_its_scan_has() -> None:
    block = e57._block(dict(ARRAYS), header_of(), 2)
    np.testing.assert_allclose(block.points, [[6, 21, 37], [5, 22, 38], [4, 23, 39]])
    assert (block.scan, block.n_read, block.left_out) == (2, 3, {})
    assert block.intensity is None
    assert block.rgb is None
    assert block.row is None
    assert block.column is None
    still = e57._block(dict(ARRAYS), header_of(scan=Scan(station_is_posed=False)), 2)
    np.testing.assert_array_equal(still.points[0], [1.0, 4.0, 7.0])
    full = e57._block({**ARRAYS, **MORE}, FULL, 0)
    np.testing.assert_array_equal(full.intensity, [0.25, 0.5, 0.75])
    np.testing.assert_array_equal(full.rgb, [[1, 4, 7], [2, 5, 8], [3, 6, 9]])
    np.testing.assert_array_equal(full.row, [0, 1, 2])
    np.testing.assert_array_equal(full.column, [5, 6, 7])


def test_points_without_a_position_are_left_out_with_all_that_is_theirs() -> None:
    arrays = {**ARRAYS, **MORE, "cartesianInvalidState": np.array([0.0, 2.0, 0.0])}
    block = e57._block(arrays, FULL, 0)
    assert (block.n_read, block.left_out) == (3, {"invalid": 1})
    np.testing.assert_array_equal(block.points[:, 1], [21.0, 23.0])
    np.testing.assert_array_equal(block.intensity, [0.25, 0.75])
    np.testing.assert_array_equal(block.column, [5, 7])


def test_spheres_count_from_x_towards_y_and_up() -> None:
    spherical = np.array([[2.0, 0.0, 0.0], [2.0, np.pi / 2, 0.0], [2.0, 0.0, np.pi / 2]])
    np.testing.assert_allclose(e57._cartesian(spherical), 2.0 * np.eye(3), atol=1e-12)
    both = e57._cartesian(np.array([[2.0, np.pi / 6, np.pi / 3]]))
    np.testing.assert_allclose(both, [[np.sqrt(3) / 2, 0.5, np.sqrt(3)]])
