"""Small files of every format: all that is said of the file and of each block of its points."""

from __future__ import annotations

import dataclasses
import importlib
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orthoflow.errors import InputError
from orthoflow.files.points import ScanFile, open_scan
from tests import scan_files

Told = dict[str, Any]
# What a block of plain points says besides these.
PLAIN: Told = {
    "scan": 0,
    "left_out": {},
}
RGB = frozenset({"rgb"})
INTENSITY = frozenset({"intensity"})
GRID = frozenset({"grid"})


def said(item: object, *silent: str) -> Told:
    """All fields of a dataclass that are not None, arrays as lists."""
    found = {field.name: getattr(item, field.name) for field in dataclasses.fields(item)}  # type: ignore[arg-type]
    if isinstance(item, ScanFile):
        scans = found.pop("scans")
        found["fields"] = item.fields
        if len(scans) == 1:
            found |= {key: getattr(scans[0], key) for key in ("intensity_limits", "rgb_limit")}
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in found.items()
        if value is not None and name not in silent
    }


def file(format_name: str, n_most: int, fields: frozenset[str], **more: object) -> Told:
    common = {"format_name": format_name, "n_most": n_most, "fields": fields, "notes": []}
    return {**common, "details": {}, "is_chosen": False, **more}


@pytest.fixture
def by_twos(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let readers give two points a block."""
    for name in ("e57", "las", "pcd", "ply", "ptx", "tables", "text"):
        module = importlib.import_module(f"orthoflow.files.points.{name}")
        monkeypatch.setattr(module, "BLOCK_POINTS", 2)


def block(points: Sequence[Sequence[float]], **more: object) -> Told:
    return {**PLAIN, "points": points, "n_read": len(points), **more}


PTX_HEAD = "{}\n{}\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n{} {} {} 1\n".format
PLY_XYZ = "property float x\nproperty float y\nproperty float z\n"
PLY_AFTER = (
    f"ply\nformat {{}} 1.0\nelement e 1\nproperty {{}}\nelement vertex {{}}\n{PLY_XYZ}end_header\n"
).format
PLY_COLOURS = (
    f"ply{{0}}format ascii 1.0{{0}}element vertex 1{{0}}{PLY_XYZ}property {{1}} red{{0}}"
    "property {2} green{0}property {3} blue{0}end_header{0}"
).format
PCD_XYZ = "FIELDS x y z {}\nSIZE 4 4 4 {}\nTYPE F F F {}\n".format
PCD_PADDED = """# .PCD v0.7
FIELDS x _ y n z _ intensity rgba
SIZE 4 1 4 4 4 1 4 4
TYPE F U F F F U F U
COUNT 1 2 1 3 1 1 1 1
WIDTH 2
HEIGHT 2
VIEWPOINT 0 0 5 1 0 0 0
POINTS 4
DATA ascii
"""

TEXTS: dict[str, tuple[str, str, Told, list[Told]]] = {
    "coordinates": (
        "a.xyz",
        "1 2 3\n4 5 6\n7 8 9",
        file("text", 3, frozenset(), details={"columns": "x y z", "columns_from": "values"}),
        [block([[1, 2, 3], [4, 5, 6]]), block([[7, 8, 9]])],
    ),
    "a header of everything": (
        "a.csv",
        "# by hand\ncol;Row;B;G;R;I;Other;Z[m];Y(m);X\n1;2;30;20;10;0,5;9;3;2;1\n70000;4;31;21;11;0,25;9;6;5;4\n",  # noqa: E501
        file(
            "text",
            2,
            INTENSITY | RGB | GRID,
            details={
                "columns": "column row b g r intensity _ z y x",
                "columns_from": "header",
            },
        ),
        [
            block(
                [[1, 2, 3], [4, 5, 6]],
                intensity=[0.5, 0.25],
                rgb=[[10, 20, 30], [11, 21, 31]],
                row=[2, 4],
                column=[1, 70000],
            )
        ],
    ),
    "half of the colours and of the grid": (
        "a.asc",
        "x y z r g row\n1 2 3 10 20 5\n",
        file(
            "text",
            1,
            frozenset(),
            details={"columns": "x y z r g row", "columns_from": "header"},
        ),
        [block([[1, 2, 3]])],
    ),
    "a name twice": (
        "a.txt",
        "x y z i intensity\n1 2 3 4 5\n",
        file(
            "text",
            1,
            INTENSITY,
            details={"columns": "x y z intensity _", "columns_from": "header"},
        ),
        [block([[1, 2, 3]], intensity=[4])],
    ),
    "a count, intensity and colours": (
        "a.PTS",
        "3\n1 2 3 5 0 128 255\n4 5 6 7 1 2 3\n1 1 1 1 1 1 1\n",
        file(
            "text",
            3,
            INTENSITY | RGB,
            details={"columns": "x y z intensity r g b", "columns_from": "values"},
        ),
        [
            block([[1, 2, 3], [4, 5, 6]], intensity=[5, 7], rgb=[[0, 128, 255], [1, 2, 3]]),
            block([[1, 1, 1]], intensity=[1], rgb=[[1, 1, 1]]),
        ],
    ),
    "ptx of coordinates": (
        "a.ptx",
        PTX_HEAD(2, 2, 10, 20, 30) + "1 2 3\n0 0 0\n4 5 6\n0 0 7\n",
        file("PTX", 4, GRID),
        [
            block([[8, 21, 33]], n_read=2, left_out={"no_return": 1}, row=[0], column=[0]),
            block([[5, 24, 36], [10, 20, 37]], row=[0, 1], column=[1, 1]),
        ],
    ),
    "ptx with intensity": (
        "a.ptx",
        PTX_HEAD(1, 1, 0, 0, 0) + "1 2 3 0.5\n" + PTX_HEAD(1, 3, 1, 2, 3)
        + "1 2 3 0.25\n0 1 0 1\n1 0 0 0\n\n",
        file("PTX", 4, INTENSITY | GRID),
        [
            block([[-2, 1, 3]], intensity=[0.5], row=[0], column=[0]),
            block(
                [[-1, 3, 6], [0, 2, 3]],
                scan=1,
                intensity=[0.25, 1],
                row=[0, 1],
                column=[0, 0],
            ),
            block([[1, 3, 3]], scan=1, intensity=[0], row=[2], column=[0]),
        ],
    ),
    "ptx with colours": (
        "a.ptx",
        PTX_HEAD(1, 1, 0, 0, 0) + "1 2 3 10 20 30\n",
        file("PTX", 1, RGB | GRID, rgb_limit=255.0),
        [block([[-2, 1, 3]], rgb=[[10, 20, 30]], row=[0], column=[0])],
    ),
    "ply without colours": (
        "a.ply",
        f"ply\nformat ascii 1.0\n\nelement vertex 3\n{PLY_XYZ}end_header\n1 2 3\n4 5 6\n7 8 9\n",
        file("PLY", 3, frozenset(), details={"encoding": "ascii"}),
        [block([[1, 2, 3], [4, 5, 6]]), block([[7, 8, 9]])],
    ),
    "ply with colours of 16 bits": (
        "a.ply",
        PLY_COLOURS("\r\n", "ushort", "uint16", "ushort") + "1 2 3 65535 7 8\n",
        file("PLY", 1, RGB, details={"encoding": "ascii"}),
        [block([[1, 2, 3]], rgb=[[65535, 7, 8]])],
    ),
    "ply with colours of two types": (
        "a.ply",
        PLY_COLOURS("\n", "uchar", "float", "uchar") + "1 2 3 4 0.5 6\n",
        file("PLY", 1, RGB, details={"encoding": "ascii"}),
        [block([[1, 2, 3]], rgb=[[4, 0.5, 6]])],
    ),
    "pcd of the least": (
        "a.pcd",
        PCD_XYZ("", "", "") + "WIDTH 3\nHEIGHT 1\nDATA ascii\n1 2 3\n4 5 6\n7 8 9\n",
        file("PCD", 3, frozenset(), details={"encoding": "ascii"}),
        [block([[1, 2, 3], [4, 5, 6]]), block([[7, 8, 9]])],
    ),
    "pcd with padding, a normal and a grid": (
        "a.pcd",
        PCD_PADDED
        + "".join(f"{k} 0 0 {k + 1} 0 0 1 {k + 2} 0 0.5 {65536 + 512 + k}\n" for k in range(4)),
        file("PCD", 4, INTENSITY | RGB | GRID, rgb_limit=255.0, details={"encoding": "ascii"}),
        [
            block(
                [[0, 1, 2], [1, 2, 3]],
                intensity=[0.5, 0.5],
                rgb=[[1, 2, 0], [1, 2, 1]],
                row=[0, 0],
                column=[0, 1],
            ),
            block(
                [[2, 3, 4], [3, 4, 5]],
                intensity=[0.5, 0.5],
                rgb=[[1, 2, 2], [1, 2, 3]],
                row=[1, 1],
                column=[0, 1],
            ),
        ],
    ),
}  # fmt: skip


@pytest.mark.usefixtures("by_twos")
@pytest.mark.parametrize(("name", "content", "whole", "blocks"), TEXTS.values(), ids=TEXTS)
def test_all_that_a_text_file_holds_comes_out(
    tmp_path: Path, name: str, content: str, whole: Told, blocks: list[Told]
) -> None:
    path = tmp_path / name
    path.write_bytes(content.encode())
    scan = open_scan(path)
    assert said(scan, "read") == {"name": name, **whole}
    assert [said(block) for block in scan.read()] == blocks


PADDED = "FIELDS x _ y n z _ rgb\nSIZE 4 1 4 4 4 1 4\nTYPE F U F F F U F\nCOUNT 1 2 1 3 1 1 1\n"


@pytest.mark.usefixtures("by_twos")
@pytest.mark.parametrize("data", ["binary", "binary_compressed"])
def test_padding_of_a_binary_pcd_file_is_passed_over(tmp_path: Path, data: str) -> None:
    rows = [(k, 9, 9, k + 1, 0.0, 0.0, 1.0, k + 2, 9, 65536 + 512 + k) for k in range(3)]
    if data == "binary":
        content = b"".join(struct.pack("<fBBfffffBI", *row) for row in rows)
    else:
        columns = list(zip(*rows, strict=True))
        plain = np.array(columns[0], "<f4").tobytes()
        plain += np.column_stack(columns[1:3]).astype(np.uint8).tobytes()
        plain += np.array(columns[3], "<f4").tobytes()
        plain += np.column_stack(columns[4:7]).astype("<f4").tobytes()
        plain += np.array(columns[7], "<f4").tobytes()
        plain += np.array(columns[8], np.uint8).tobytes()
        plain += np.array(columns[9], "<u4").tobytes()
        packed = scan_files.compress_lzf(plain)
        content = struct.pack("<II", len(packed), len(plain)) + packed
    path = tmp_path / "a.pcd"
    head = f"{PADDED}WIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA {data}\n"
    path.write_bytes(head.encode() + content)
    scan = open_scan(path)
    whole = file("PCD", 3, RGB, rgb_limit=255.0, details={"encoding": data})
    assert said(scan, "read") == {"name": "a.pcd", **whole}
    assert [said(block) for block in scan.read()] == [
        block([[0, 1, 2], [1, 2, 3]], rgb=[[1, 2, 0], [1, 2, 1]]),
        block([[2, 3, 4]], rgb=[[1, 2, 2]]),
    ]


@pytest.mark.usefixtures("by_twos")
@pytest.mark.parametrize("order", ["little", "big"])
def test_ply_elements_of_one_size_are_passed_over(tmp_path: Path, order: str) -> None:
    path = tmp_path / "a.ply"
    head = (
        f"ply\nformat binary_{order}_endian 1.0\nelement sensor 2\nproperty double time\n"
        f"property char kind\nelement vertex 3\n{PLY_XYZ}end_header\n"
    )
    mark = "<" if order == "little" else ">"
    numbers = np.arange(9, dtype=f"{mark}f4").tobytes()
    path.write_bytes(head.encode() + bytes(18) + numbers)
    scan = open_scan(path)
    assert said(scan, "read") == {
        "name": "a.ply",
        **file("PLY", 3, frozenset(), details={"encoding": "binary"}),
    }
    assert [said(block) for block in scan.read()] == [
        block([[0, 1, 2], [3, 4, 5]]),
        block([[6, 7, 8]]),
    ]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (bytes(18) + bytes(35), "its vertex element holds 2 points, its header states 3;"),
        (bytes(11), "its vertex element holds 0 points, its header states 3;"),
    ],
    ids=["vertices", "before"],
)
def test_a_binary_ply_file_that_is_cut_off_tells_how_many_are_there(
    tmp_path: Path, content: bytes, message: str
) -> None:
    path = tmp_path / "a.ply"
    head = (
        "ply\nformat binary_little_endian 1.0\nelement sensor 2\nproperty double time\n"
        f"property char kind\nelement vertex 3\n{PLY_XYZ}end_header\n"
    )
    path.write_bytes(head.encode() + content)
    with pytest.raises(InputError, match=rf"^a\.ply is cut off: {message} copy or export it"):
        scan_files.read_all(path)


def test_a_ply_list_that_is_cut_off_is_said(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    head = (
        "ply\nformat binary_big_endian 1.0\nelement strip 2\nproperty list uint short items\n"
        f"element vertex 3\n{PLY_XYZ}end_header\n"
    )
    path.write_bytes(head.encode() + struct.pack(">IhhH", 2, 5, 6, 7))
    with pytest.raises(InputError, match="its element strip holds fewer entries, its header stat"):
        scan_files.read_all(path)


# --- lines of mistakes ---


@pytest.mark.usefixtures("by_twos")
@pytest.mark.parametrize(
    ("name", "head"),
    [
        ("a.xyz", "x y z\n"),
        ("a.ply", f"ply\nformat ascii 1.0\nelement vertex 4\n{PLY_XYZ}end_header\n"),
        ("a.ply", PLY_AFTER("ascii", "int i", 4) + "1\n"),
        ("a.pcd", PCD_XYZ("", "", "") + "WIDTH 4\nHEIGHT 1\nDATA ascii\n"),
        ("a.ptx", PTX_HEAD(1, 4, 0, 0, 0)),
        ("a.ptx", PTX_HEAD(1, 2, 0, 0, 0) + "1 2 3\n4 5 6\n" + PTX_HEAD(2, 2, 0, 0, 0)),
    ],
    ids=["text", "ply", "ply with an element before", "pcd", "ptx", "second scan of ptx"],
)  # fmt: skip
def test_a_line_that_holds_no_numbers_is_named(tmp_path: Path, name: str, head: str) -> None:
    path = tmp_path / name
    path.write_text(f"{head}1 2 3\n4 5 6\n7 8 9\n1 two 3\n")
    line = head.count("\n") + 4
    with pytest.raises(InputError) as caught:
        scan_files.read_all(path)
    assert str(caught.value) == (
        f"{name}, line {line}: expected 3 numbers as in the lines before, got '1 two 3'; correct "
        "the line or export the file again"
    )


@pytest.mark.usefixtures("by_twos")
@pytest.mark.parametrize(
    ("name", "head", "what"),
    [
        ("a.ply", PLY_AFTER("ascii", "int i", 7) + "1\n", "vertex element"),
        ("a.pcd", PCD_XYZ("", "", "") + "WIDTH 7\nHEIGHT 1\nDATA ascii\n", "data"),
        ("a.pts", "7\n", "list"),
    ],
    ids=["ply", "pcd", "pts"],
)  # fmt: skip
def test_a_file_that_is_cut_off_tells_how_many_points_are_there(
    tmp_path: Path, name: str, head: str, what: str
) -> None:
    path = tmp_path / name
    path.write_text(f"{head}1 2 3\n4 5 6\n7 8 9\n")
    with pytest.raises(InputError) as caught:
        scan_files.read_all(path)
    assert str(caught.value) == (
        f"{name} is cut off: its {what} holds 3 points, its header states 7; copy or export it "
        "again"
    )


def test_points_begin_among_the_first_two_hundred_lines(tmp_path: Path) -> None:
    path = tmp_path / "a.xyz"
    path.write_text("# more\n" * 199 + "1 2 3\n")
    np.testing.assert_array_equal(scan_files.read_points(path), [[1, 2, 3]])
    path.write_text("# more\n" * 200 + "1 2 3\n")
    with pytest.raises(InputError, match=r"numbers among its first 200: expected a point per"):
        open_scan(path)


@pytest.mark.parametrize(
    ("change", "is_read"),
    [
        ({}, True),
        ({0: "0"}, True),
        ({1: "-1"}, False),
        ({1: "one"}, False),
        ({2: "0 0"}, False),
        ({5: "0 0 1 0"}, False),
        ({6: "1 0 0"}, False),
        ({9: "1 2 3 inf"}, False),
        ({9: "1 2 nan 1"}, False),
    ],
)
def test_a_ptx_header_is_two_counts_four_triples_and_a_matrix(
    tmp_path: Path, change: dict[int, str], is_read: bool
) -> None:
    lines = PTX_HEAD(1, 1, 0, 0, 0).splitlines()
    for place, line in change.items():
        lines[place] = line
    path = tmp_path / "a.ptx"
    path.write_text("\n".join([*lines, "1 2 3"]))
    if is_read:
        np.testing.assert_array_equal(scan_files.read_points(path), [[-2, 1, 3]])
        return
    with pytest.raises(InputError) as caught:
        open_scan(path)
    assert str(caught.value) == (
        "a.ptx, line 1: expected the ten header lines of a PTX scan (columns, rows, scanner "
        "position, three axes, a 4 x 4 matrix); export the file again"
    )


# --- E57 ---


CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")


def e57(points: Sequence[Sequence[float]], **more: object) -> Mapping[str, object]:
    axes = np.array(points, dtype=np.float64).reshape(-1, 3).T
    return {"fields": dict(zip(CARTESIAN, axes, strict=True)) | more}


COLOURS = {"colorRed": [1, 2, 3], "colorGreen": [4, 5, 6], "colorBlue": [7, 8, 9]}
PLACES = {"rowIndex": [0, 0, 1], "columnIndex": [5, 6, 5]}
THREE = [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
E57: dict[str, tuple[list[Mapping[str, object]], Told]] = {
    "coordinates alone": ([e57(THREE)], file("E57", 3, frozenset(), details={"scans": 1})),
    "everything": (
        [
            {
                **e57(THREE, intensity=[1, 2, 3], **PLACES, **COLOURS),
                "intensity_limits": (-5.0, 3.0),
                "rgb_limit": 255,
            }
        ],
        file(
            "E57",
            3,
            INTENSITY | RGB | GRID,
            intensity_limits=(-5.0, 3.0),
            rgb_limit=255.0,
            details={"scans": 1},
        ),
    ),
    "scans of other limits": (
        [
            {**e57(THREE, intensity=[1, 2, 3], **COLOURS), "intensity_limits": (-5.0, 3.0),
             "rgb_limit": 255},
            {**e57(THREE, intensity=[1, 2, 3], **COLOURS), "intensity_limits": (-4.0, 9.0),
             "rgb_limit": 1023},
            {**e57([], intensity=[], **{key: [] for key in COLOURS}), "rgb_limit": 255,
             "intensity_limits": (-40.0, 90.0)},
        ],
        file(
            "E57", 6, INTENSITY | RGB, details={"scans": 2}
        ),
    ),
    "a scan that says less": (
        [
            {**e57(THREE, intensity=[1, 2, 3], **PLACES, **COLOURS),
             "intensity_limits": (-5.0, 3.0), "rgb_limit": 255},
            e57(THREE, colorRed=[1, 2, 3], colorGreen=[4, 5, 6], rowIndex=[1, 2, 3]),
        ],
        file("E57", 6, INTENSITY | RGB | GRID, details={"scans": 2}),
    ),
    "limits that limit nothing": (
        [{**e57(THREE, intensity=[1, 2, 3]), "intensity_limits": (2.0, 2.0)}],
        file("E57", 3, INTENSITY, details={"scans": 1}),
    ),
}  # fmt: skip


@pytest.mark.parametrize(("scans", "whole"), E57.values(), ids=E57)
def test_what_all_scans_of_an_e57_file_have_is_said(
    tmp_path: Path, scans: list[Mapping[str, object]], whole: Told
) -> None:
    path = scan_files.write_e57(tmp_path / "a.e57", scans)
    assert said(open_scan(path), "read") == {"name": "a.e57", **whole}


@pytest.mark.usefixtures("by_twos")
def test_all_that_e57_scans_hold_comes_out_block_by_block(tmp_path: Path) -> None:
    scans: list[Mapping[str, object]] = [
        e57([]),
        e57(THREE, colorRed=[1, 2, 3], cartesianInvalidState=[0, 2, 0], columnIndex=[1, 2, 3]),
        {
            "fields": {
                "sphericalRange": [2.0, 1.0, 5.0],
                "sphericalAzimuth": [0.0, 0.0, 0.0],
                "sphericalElevation": [0.0, 0.0, 0.0],
                "sphericalInvalidState": [0, 0, 1],
                "intensity": [4, 5, 6],
                "rowIndex": [1, 2, 3],
                "columnIndex": [4, 5, 6],
                **COLOURS,
            },
            "rotation": (1, 0, 0, 0),
            "translation": (0, 0, 7),
        },
    ]
    path = scan_files.write_e57(tmp_path / "a.e57", scans)
    posed: Told = {"scan": 1}
    assert [said(block) for block in open_scan(path).read()] == [
        block([[1, 2, 3]], n_read=2, left_out={"invalid": 1}),
        block([[7, 8, 9]]),
        block(
            [[2, 0, 7], [1, 0, 7]],
            intensity=[4, 5],
            rgb=[[1, 4, 7], [2, 5, 8]],
            row=[1, 2],
            column=[4, 5],
            **posed,
        ),
        block(
            [], n_read=1, left_out={"invalid": 1}, intensity=[], rgb=[], row=[], column=[], **posed
        ),
    ]


# --- LAS ---


@pytest.mark.usefixtures("by_twos")
@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("has_rgb", [False, True], ids=["grey", "colours"])
def test_all_that_a_las_file_holds_comes_out(tmp_path: Path, suffix: str, has_rgb: bool) -> None:
    path = scan_files.write_las(
        tmp_path / f"a{suffix}",
        np.array(THREE, dtype=np.float64),
        intensity=np.array([7, 65535, 9]),
        rgb=np.array(THREE) * 257 if has_rgb else None,
        withheld=np.array([True, False, False]),
        scale=0.25,
    )
    scan = open_scan(path)
    assert said(scan, "read") == {
        "name": f"a{suffix}",
        **file(
            "LAS/LAZ",
            3,
            INTENSITY | RGB if has_rgb else INTENSITY,
            details={"version": "1.4", "point_format": 7 if has_rgb else 6, "scale": 0.25},
        ),
    }
    rgb: list[Told] = [
        {"rgb": [[1028, 1285, 1542]]} if has_rgb else {},
        {"rgb": [[1799, 2056, 2313]]} if has_rgb else {},
    ]
    assert [said(block) for block in scan.read()] == [
        block(
            [[4, 5, 6]],
            n_read=2,
            left_out={"withheld": 1},
            intensity=[65535],
            bounds=[[4, 5, 6], [4, 5, 6]],
            **rgb[0],
        ),
        block([[7, 8, 9]], intensity=[9], bounds=[[7, 8, 9], [7, 8, 9]], **rgb[1]),
    ]
    assert scan.notes == []
