"""The readers' contract: what a library wrote into a file comes out of it, array by array."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points import e57, las, open_scan, records, text
from tests import scan_files
from tests.long_loops import long_only

Fields = dict[str, NDArray[Any]]
XYZ, RGB = ("x", "y", "z"), ("red", "green", "blue")


def scene(n_points: int = 400, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Fields:
    """Points with all that a format may have: 12-digit coordinates, 16-bit intensity, colours."""
    rng = np.random.default_rng(5)
    points = np.round(rng.uniform(1.0, 9.0, (n_points, 3)) + shift, 4)
    fields: Fields = dict(zip(XYZ, points.T, strict=True))
    fields["intensity"] = rng.integers(0, 65536, n_points).astype(np.uint16)
    fields |= dict(zip(RGB, rng.integers(0, 256, (3, n_points)).astype(np.uint8), strict=True))
    return fields


def read(path: Path) -> Fields:
    """All fields of all points, in the order of the file."""
    blocks = list(open_scan(path).read())
    found: Fields = {}
    for name in ("points", "intensity", "rgb", "row", "column"):
        parts = [getattr(block, name) for block in blocks]
        if all(part is not None for part in parts):
            found[name] = np.concatenate(parts)
    return found


def by_plyfile(path: Path, fields: Fields, *, is_text: bool, order: str, kind: str) -> Fields:
    from plyfile import PlyData, PlyElement

    kinds = {**dict.fromkeys(XYZ, kind), "intensity": "u2", **dict.fromkeys(RGB, "u1")}
    table = np.zeros(len(fields["x"]), dtype=[(name, kinds[name]) for name in fields])
    for name, values in fields.items():
        table[name] = values
    faces = np.array([([0, 1, 2],), ([1, 2, 3],)], dtype=[("vertex_indices", "i4", (3,))])
    elements = [PlyElement.describe(table, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements[:: -1 if order == ">" else 1], text=is_text, byte_order=order).write(str(path))
    return {name: table[name] for name in fields}


def by_laspy(path: Path, fields: Fields, *, point_format: int, version: str) -> Fields:
    import laspy

    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = np.full(3, 1e-4), np.floor([fields[a].min() for a in XYZ])
    header.add_extra_dim(laspy.ExtraBytesParams(name="Deviation", type=np.uint16))
    las = laspy.LasData(header)
    las.x, las.y, las.z = (fields[axis] for axis in XYZ)
    las.intensity = fields["intensity"]
    if set(RGB) <= set(las.point_format.dimension_names):
        las.red, las.green, las.blue = (fields[name].astype(np.uint16) for name in RGB)
    las.write(str(path))
    written = laspy.read(str(path))
    known = [*XYZ, "intensity", *(name for name in RGB if name in las.point_format.dimension_names)]
    return {name: np.asarray(written[name]) for name in known}


def by_pye57(path: Path, fields: Fields, *, is_posed: bool, has_grid: bool) -> Fields:
    import pye57

    axes = {f"cartesian{axis.upper()}": fields[axis] for axis in XYZ}
    colours = {f"color{name.title()}": fields[name] for name in RGB}
    raw = {**axes, "intensity": fields["intensity"].astype(np.float64), **colours}
    if has_grid:
        index = np.arange(len(fields["x"]))
        raw |= {"rowIndex": index // 20, "columnIndex": index % 20}
    pose = {}
    if is_posed:
        quaternion = np.array([0.5, -0.1, 0.7, 0.2])
        pose = {"rotation": quaternion / np.linalg.norm(quaternion)}
        pose["translation"] = np.array([301234.25, -20.5, 3.75])
    halves = (slice(0, 100), slice(100, None))
    with pye57.E57(str(path), mode="w") as file:
        for half in halves:
            file.write_scan_raw({name: values[half] for name, values in raw.items()}, **pose)
    with pye57.E57(str(path)) as file:
        wanted = {"intensity": True, "colors": True, "ignore_missing_fields": True}
        scans = [file.read_scan(k, row_column=has_grid, **wanted) for k in range(2)]
    whole = {name: np.concatenate([scan[name] for scan in scans]) for name in scans[0]}
    names = dict(zip([*axes, *colours], [*XYZ, *RGB], strict=True))
    names |= {"intensity": "intensity", "rowIndex": "row", "columnIndex": "column"}
    return {names[name]: values for name, values in whole.items()}


def by_open3d(path: Path, fields: Fields, *, has_rgb: bool = False, **options: bool) -> Fields:
    from orthoflow_plugins.plane.comparators import load_open3d

    open3d = load_open3d("the test")
    cloud = open3d.geometry.PointCloud()
    cloud.points = open3d.utility.Vector3dVector(np.column_stack([fields[a] for a in XYZ]))
    if has_rgb:
        colours = np.column_stack([fields[name] for name in RGB]) / 255.0
        cloud.colors = open3d.utility.Vector3dVector(colours)
    assert open3d.io.write_point_cloud(str(path), cloud, **options)
    return {name: fields[name] for name in (*XYZ, *(RGB if has_rgb else ()))}


def by_numpy(
    path: Path, fields: Fields, *, names: str, separator: str = " ", end: str = "\n"
) -> Fields:
    table = np.column_stack(list(fields.values())).astype(np.float64)
    header = names.replace(" ", separator)
    formats = ["%.4f"] * 3 + ["%d"] * 4
    np.savetxt(path, table, formats, separator, newline=end, header=header, comments="")
    return fields


def by_pandas(path: Path, fields: Fields, *, index: bool, **options: Any) -> Fields:
    import pandas as pd

    pd.DataFrame(fields).to_csv(path, index=index, **options)
    return fields


# Name -> name of the file, what writes it, and how.
WRITERS: Mapping[str, tuple[str, Callable[..., Fields], dict[str, Any]]] = {
    "plyfile binary": ("a.ply", by_plyfile, {"is_text": False, "order": "<", "kind": "f8"}),
    "plyfile big endian": ("a.ply", by_plyfile, {"is_text": False, "order": ">", "kind": "f4"}),
    "plyfile ascii": ("a.ply", by_plyfile, {"is_text": True, "order": "=", "kind": "f8"}),
    **{
        f"laspy {suffix} {version} format {point_format}": (
            f"a.{suffix}",
            by_laspy,
            {"point_format": point_format, "version": version},
        )
        for suffix in ("las", "laz")
        for version, formats in (("1.2", (0, 1, 2, 3)), ("1.4", (6, 7, 8)))
        for point_format in formats
    },
    "pye57": ("a.e57", by_pye57, {"is_posed": False, "has_grid": False}),
    "pye57 posed, on a grid": ("a.e57", by_pye57, {"is_posed": True, "has_grid": True}),
    "open3d ply": ("a.ply", by_open3d, {"has_rgb": True}),
    "open3d pcd": ("a.pcd", by_open3d, {"has_rgb": True}),
    "open3d packed pcd": ("a.pcd", by_open3d, {"has_rgb": True, "compressed": True}),
    "open3d ascii pcd": ("a.pcd", by_open3d, {"write_ascii": True}),
    "open3d xyzrgb": ("a.xyzrgb", by_open3d, {"has_rgb": True}),
    "numpy": ("a.xyz", by_numpy, {"names": "x y z i r g b"}),
    "numpy tabs": ("a.txt", by_numpy, {"names": "X Y Z I R G B", "separator": "\t", "end": "\r\n"}),
    "numpy without header": ("a.xyz", by_numpy, {"names": "400"}),
    "numpy pts": ("a.pts", by_numpy, {"names": "400"}),
    "pandas": ("a.csv", by_pandas, {"index": False}),
    "pandas index": ("a.csv", by_pandas, {"index": True}),
    "pandas commas": ("a.csv", by_pandas, {"index": True, "sep": ";", "decimal": ","}),
    "pandas quotes": ("a.csv", by_pandas, {"index": False, "quoting": 1, "encoding": "utf-8-sig"}),
}


def written(name: str, folder: Path, fields: Fields) -> tuple[Path, Fields]:
    """Write a file, and return it with what it must contain."""
    file_name, write, options = WRITERS[name]
    return folder / file_name, write(folder / file_name, fields, **options)


def check(found: Fields, right: Fields, *, atol: float) -> None:
    points = np.column_stack([right[axis] for axis in XYZ]).astype(np.float64)
    np.testing.assert_allclose(found["points"], points, rtol=0.0, atol=atol)
    assert ("intensity" in found) == ("intensity" in right)
    if "intensity" in right:
        np.testing.assert_array_equal(found["intensity"], right["intensity"].astype(np.float32))
    assert ("rgb" in found) == ("red" in right)
    if "red" in right:
        rgb = np.column_stack([right[name] for name in RGB]).astype(np.float64)
        scale = 255.0 if found["rgb"].max() <= 1.0 else 1.0
        np.testing.assert_allclose(found["rgb"] * scale, rgb, atol=0.01)
    for name in ("row", "column"):
        if name in right:
            np.testing.assert_array_equal(found[name], right[name])


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("is_survey", [False, True], ids=["room", "survey"])
def test_what_a_library_wrote_comes_out(name: str, is_survey: bool, tmp_path: Path) -> None:
    shift = (301234.0, 4651234.0, 112.0) if is_survey else (0.0, 0.0, 0.0)
    path, right = written(name, tmp_path, scene(shift=shift))
    check(read(path), right, atol=tolerance(name, is_survey=is_survey))


def tolerance(name: str, *, is_survey: bool) -> float:
    """Half a step of what the writer keeps: double, rounded text, or single precision."""
    if name.startswith("open3d") and name.endswith("pcd"):
        return 0.26 if is_survey else 1e-6
    steps = {"pye57": 1e-6, "numpy": 6e-5}
    return next((step for start, step in steps.items() if name.startswith(start)), 1e-9)


@pytest.mark.parametrize("name", ["plyfile binary", "pye57", "laspy laz 1.4 format 7", "numpy"])
def test_blocks_join_without_a_seam(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (e57, las, records):
        monkeypatch.setattr(module, "BLOCK_POINTS", 150)
    monkeypatch.setattr(text, "BLOCK_BYTES", 5000)
    path, right = written(name, tmp_path, scene())
    assert len(list(open_scan(path).read())) > 2
    check(read(path), right, atol=tolerance(name, is_survey=False))


@pytest.mark.parametrize("share", [0.97, 0.1, *long_only(0.5, 0.01)])
@pytest.mark.parametrize("name", [name for name in WRITERS if not name.startswith("open3d")])
def test_a_file_that_is_cut_off_is_refused_or_read_as_far_as_it_goes(
    name: str, share: float, tmp_path: Path
) -> None:
    path, right = written(name, tmp_path, scene())
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    try:
        points = read(path)["points"]
    except InputError as error:
        refusal = str(error)
        assert [path.name in refusal, "\n" in refusal] == [True, False]
        return
    # Only text can end anywhere.
    assert path.suffix in (".xyz", ".txt", ".csv")
    n_points = len(points) - 1
    assert n_points < len(right["x"])
    expected = np.column_stack([right[a] for a in XYZ])[:n_points]
    np.testing.assert_allclose(points[:-1], expected, atol=6e-5)


def test_scans_of_a_ptx_file_are_placed_by_their_poses(tmp_path: Path) -> None:
    fields = scene()
    local = np.column_stack([fields[axis] for axis in XYZ])
    pose = np.eye(4)
    pose[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    pose[:3, 3] = [300000.5, 20.25, -3.0]
    table = np.column_stack([local, fields["intensity"] / 65535.0, *(fields[c] for c in RGB)])
    path = scan_files.write_ptx(tmp_path / "a.ptx", [(table, 20, np.eye(4)), (table, 50, pose)])
    found = read(path)
    placed = np.concatenate([local, local @ pose[:3, :3].T + pose[:3, 3]])
    np.testing.assert_allclose(found["points"], placed, atol=1e-6)
    index = np.arange(400)
    np.testing.assert_array_equal(found["row"], np.concatenate([index % 20, index % 50]))
    np.testing.assert_array_equal(found["column"], np.concatenate([index // 20, index // 50]))
    stations = [scan.station for scan in open_scan(path).scans]
    np.testing.assert_array_equal(stations, [np.zeros(3), pose[:3, 3]])
