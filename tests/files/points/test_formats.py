"""Every format's own layouts, and one sentence for each file that cannot be read.

That what libraries write comes out stands in test_contract, damaged LAZ and COPC files in test_las.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orthoflow.errors import InputError, OrthoflowError, PluginError
from orthoflow.files.points import ScanFile, open_scan
from orthoflow.files.points import e57 as e57_reader
from orthoflow.files.points.fields import columns_of_user
from orthoflow.files.points.lzf_kernels import decompress_lzf
from orthoflow.files.points.scan_file import load_library, reading
from tests import scan_files
from tests.fuzz.mutation import e57_of
from tests.scan_files import read_all, read_points

POINTS = np.round(np.random.default_rng(3).uniform(-5.0, 5.0, (40, 3)), 4)
Make = Callable[[Path], Path]


def text(name: str, content: str | bytes) -> Make:
    """A file of this name and content."""

    def make(folder: Path) -> Path:
        data = content if isinstance(content, bytes) else content.encode()
        (folder / name).write_bytes(data)
        return folder / name

    return make


def changed(make: Make, old: bytes, new: bytes) -> Make:
    """A file with some of its bytes replaced."""

    def change(folder: Path) -> Path:
        path = make(folder)
        path.write_bytes(path.read_bytes().replace(old, new, 1))
        return path

    return change


def pcd(folder: Path, **options: Any) -> Path:
    fields = dict(zip("xyz", POINTS.T.astype(np.float32), strict=True))
    colours = np.arange(40, dtype=np.uint32)
    packed = (colours << 16) | (colours + 1 << 8) | (colours + 2)
    fields["rgb"] = packed.view(np.float32)
    fields["intensity"] = np.repeat(np.arange(10, dtype=np.float32), 4)
    return scan_files.write_pcd(folder / "a.pcd", fields, **options)


def damaged_pcd(folder: Path) -> Path:
    path = pcd(folder, data="binary_compressed")
    content = bytearray(path.read_bytes())
    content[content.index(b"binary_compressed\n") + 18 + 8] = 0xFF
    path.write_bytes(bytes(content))
    return path


def ptx(folder: Path, *, line: int = 0, change: str = "") -> Path:
    """Three scans of fifty lines each, one of them changed; or the first lines of them."""
    path = scan_files.write_ptx(folder / "a.ptx", [(POINTS, 8, np.eye(4))] * 3)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[: line - 1], change, *lines[line:], ""] if line else lines))
    return path


def e57(folder: Path, *fields: dict[str, Any], **more: object) -> Path:
    return scan_files.write_e57(folder / "a.e57", [{"fields": one, **more} for one in fields])


def flipped_e57(folder: Path) -> Path:
    path = e57(folder, scan_files.cartesian(POINTS))
    content = bytearray(path.read_bytes())
    content[200] ^= 1
    path.write_bytes(bytes(content))
    return path


PCD = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 3\nPOINTS 3\nDATA ascii\n"
PLY = "ply\nformat ascii 1.0\n"
EMPTY = "".join(f"property float {axis}\n" for axis in "xyz")
REFUSED: list[tuple[Make, str]] = [
    # Not what they are called.
    (text("a.e57", "this is text"), "suffix of E57 files but does not begin with 'ASTM-E57'"),
    (text("a.laz", "this is text"), "has the suffix of LAS/LAZ files but does not begin with"),
    (text("a.ply", "this is text"), "has the suffix of PLY files but does not begin with 'ply'"),
    (text("a.pcd", "this is text"), "a.pcd has no readable PCD header"),
    (text("a.rcp", "this is text"), "a.rcp is not a point file .* one of .e57 .las .laz"),
    (text("a.xyz", ""), "a.xyz is empty"),
    (text("a.e57", "ASTM-E57 and then nothing"), "a.e57 cannot be read as E57"),
    (text("a.laz", "LASF and then nothing"), "a.laz cannot be read as LAS/LAZ"),
    (lambda folder: folder, "must be a point file, but there is a folder"),
    (lambda folder: folder / "a.las", "a.las must be a point file, but there is nothing"),
    (text("a.xyz", b"1 2 3\n\0\1\2"), "has the suffix of a text file but contains binary data"),
    (text("a.xyz", "1 2 3\n".encode("utf-16")), "a.xyz is UTF-16 text"),
    # PLY
    (text("a.ply", PLY), "no end_header"),
    (text("a.ply", "ply\nelement vertex 3\nend_header\n"), "it has no format line"),
    (text("a.ply", f"{PLY}element vertex many\nend_header\n"), "no readable PLY header"),
    (text("a.ply", f"{PLY}element vertex 3\nend_header\n"), "vertex with the scalar properties"),
    (text("a.ply", f"{PLY}element vertex 0\n{EMPTY}end_header\n"), "a.ply contains no points"),
    # PCD
    (changed(pcd, b"FIELDS", b"FIELDZ"), "it lacks FIELDS"),
    (changed(pcd, b"DATA binary", b"DATA zipped"), "data are zipped; expected ascii"),
    (changed(pcd, b"FIELDS x y", b"FIELDS u v"), "its fields are u v z rgb intensity; expected x"),
    (changed(pcd, b"COUNT 1 1 1", b"COUNT 1 1 0"), "its fields are x y z .*; expected x, y and z"),
    (changed(pcd, b"VIEWPOINT 0 0 0 1 0 0 0", b"VIEWPOINT 1"), "VIEWPOINT has 1 numbers"),
    (text("a.pcd", f"{PCD}1 2 3\r4 5 6\n7 8 9\r1 1 1\n2 2 2\n"), "a.pcd uses only carr"),
    (damaged_pcd, r"a\.pcd cannot be decompressed: 40 points need 800 bytes"),
    # PTX
    (text("a.ptx", "this is text"), "a.ptx, line 1: expected the ten header lines"),
    (text("a.ptx", "5\n8\n0 0 0\n"), "a.ptx, line 1: expected the ten header lines"),
    (lambda folder: scan_files.write_ptx(folder / "a.ptx", [(np.ones((4, 5)), 2, np.eye(4))]),
     r"a\.ptx, line 11: expected x y z, with intensity"),
    (lambda folder: ptx(folder, line=51, change="8 5"), r"a\.ptx, line 57: expected 3 numbers"),
    (lambda folder: ptx(folder, line=70, change="1 2 x"), r"a\.ptx, line 70"),
    (lambda folder: ptx(folder, line=101, change="8 5"), r"a\.ptx, line 107: expected 3 numbers"),
    # Text
    *((text("a.txt", content), r"a\.txt has \d columns and no header .* cloud\.columns") for content
      in ("1 2 3 10 20 30 40\n", "1 2 3 10 20 30 22\n", "1 2 3 4 5\n", "1 2 3 4 5 6 7 8\n")),
    (text("a.xyz", "1 2 3\n4 5 6\n7 eight 9\n"), "a.xyz, line 3: expected 3 .* got '7 eight 9'"),
    (text("a.xyz", "1 2 3\n4 5 6 7 8\n"), r"a\.xyz, line 2: expected 3 numbers"),
    (text("a.xyz", "1 2 3\r4 5 6\r"), r"a\.xyz uses only carriage returns"),
    (text("a.xyz", "# only\n# comments\n"), r"no line with three numbers among its first 2"),
    (text("a.xyz", "5\n1 2 3\n4 5 6\n"), "a.xyz is truncated: its list contains 2 points, .* 5"),
    # E57
    (e57, r"a\.e57 contains no points"),
    (lambda folder: e57(folder, {"intensity": np.arange(3.0)}), "scan 0 has the fields intensity"),
    (flipped_e57, r"a\.e57 cannot be read as E57: .*export it again"),
    (text("a.e57", b"ASTM-E57" + bytes(39)), "the file ends within its header"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "message"), REFUSED, ids=range(len(REFUSED)))
def test_what_cannot_be_read_is_refused_in_one_sentence(
    make: Make, message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_all(make(tmp_path))
    assert "\n" not in str(caught.value)


def test_content_decides_where_it_is_certain(tmp_path: Path) -> None:
    path = scan_files.write_las(tmp_path / "a.laz", POINTS)
    assert open_scan(path.rename(tmp_path / "scan.dat")).format_name == "LAS/LAZ"


def test_points_are_counted_in_four_bytes() -> None:
    def stated(n_most: int) -> ScanFile:
        return ScanFile(name="a", format_name="LAS", n_most=n_most, scans=[], read=lambda: iter(()))

    assert stated(2**32 - 1).n_most == 4_294_967_295
    with pytest.raises(InputError, match="declares 4294967296 points; the limit is 4294967295"):
        stated(2**32)


# Text


@pytest.mark.parametrize(
    "content",
    [
        "  1   2\t3 \r\n 4 5 6",
        "1,2,3\n4, 5, 6\n",
        "1;2;3;\n4;5;6;\n",
        "1,0;2,00;3\n4;5;6\n",
        "1,0 2,00 3,0\n4 5 6\n",
        "1\t2\t3\n4\t5\t6\n",
        "# made by hand\n//X Y Z\n1 2 3\n# in between\n4 5 6\n",
        "z,y,x\n3,2,1\n6,5,4\n",
        '"Easting" "Northing" "Elevation"\n1 2 3\n4 5 6\n',
        "2\n1 2 3\n4 5 6\n",
        "\ufeff1 2 3\n\n4 5 6\n\n",
        "1e0 +.2E+1 3.\n4 5 6\n",
        f"{'9' * 5000}\n1 2 3\n4 5 6\n",
        "\u00b2\n1 2 3\n4 5 6\n",
    ],
    ids=repr,
)
def test_text_is_read_however_its_numbers_are_separated(content: str, tmp_path: Path) -> None:
    found = read_points(text("a.xyz", content)(tmp_path))
    np.testing.assert_array_equal(found, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    ("name", "content", "rgb", "intensity"),
    [
        ("a.txt", "//X Y Z R G B Intensity\n1 2 3 10 20 30 2232.0\n", [10, 20, 30], 2232),
        ("a.xyz", "1 2 3 0.25\n", None, 0.25),
        ("a.xyz", "1 2 3 10 20 30\n", [10, 20, 30], None),
        ("a.xyz", "1 2 3 10 20 30 2232\n", [10, 20, 30], 2232),
        ("a.xyz", "1 2 3 -1200 10 20 30\n", [10, 20, 30], -1200),
        ("a.pts", "1\n1 2 3 120 10 20 30\n", [10, 20, 30], 120),
    ],
)
def test_text_columns_are_known_by_header_or_by_number(
    name: str, content: str, rgb: list[int] | None, intensity: float | None, tmp_path: Path
) -> None:
    (block,) = read_all(text(name, content)(tmp_path))
    np.testing.assert_array_equal(block.points, [[1, 2, 3]])
    for found, right in ((block.rgb, rgb), (block.intensity, intensity)):
        assert (None if found is None else found.tolist()[0]) == right


def test_the_user_can_say_what_the_columns_are(tmp_path: Path) -> None:
    path = text("a.txt", "0 9 3 2 1 50 60 70\n0 9 6 5 4 51 61 71\n")(tmp_path)
    (block,) = read_all(path, columns_of_user("_ _ z y x b g r"))
    np.testing.assert_array_equal(block.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(block.rgb, [[70, 60, 50], [71, 61, 51]])
    for words in ("x y", "x y z z", "x y z depth", ""):
        with pytest.raises(InputError, match="columns must name x, y and z once each"):
            columns_of_user(words)
    short = text("b.txt", "1 2 3\n")(tmp_path)
    with pytest.raises(InputError, match=r"has 3 columns, but cloud\.columns names 4: x y z r"):
        open_scan(short, columns_of_user("x y z r"))


# PLY, PCD and PTX


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_elements_before_the_vertices_are_skipped(encoding: str, tmp_path: Path) -> None:
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
    data = b"2 5 6 1\n0 2\n"
    if order:
        items = np.array([5, 6], dtype=order + "i2").tobytes()
        data = b"\x02" + items + b"\x01" + b"\x00" + b"\x02"
    path = scan_files.write_ply(
        tmp_path / "a.ply",
        dict(zip("xyz", POINTS.T, strict=True)),
        encoding=encoding,
        before="element strip 2\nproperty list uchar short items\nproperty uchar kind",
        before_data=data,
    )
    np.testing.assert_array_equal(read_points(path), POINTS)


def test_pcd_texts_keep_the_digits_that_their_type_has_no_room_for(tmp_path: Path) -> None:
    path = pcd(tmp_path, data="ascii", viewpoint="1 2 3 1 0 0 0")
    first, _, behind = path.read_bytes().partition(b"DATA ascii\n")
    path.write_bytes(first + b"DATA ascii\n500000.01 " + behind.partition(b" ")[2])
    file = open_scan(path)
    (block,) = file.read()
    assert block.points[0, 0] == 500_000.01
    np.testing.assert_array_equal(file.scans[0].station, [1.0, 2.0, 3.0])


def test_a_pcd_grid_has_rows_and_comments_are_no_entries(tmp_path: Path) -> None:
    (block,) = read_all(pcd(tmp_path, width=1))
    np.testing.assert_array_equal(block.row, np.arange(40))
    np.testing.assert_array_equal(block.column, np.zeros(40))
    between = b"\n#\n# WIDTH 7\n#HEIGHT 7\n \nWIDTH"
    (block,) = read_all(changed(pcd, b"WIDTH", between)(tmp_path))
    np.testing.assert_array_equal(block.points, POINTS.astype(np.float32))
    assert block.row is None


def test_pcd_values_of_several_numbers_stand_between_those_of_one(tmp_path: Path) -> None:
    head = (
        "FIELDS x y histogram z\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 3 1\n"
        "WIDTH 2\nHEIGHT 1\nPOINTS 2\n"
    )
    rows = np.arange(12, dtype="<f4").reshape(2, -1)
    lines = "".join(" ".join(map(str, row)) + "\n" for row in rows.tolist())
    for data, content in (("ascii", lines.encode()), ("binary", rows.tobytes())):
        path = text("a.pcd", f"{head}DATA {data}\n".encode() + content)(tmp_path)
        np.testing.assert_array_equal(read_points(path), rows[:, [0, 1, -1]])


def test_lzf_repeats_what_it_refers_to() -> None:
    for reference, plain in (
        # Three bits of length less two, the distance less one; 7 takes a byte more of length.
        (b"\x20\x02", b"abcabc"),
        (b"\xc0\x01", b"abcbcbcbcbc"),
        (b"\xe0\x05\x02", b"abc" + b"abcabcabcabcab"),
        # Before the beginning.
        (b"\x21\x02", None),
    ):
        found = np.zeros(64, np.uint8)
        count = decompress_lzf(np.frombuffer(b"\x02abc" + reference, np.uint8), found)
        assert (found[:count].tobytes() if count >= 0 else None) == plain


# E57

HALF = np.sqrt(0.5)
# Quaternion w, x, y, z and where the axes x, y, z of the scan point to in the world.
POSES = {
    "90 degrees about x": ((HALF, HALF, 0, 0), [(1, 0, 0), (0, 0, 1), (0, -1, 0)]),
    "120 degrees about the diagonal": ((0.5, 0.5, 0.5, 0.5), [(0, 1, 0), (0, 0, 1), (1, 0, 0)]),
    # Cosine 0.28 and sine 0.96; about x, then about y: 3-4-5 halves of the angles, exact.
    "tilted about x, then y": (
        (0.64, 0.48, 0.48, -0.36),
        [(0.28, 0, -0.96), (0.9216, 0.28, 0.2688), (0.2688, -0.96, 0.0784)],
    ),
    "very short": ((8e-170, 6e-170, 0, 0), [(1, 0, 0), (0, 0.28, 0.96), (0, -0.96, 0.28)]),
    "very long": ((8e170, 6e170, 0, 0), [(1, 0, 0), (0, 0.28, 0.96), (0, -0.96, 0.28)]),
    "of no direction": ((0, 0, 0, 0), [(1, 0, 0), (0, 1, 0), (0, 0, 1)]),
}


@pytest.mark.parametrize(("rotation", "axes_world"), POSES.values(), ids=POSES.keys())
def test_a_tilted_e57_scanner_turns_each_axis_where_its_pose_says(
    rotation: tuple[float, ...], axes_world: list[tuple[float, ...]], tmp_path: Path
) -> None:
    station = np.array([4.0, -2.0, 1.0])
    fields = scan_files.cartesian(np.vstack([np.eye(3), [[2.0, 3.0, 5.0]]]))
    (block,) = read_all(e57(tmp_path, fields, rotation=rotation, translation=station))
    x, y, z = np.array(axes_world)
    expected = station + np.array([x, y, z, 2.0 * x + 3.0 * y + 5.0 * z])
    np.testing.assert_allclose(block.points, expected, atol=1e-14)


def test_e57_points_are_cartesian_or_spherical_and_some_have_no_position(tmp_path: Path) -> None:
    state = np.arange(40) % 3
    fields = scan_files.cartesian(POINTS, cartesianInvalidState=state, intensity=np.arange(40.0))
    distance = np.linalg.norm(POINTS, axis=1)
    spherical = {
        "sphericalRange": distance,
        "sphericalAzimuth": np.arctan2(POINTS[:, 1], POINTS[:, 0]),
        "sphericalElevation": np.arcsin(POINTS[:, 2] / distance),
        "sphericalInvalidState": state,
    }
    first, second = read_all(e57(tmp_path, fields, spherical))
    np.testing.assert_allclose(first.points, POINTS[state == 0], atol=1e-6)
    np.testing.assert_array_equal(first.intensity, np.flatnonzero(state == 0))
    assert (first.n_read, first.left_out) == (40, {"invalid": 26})
    np.testing.assert_allclose(second.points, POINTS[state == 0], atol=1e-12)


def vector(n_children: int) -> str:
    return f'<v type="Vector">{"<a/>" * n_children}</v>'


def named(count: int) -> str:
    return "<a>" + "".join(f"<b{k}/>" for k in range(count - 1)) + "</a>"


@pytest.mark.parametrize(
    ("most", "more", "reason"),
    [
        (named(500), named(501), "its elements have more than 500 different names"),
        ("<a>" * 64 + "</a>" * 64, "<a>" * 65 + "</a>" * 65, "it is nested deeper than 64 element"),
        (vector(999), vector(1000), "it has more than 1000 elements"),
        ("<a/>", "<!DOCTYPE a><a/>", "it declares a document type or entities"),
    ],
    ids=["names", "deep", "many", "document type"],
)
def test_the_xml_of_an_e57_file_is_read_up_to_its_limits(
    most: str, more: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(e57_reader, "MOST_XML_ELEMENTS", 1000)
    path = tmp_path / "a.e57"
    path.write_bytes(e57_of(bytes(48), most.encode()))
    e57_reader.check_xml(path)
    path.write_bytes(e57_of(bytes(48), more.encode()))
    refused = f"a.e57 cannot be read as E57 because of its XML: {reason}"
    with pytest.raises(InputError, match=re.escape(refused)):
        e57_reader.check_xml(path)
    content = bytearray(e57_of(bytes(48), b"<a/>"))
    content[32:40] = struct.pack("<Q", (1 << 25) + 1)
    path.write_bytes(content)
    with pytest.raises(InputError, match="the limit is 33554432"):
        e57_reader.check_xml(path)


# Libraries


class Panic(BaseException):
    """As pyo3 raises for a panic in Rust: no Exception."""


@pytest.mark.parametrize("error", [Panic("index 5"), MemoryError(), RuntimeError("a\nb")])
def test_whatever_a_library_throws_becomes_one_sentence(error: BaseException) -> None:
    wanted = r"a\.laz cannot be read as LAZ: "
    with pytest.raises(InputError, match=wanted) as caught, reading(Path("a.laz"), "LAZ"):
        raise error
    assert "\n" not in str(caught.value)
    assert caught.value.__cause__ is error
    # Interrupts and our own errors pass.
    for own in (KeyboardInterrupt(), OrthoflowError("own")):
        with pytest.raises(type(own)), reading(Path("a.laz"), "LAZ"):
            raise own
    with pytest.raises(PluginError, match=r"a\.foo needs the library no_such_reader"):
        load_library("no_such_reader", Path("a.foo"))
