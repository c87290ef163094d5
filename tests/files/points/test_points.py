"""Readers of point files: what is in the file comes out, and what is wrong with it is said."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError, OrthoflowError, PluginError
from orthoflow.files.points import PointBlock, las, open_scan
from orthoflow.files.points import blocks as blocks_module
from orthoflow.files.points.columns import Columns, columns_of_text
from orthoflow.files.points.libraries import guarded, load_library, reading
from orthoflow.files.points.lzf_kernels import decompress_lzf
from tests import scan_files

EMPTY_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\n"
    "property float z\nend_header\n"
)


@pytest.fixture
def points() -> NDArray[np.float64]:
    rng = np.random.default_rng(3)
    return np.round(rng.uniform(-5.0, 5.0, (40, 3)), 4)


def read_all(path: Path, columns: Columns | None = None) -> list[PointBlock]:
    return list(open_scan(path, columns).read())


def read_points(path: Path, columns: Columns | None = None) -> NDArray[np.float64]:
    return np.concatenate([block.points for block in read_all(path, columns)])


# LAS


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_gives_survey_coordinates_to_the_last_digit(
    tmp_path: Path, points: NDArray[np.float64], suffix: str
) -> None:
    shifted = points + np.array([634512.0, 5486215.0, 112.0])
    intensity = np.arange(40) * 100
    rgb = np.arange(120).reshape(40, 3) * 257
    path = scan_files.write_las(tmp_path / f"a{suffix}", shifted, intensity=intensity, rgb=rgb)
    scan = open_scan(path)
    (block,) = scan.read()
    np.testing.assert_allclose(block.points, shifted, atol=1e-9)
    np.testing.assert_array_equal(block.intensity, intensity)
    np.testing.assert_array_equal(block.rgb, rgb)
    assert scan.fields == {"intensity", "rgb"}
    assert scan.n_most == 40


def test_las_leaves_out_points_marked_as_deleted(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    withheld = np.arange(40) % 4 == 0
    path = scan_files.write_las(tmp_path / "a.laz", points, withheld=withheld)
    (block,) = read_all(path)
    np.testing.assert_allclose(block.points, points[~withheld], atol=1e-9)
    assert (block.n_read, block.n_withheld) == (40, 10)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("cores", [1, 3])
def test_las_blocks_keep_the_order_of_the_file_for_any_number_of_processes(
    suffix: str, cores: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Four chunks of 50 000 points, the last one not full; one to a block.
    many = np.random.default_rng(0).uniform(0, 5, (170_000, 3))
    path = scan_files.write_las(tmp_path / f"a{suffix}", many, withheld=np.arange(170_000) == 9)
    monkeypatch.setattr(las, "BLOCK_POINTS", 50_000)
    monkeypatch.setattr(las, "_BLOCKS_LEAST", 1)
    blocks = list(open_scan(path, cores=cores).read())
    assert [block.n_read for block in blocks] == [50_000, 50_000, 50_000, 20_000]
    found = np.concatenate([block.points for block in blocks])
    np.testing.assert_allclose(found, np.delete(many, 9, axis=0), atol=6e-5)
    for block in blocks:
        assert block.bounds is not None
        np.testing.assert_array_equal(block.bounds[0], block.points.min(axis=0))
        np.testing.assert_array_equal(block.bounds[1], block.points.max(axis=0))


@pytest.mark.parametrize(
    ("worker", "reason"),
    [
        ("raise SystemExit(3)", "its decoder ended with 3"),
        ("print('a chunk makes no sense')", "a chunk makes no sense"),
    ],
)
def test_a_decoder_that_fails_ends_in_one_sentence(
    worker: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    many = np.random.default_rng(0).uniform(0, 5, (5000, 3))
    path = scan_files.write_las(tmp_path / "a.laz", many)
    monkeypatch.setattr(las, "_BLOCKS_LEAST", 0)
    monkeypatch.setattr(las, "_WORKER", tmp_path / "worker.py")
    (tmp_path / "worker.py").write_text(worker)
    with pytest.raises(InputError, match=f"a.laz cannot be read as LAS/LAZ: {reason};"):
        list(open_scan(path, cores=2).read())


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("share", [0.3, 0.7, 0.95])
def test_a_las_file_that_is_cut_off_is_refused(tmp_path: Path, suffix: str, share: float) -> None:
    many = np.random.default_rng(0).uniform(0, 5, (5000, 3))
    path = scan_files.write_las(tmp_path / f"a{suffix}", many)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(InputError, match=rf"a\{suffix} (cannot be read|is cut off)"):
        read_all(path)


@pytest.mark.parametrize("seed", range(12))
def test_changed_bytes_in_a_laz_file_end_in_one_sentence_or_in_points(
    tmp_path: Path, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    path = scan_files.write_las(tmp_path / "a.laz", rng.uniform(0, 5, (3000, 3)))
    content = bytearray(path.read_bytes())
    start = [0, 400][seed % 2]
    for position in rng.integers(start, len(content), 20):
        content[position] ^= int(rng.integers(1, 256))
    path.write_bytes(bytes(content))
    message = "a.laz"
    try:
        read_all(path)
    except InputError as error:
        message = str(error)
    assert "a.laz" in message
    assert "\n" not in message


def test_a_laz_file_whose_bytes_decode_far_outside_its_bounds_is_refused(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    path = scan_files.write_las(tmp_path / "a.las", points)
    content = bytearray(path.read_bytes())
    content[-40 * 30 + 2] = 0x7F  # the high bytes of the first point's x
    content[-40 * 30 + 3] = 0x7F
    path.write_bytes(bytes(content))
    with pytest.raises(InputError, match=r"a\.las is damaged: points lie \d+ units outside"):
        read_all(path)


def test_las_points_a_little_outside_the_stated_bounds_are_kept_with_a_note(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    import laspy

    path = scan_files.write_las(tmp_path / "a.las", points)
    with path.open("r+b") as file:
        file.seek(179)  # max x of the header
        file.write(np.float64(points[:, 0].max() - 0.5).tobytes())
    with laspy.open(path) as reader:
        assert reader.header.maxs[0] == points[:, 0].max() - 0.5
    scan = open_scan(path)
    assert sum(len(block.points) for block in scan.read()) == 40
    assert "outside the bounds its header states" in scan.notes[0]


def change(path: Path, position: int, content: bytes) -> Path:
    changed = bytearray(path.read_bytes())
    changed[position : position + len(content)] = content
    path.write_bytes(bytes(changed))
    return path


def chunk_table(path: Path) -> int:
    content = path.read_bytes()
    (start,) = struct.unpack_from("<I", content, 96)
    (table,) = struct.unpack_from("<q", content, start)
    return int(table)


@pytest.mark.parametrize(
    ("position", "content", "message"),
    [
        (96, b"\xff\xff\xff\x00", "its points begin outside the file, which is cut off"),
        (100, b"\xff\xff\xff\x7f", "its header states 2147483647 records that have no room"),
        (243, b"\x05\x00\x00\x00", "records at its end are missing"),
    ],
    ids=["offset", "records", "extended-records"],
)
def test_a_damaged_las_header_is_found_before_a_library_believes_it(
    tmp_path: Path, points: NDArray[np.float64], position: int, content: bytes, message: str
) -> None:
    path = scan_files.write_las(tmp_path / "a.laz", points)
    if position == 243:
        change(path, 235, struct.pack("<Q", path.stat().st_size))
    with pytest.raises(InputError, match=rf"a\.laz cannot be read as LAS/LAZ: {message}"):
        open_scan(change(path, position, content))


def test_a_las_file_that_ends_within_its_header_is_refused(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    path = scan_files.write_las(tmp_path / "a.las", points)
    path.write_bytes(path.read_bytes()[:150])
    with pytest.raises(InputError, match="it ends within its header"):
        open_scan(path)


def test_a_damaged_chunk_table_is_found_before_the_decompressor_believes_it(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    path = scan_files.write_las(tmp_path / "a.laz", points)
    table = chunk_table(path)
    # 3 thousand million chunks of 16 bytes each would end the process.
    change(path, table + 4, b"\xff\xff\xff\xbf")
    with pytest.raises(InputError, match="its chunk table states 3221225471 chunks"):
        open_scan(path)


def test_a_number_of_points_that_the_chunks_do_not_hold_is_found(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    path = scan_files.write_las(tmp_path / "a.laz", points)
    change(path, 247, struct.pack("<Q", 400_000))
    with pytest.raises(InputError, match="its chunks hold 50000 points, its header states 400000"):
        open_scan(path)


# E57


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
    first, second = read_all(scan_files.write_e57(tmp_path / "a.e57", scans))
    np.testing.assert_allclose(first.points, points, atol=1e-6)
    turned = np.column_stack([-points[:, 1], points[:, 0], points[:, 2]])
    expected = turned + np.array([634512.347, 486215.781, 112.193])
    np.testing.assert_allclose(second.points, expected, atol=1e-6)
    assert (first.scan, second.scan) == (0, 1)
    assert second.station is not None
    np.testing.assert_array_equal(second.station, [634512.347, 486215.781, 112.193])
    assert (first.station_is_posed, second.station_is_posed) == (False, True)


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
        "fields": cartesian(np.vstack([np.zeros(3), np.eye(3), [[2.0, 3.0, 5.0]]])),
        "rotation": rotation,
        "translation": station,
    }
    (block,) = read_all(scan_files.write_e57(tmp_path / "a.e57", [scan]))
    x, y, z = np.array(axes_world)
    expected = station + np.array([np.zeros(3), x, y, z, 2.0 * x + 3.0 * y + 5.0 * z])
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
    assert opened.intensity_limits == (0.0, 8.0)
    assert opened.rgb_limit == 255.0
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
    assert (block.n_read, block.n_invalid) == (40, 26)


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


# PLY


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_gives_its_vertices(tmp_path: Path, points: NDArray[np.float64], encoding: str) -> None:
    fields = {
        "x": points[:, 0],
        "y": points[:, 1],
        "z": points[:, 2].astype(np.float32),
        "nx": np.zeros(40, np.float32),
        "red": np.arange(40, dtype=np.uint8),
        "green": np.arange(40, dtype=np.uint8) + np.uint8(1),
        "blue": np.arange(40, dtype=np.uint8) + np.uint8(2),
        "scalar_Intensity": np.arange(40, dtype=np.float32),
    }
    scan = open_scan(scan_files.write_ply(tmp_path / "a.ply", fields, encoding=encoding))
    (block,) = scan.read()
    np.testing.assert_allclose(block.points[:, :2], points[:, :2], atol=0)
    np.testing.assert_allclose(block.points[:, 2], points[:, 2], atol=1e-6)
    np.testing.assert_array_equal(block.rgb[:, 2], np.arange(40) + 2)  # type: ignore[index]
    np.testing.assert_array_equal(block.intensity, np.arange(40))
    assert scan.rgb_limit == 255.0
    assert scan.fields == {"intensity", "rgb"}


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_elements_before_the_vertices_are_skipped(
    tmp_path: Path, points: NDArray[np.float64], encoding: str
) -> None:
    fields = dict(zip("xyz", points.T, strict=True))
    before = "element strip 2\nproperty list uchar short items\nproperty uchar kind"
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
    data = b"2 5 6 1\n0 2\n"
    if order:
        items = np.array([5, 6], dtype=order + "i2").tobytes()
        data = b"\x02" + items + b"\x01" + b"\x00" + b"\x02"
    path = scan_files.write_ply(
        tmp_path / "a.ply", fields, encoding=encoding, before=before, before_data=data
    )
    np.testing.assert_array_equal(read_points(path), points)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_a_ply_file_that_is_cut_off_is_refused(
    tmp_path: Path, points: NDArray[np.float64], encoding: str
) -> None:
    fields = dict(zip("xyz", points.T, strict=True))
    path = scan_files.write_ply(tmp_path / "a.ply", fields, encoding=encoding)
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(
        InputError, match=r"a\.ply is cut off: its vertex element holds \d+ points, .* 40;"
    ):
        read_all(path)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("ply\nformat ascii 1.0\n", "no end_header"),
        ("ply\nelement vertex 3\nend_header\n", "it has no line that names the format"),
        ("ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "no PLY header"),
        ("ply\nformat ascii 1.0\nelement vertex 3\nend_header\n", "no element vertex with single"),
        (
            EMPTY_PLY,
            "a.ply holds no points",
        ),
    ],
    ids=["no-end", "no-format", "no-count", "no-coordinates", "no-points"],
)
def test_ply_headers_that_make_no_sense_are_refused(
    tmp_path: Path, header: str, message: str
) -> None:
    path = tmp_path / "a.ply"
    path.write_text(header)
    with pytest.raises(InputError, match=message):
        open_scan(path)


# PCD


def pcd_fields(points: NDArray[np.float64]) -> dict[str, NDArray[np.generic]]:
    colours = np.arange(40, dtype=np.uint32)
    packed = (colours << 16) | (colours + 1 << 8) | (colours + 2)
    return {
        "x": points[:, 0].astype(np.float32),
        "y": points[:, 1].astype(np.float32),
        "z": points[:, 2].astype(np.float32),
        "rgb": packed.view(np.float32),
        "intensity": np.repeat(np.arange(10, dtype=np.float32), 4),
    }


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_pcd_gives_its_points(tmp_path: Path, points: NDArray[np.float64], data: str) -> None:
    fields = pcd_fields(points)
    path = scan_files.write_pcd(tmp_path / "a.pcd", fields, data=data, width=8)
    (block,) = read_all(path)
    expected = np.column_stack([fields["x"], fields["y"], fields["z"]])
    np.testing.assert_array_equal(block.points, expected.astype(np.float64))
    index = np.arange(40)
    np.testing.assert_array_equal(block.rgb, np.column_stack([index, index + 1, index + 2]))
    np.testing.assert_array_equal(block.intensity, fields["intensity"])
    np.testing.assert_array_equal(block.row, index // 8)
    np.testing.assert_array_equal(block.column, index % 8)


def test_pcd_colours_may_be_integers_and_the_sensor_may_stand_somewhere(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    fields = pcd_fields(points)
    fields["rgb"] = fields["rgb"].view(np.uint32)
    path = scan_files.write_pcd(tmp_path / "a.pcd", fields, data="ascii", viewpoint="1 2 3 1 0 0 0")
    (block,) = read_all(path)
    assert block.rgb is not None
    np.testing.assert_array_equal(block.rgb[:, 0], np.arange(40))
    np.testing.assert_array_equal(block.station, [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("ascii", r"a\.pcd is cut off"),
        ("binary", r"a\.pcd is cut off"),
        ("binary_compressed", r"a\.pcd is cut off: its compressed data holds \d+ bytes"),
    ],
)
def test_a_pcd_file_that_is_cut_off_is_refused(
    tmp_path: Path, points: NDArray[np.float64], data: str, message: str
) -> None:
    path = scan_files.write_pcd(tmp_path / "a.pcd", pcd_fields(points), data=data)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=message):
        read_all(path)


def test_a_damaged_compressed_pcd_file_is_refused(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    path = scan_files.write_pcd(tmp_path / "a.pcd", pcd_fields(points), data="binary_compressed")
    content = bytearray(path.read_bytes())
    content[content.index(b"binary_compressed\n") + 18 + 8] = 0xFF
    path.write_bytes(bytes(content))
    with pytest.raises(InputError, match=r"a\.pcd cannot be unpacked: 40 points need 800 bytes"):
        read_all(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"FIELDS", b"FIELDZ", "without FIELDS"),
        (b"DATA binary", b"DATA zipped", "data are zipped, expected ascii"),
        (b"FIELDS x y", b"FIELDS u v", "its fields are u v z rgb intensity, expected x, y and z"),
    ],
)
def test_pcd_headers_that_make_no_sense_are_refused(
    tmp_path: Path, points: NDArray[np.float64], old: bytes, new: bytes, message: str
) -> None:
    path = scan_files.write_pcd(tmp_path / "a.pcd", pcd_fields(points))
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        open_scan(path)


@pytest.mark.parametrize("seed", range(4))
def test_lzf_gives_back_what_was_packed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plain = rng.integers(0, 2 + 60 * seed, 5000).astype(np.uint8)
    packed = np.frombuffer(scan_files.compress_lzf(plain.tobytes()), np.uint8)
    unpacked = np.zeros(5000, np.uint8)
    assert decompress_lzf(packed, unpacked) == 5000
    np.testing.assert_array_equal(unpacked, plain)


# Nothing checks indices in compiled code: each case is tried in arrays that go on behind their end.
GUARD = 0xAA


def unpack(packed: list[int], n_plain: int) -> tuple[int, list[int]]:
    """Unpack into so many bytes; gives what was said and written, and asserts nothing was beyond.

    Behind the packed bytes lie more that could be read.
    """
    source = np.array([*packed, 0, 7, 7, 7, 7], np.uint8)[: len(packed)]
    memory = np.full(n_plain + 300, GUARD, np.uint8)
    said = decompress_lzf(source, memory[:n_plain])
    assert (memory[n_plain:] == GUARD).all()
    return int(said), memory[:n_plain].tolist()


@pytest.mark.parametrize("count", [1, 2, 31, 32])
def test_lzf_literals_fit_exactly_or_not_at_all(count: int) -> None:
    literals = list(range(1, count + 1))
    packed = [count - 1, *literals]
    assert unpack(packed, count) == (count, literals)
    assert unpack(packed, count + 1) == (count, [*literals, GUARD])
    assert unpack(packed, count - 1)[0] == -1
    assert unpack(packed[:-1], count)[0] == -1


@pytest.mark.parametrize("length", [3, 8, 9, 10, 263, 264])
def test_lzf_back_references_fit_exactly_or_not_at_all(length: int) -> None:
    # Three literals, then a reference to the first of them; from nine bytes on the length takes a
    # byte of its own.
    long = [7 << 5, length - 9, 2] if length >= 9 else [(length - 2) << 5, 2]
    packed = [2, 11, 12, 13, *long]
    repeated = [11, 12, 13] * 90
    whole = repeated[: 3 + length]
    assert unpack(packed, 3 + length) == (3 + length, whole)
    assert unpack(packed, 4 + length) == (3 + length, [*whole, GUARD])
    assert unpack(packed, 2 + length)[0] == -1
    for n_missing in range(1, len(long)):
        assert unpack(packed[:-n_missing], 3 + length)[0] == -1


@pytest.mark.parametrize("distance", [1, 2, 256, 257, 8191, 8192])
def test_lzf_back_references_reach_the_first_byte_and_none_before(distance: int) -> None:
    literals = [1 + k % 150 for k in range(distance)]
    packed: list[int] = []
    for start in range(0, distance, 32):
        part = literals[start : start + 32]
        packed += [len(part) - 1, *part]
    reference = [(1 << 5) | ((distance - 1) >> 8), (distance - 1) & 255]
    whole = (literals * 4)[: distance + 3]
    assert unpack(packed + reference, distance + 3) == (distance + 3, whole)
    # One literal less: the same reference points before the first byte.
    shorter = [*packed[: -(len(part) + 1)], *([len(part) - 2, *part[1:]] if len(part) > 1 else [])]
    assert unpack(shorter + reference, distance + 2)[0] == -1


def test_lzf_data_without_anything_give_nothing() -> None:
    assert unpack([], 0) == (0, [])
    assert unpack([], 2) == (0, [GUARD, GUARD])
    assert unpack([0], 2)[0] == -1


@pytest.mark.parametrize("seed", range(4))
def test_damaged_lzf_data_never_leave_their_array(seed: int) -> None:
    packed = np.random.default_rng(seed).integers(0, 256, 300).astype(np.uint8)
    assert decompress_lzf(packed, np.zeros(64, np.uint8)) == -1


# PTX


def test_ptx_scans_are_placed_and_their_grid_is_known(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    table = np.column_stack([points, np.linspace(0, 1, 40), np.tile([10, 20, 30], (40, 1))])
    table[5, :3] = 0.0
    matrix = np.eye(4)
    matrix[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    matrix[:3, 3] = [634512.347, 486215.781, 112.193]
    path = scan_files.write_ptx(tmp_path / "a.ptx", [(table, 8, np.eye(4)), (table, 5, matrix)])
    scan = open_scan(path)
    first, second = scan.read()
    seen = np.arange(40) != 5
    np.testing.assert_allclose(first.points, points[seen], atol=1e-9)
    turned = np.column_stack([-points[:, 1], points[:, 0], points[:, 2]])[seen]
    np.testing.assert_allclose(second.points, turned + matrix[:3, 3], atol=1e-9)
    np.testing.assert_array_equal(second.station, matrix[:3, 3])
    np.testing.assert_array_equal(first.row, (np.arange(40) % 8)[seen])
    np.testing.assert_array_equal(first.column, (np.arange(40) // 8)[seen])
    np.testing.assert_array_equal(second.row, (np.arange(40) % 5)[seen])
    assert (first.n_read, first.n_invalid) == (40, 1)
    assert scan.fields == {"intensity", "rgb", "grid"}


@pytest.mark.parametrize(
    ("cut", "message"),
    [
        (-20, r"a\.ptx is cut off: its scan 0 holds \d+ points, its header states 40"),
        (30, r"a\.ptx, line 1: expected the ten header lines of a PTX scan"),
    ],
    ids=["points", "header"],
)
def test_a_ptx_file_that_is_cut_off_is_refused(
    tmp_path: Path, points: NDArray[np.float64], cut: int, message: str
) -> None:
    path = scan_files.write_ptx(tmp_path / "a.ptx", [(points, 8, np.eye(4))])
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-3] if cut < 0 else lines[:5]))
    with pytest.raises(InputError, match=message):
        read_all(path)


def test_a_ptx_line_with_an_odd_number_of_columns_is_refused(tmp_path: Path) -> None:
    table = np.ones((4, 5))
    path = scan_files.write_ptx(tmp_path / "a.ptx", [(table, 2, np.eye(4))])
    with pytest.raises(InputError, match=r"a\.ptx, line 11: expected x y z, with intensity"):
        open_scan(path)


# Text


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("1 2 3\n4 5 6\n", [[1, 2, 3], [4, 5, 6]]),
        ("  1   2\t3 \r\n 4 5 6", [[1, 2, 3], [4, 5, 6]]),
        ("1,2,3\n4, 5, 6\n", [[1, 2, 3], [4, 5, 6]]),
        ("1;2;3;\n4;5;6;\n", [[1, 2, 3], [4, 5, 6]]),
        ("1,5;2,25;3\n4;5;6\n", [[1.5, 2.25, 3], [4, 5, 6]]),
        ("1,5 2,25 3,0\n4 5 6\n", [[1.5, 2.25, 3], [4, 5, 6]]),
        ("1\t2\t3\n4\t5\t6\n", [[1, 2, 3], [4, 5, 6]]),
        ("# made by hand\n//X Y Z\n1 2 3\n# in between\n4 5 6\n", [[1, 2, 3], [4, 5, 6]]),
        ("z,y,x\n3,2,1\n6,5,4\n", [[1, 2, 3], [4, 5, 6]]),
        ('"Easting" "Northing" "Elevation"\n1 2 3\n4 5 6\n', [[1, 2, 3], [4, 5, 6]]),
        ("2\n1 2 3\n4 5 6\n", [[1, 2, 3], [4, 5, 6]]),
        ("\ufeff1 2 3\n\n4 5 6\n\n", [[1, 2, 3], [4, 5, 6]]),
        ("1e0 -2.5E+1 .5\n4 5 6\n", [[1, -25, 0.5], [4, 5, 6]]),
    ],
    ids=[
        "spaces",
        "blanks-crlf",
        "commas",
        "semicolons",
        "decimal-commas-semicolons",
        "decimal-commas-spaces",
        "tabs",
        "comments",
        "header-order",
        "header-words",
        "count",
        "bom-blank-lines",
        "exponents",
    ],
)
def test_text_is_read_however_its_numbers_are_separated(
    tmp_path: Path, content: str, expected: list[list[float]]
) -> None:
    path = tmp_path / "a.xyz"
    path.write_text(content, encoding="utf-8")
    np.testing.assert_array_equal(read_points(path), expected)


@pytest.mark.parametrize(
    ("name", "content", "rgb", "intensity"),
    [
        ("a.txt", "//X Y Z R G B Intensity\n1 2 3 10 20 30 2232.0\n", [10, 20, 30], 2232),
        ("a.csv", "x,y,z,i,red,green,blue\n1,2,3,7,10,20,30\n", [10, 20, 30], 7),
        ("a.xyz", "1 2 3 0.25\n", None, 0.25),
        ("a.xyz", "1 2 3 10 20 30\n", [10, 20, 30], None),
        ("a.xyz", "1 2 3 10 20 30 2232\n", [10, 20, 30], 2232),
        ("a.xyz", "1 2 3 -1200 10 20 30\n", [10, 20, 30], -1200),
        ("a.pts", "1\n1 2 3 -1200 10 20 30\n", [10, 20, 30], -1200),
        ("a.pts", "1\n1 2 3 120 10 20 30\n", [10, 20, 30], 120),
    ],
)
def test_text_columns_are_told_by_header_or_by_number(
    tmp_path: Path, name: str, content: str, rgb: list[int] | None, intensity: float | None
) -> None:
    path = tmp_path / name
    path.write_text(content)
    (block,) = read_all(path)
    np.testing.assert_array_equal(block.points, [[1, 2, 3]])
    assert (None if block.rgb is None else block.rgb.tolist()[0]) == rgb
    assert (None if block.intensity is None else float(block.intensity[0])) == intensity


@pytest.mark.parametrize("content", ["1 2 3 10 20 30 40\n", "1 2 3 4 5\n", "1 2 3 4 5 6 7 8\n"])
def test_text_columns_that_can_mean_several_things_are_asked_for(
    tmp_path: Path, content: str
) -> None:
    path = tmp_path / "a.txt"
    path.write_text(content)
    with pytest.raises(
        InputError, match=r"a\.txt has \d columns and no header .* parameter columns"
    ):
        open_scan(path)


def test_the_user_can_say_what_the_columns_are(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("wall 9 3 2 1 50 60 70\nwall 9 6 5 4 51 61 71\n".replace("wall", "0"))
    (block,) = read_all(path, columns_of_text("_ _ z y x b g r"))
    np.testing.assert_array_equal(block.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(block.rgb, [[70, 60, 50], [71, 61, 51]])


@pytest.mark.parametrize("text", ["x y", "x y z z", "x y z depth", ""])
def test_columns_that_make_no_sense_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="columns must name x, y and z once each"):
        columns_of_text(text)


def test_more_columns_named_than_there_are_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("1 2 3\n")
    with pytest.raises(InputError, match=r"a\.txt has 3 columns, but columns names 4: x y z r"):
        open_scan(path, columns_of_text("x y z r"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1 2 3\n4 5 6\n7 eight 9\n", r"a\.xyz, line 3: expected 3 numbers .* got '7 eight 9'"),
        ("1 2 3\n4 5 6 7 8\n", r"a\.xyz, line 2: expected 3 numbers"),
        ("# only\n# comments\n", r"no line that begins with three numbers among its first 2"),
        ("5\n1 2 3\n4 5 6\n", r"a\.xyz is cut off: its list holds 2 points, its header states 5"),
    ],
    ids=["word", "too-many", "no-data", "short-list"],
)
def test_text_that_is_wrong_is_refused_with_its_line(
    tmp_path: Path, content: str, message: str
) -> None:
    path = tmp_path / "a.xyz"
    path.write_text(content)
    with pytest.raises(InputError, match=message):
        read_all(path)


def test_binary_data_named_as_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.xyz"
    path.write_bytes(b"1 2 3\n\0\1\2")
    with pytest.raises(InputError, match=r"a\.xyz is named as a text file but holds binary data"):
        open_scan(path)
    path.write_bytes("1 2 3\n".encode("utf-16"))
    with pytest.raises(InputError, match=r"a\.xyz is UTF-16 text"):
        open_scan(path)


def test_text_blocks_join_without_a_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from orthoflow.files.points import text

    monkeypatch.setattr(text, "BLOCK_POINTS", 7)
    table = np.arange(90).reshape(30, 3)
    path = tmp_path / "a.xyz"
    np.savetxt(path, table, fmt="%d", header="x y z")
    blocks = read_all(path)
    assert [len(block.points) for block in blocks] == [7, 7, 7, 7, 2]
    np.testing.assert_array_equal(np.concatenate([block.points for block in blocks]), table)


# Formats


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "room.e57",
            "this is text\n",
            "room.e57 is named as E57 but does not begin with 'ASTM-E57'",
        ),
        (
            "room.laz",
            "this is text\n",
            "room.laz is named as LAS/LAZ but does not begin with 'LASF'",
        ),
        ("room.ply", "this is text\n", "room.ply is named as PLY but does not begin with 'ply'"),
        ("room.pcd", "this is text\n", "room.pcd is named as PCD but does not begin with"),
        ("room.rcp", "this is text\n", "room.rcp is no point file .* one of .e57 .las .laz"),
        ("room.e57", "", "room.e57 is empty"),
        ("room.xyz", "", "room.xyz is empty"),
        ("room.ptx", "this is text\n", "room.ptx, line 1: expected the ten header lines"),
        ("room.e57", "ASTM-E57 and then nothing", "room.e57 cannot be read as E57"),
        ("room.laz", "LASF and then nothing", "room.laz cannot be read as LAS/LAZ"),
    ],
)
def test_a_file_that_is_not_what_it_is_called_is_refused(
    tmp_path: Path, name: str, content: str, message: str
) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        read_all(path)
    assert "\n" not in str(caught.value)


def test_content_decides_where_it_is_certain(tmp_path: Path, points: NDArray[np.float64]) -> None:
    path = scan_files.write_las(tmp_path / "a.laz", points)
    renamed = path.rename(tmp_path / "scan.dat")
    assert open_scan(renamed).format_name == "LAS/LAZ"


def test_a_folder_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must be a point file, but there is a folder"):
        open_scan(tmp_path)
    with pytest.raises(InputError, match=r"none\.las must be a point file, but there is nothing"):
        open_scan(tmp_path / "none.las")


def test_a_header_that_states_more_points_than_can_be_read_is_refused(
    tmp_path: Path, points: NDArray[np.float64], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(blocks_module, "MOST_POINTS", 40)
    path = scan_files.write_las(tmp_path / "a.laz", points)
    with pytest.raises(InputError, match=r"a\.laz states 40 points, at most 39 can be read"):
        open_scan(path)


# The fence around libraries


class Panic(BaseException):
    """As pyo3 raises for a panic in Rust: no Exception."""


@pytest.mark.parametrize(
    "error", [Panic("index 5"), MemoryError(), RuntimeError("a\nb"), OSError()]
)
def test_whatever_a_library_throws_becomes_one_sentence(error: BaseException) -> None:
    wanted = r"a\.laz cannot be read as LAZ: "
    with pytest.raises(InputError, match=wanted) as caught, reading(Path("a.laz"), "LAZ"):
        raise error
    assert "\n" not in str(caught.value)
    assert caught.value.__cause__ is error


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(3), OrthoflowError("own")])
def test_interrupts_and_own_errors_pass_the_fence(error: BaseException) -> None:
    with pytest.raises(type(error)), reading(Path("a.laz"), "LAZ"):
        raise error


def test_errors_between_items_pass_the_fence_too() -> None:
    def items() -> object:
        yield 1
        raise Panic("index 5")

    found = guarded(items(), Path("a.laz"), "LAZ")  # type: ignore[arg-type]
    assert next(found) == 1
    with pytest.raises(InputError, match="index 5"):
        next(found)


def test_a_missing_library_is_named() -> None:
    with pytest.raises(PluginError, match=r"a\.foo needs the library no_such_reader"):
        load_library("no_such_reader", Path("a.foo"))
