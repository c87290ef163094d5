from __future__ import annotations

import dataclasses
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pye57
import pytest
from laspy.copc import CopcReader
from numpy.typing import NDArray
from plyfile import PlyData
from syrupy.assertion import SnapshotAssertion

from orthoflow.files.clouds import attributes, copc
from orthoflow.files.clouds.attributes import AttributedCloud, describe_cloud, plane_colour
from orthoflow.files.clouds.copc import write_copc
from orthoflow.files.clouds.neighbourhoods import neighbourhoods_of
from orthoflow.files.clouds.photo_colours import PointColours, colour_points
from orthoflow.files.clouds.writers import write_e57, write_laz, write_ply
from orthoflow.files.geotiff import epsg_wkt
from orthoflow.files.images import encode_png
from orthoflow.files.points import PointQuery, open_scan
from orthoflow.geometry.frames import frame_over
from orthoflow.geometry.slabs import Slab
from orthoflow.products import Photo, PointCloud, PointLabels
from tests import cloud_scenes, samples
from tests.cloud_scenes import ORIGIN, planes
from tests.long_loops import seeds

N_SIDE = 60
STATIONS = ORIGIN + np.array([[2.0, 1.0, 1.5], [1.0, 2.0, 1.0]])
DEVIATION_M = 0.004


def corner(**more: Any) -> PointCloud:
    n_points = 2 * N_SIDE**2
    plain: dict[str, Any] = {
        "intensity": np.linspace(0.0, 1.0, n_points, dtype=np.float32),
        "rgb": (np.arange(3 * n_points) % 251).astype(np.uint8).reshape(-1, 3),
        "stations": STATIONS,
        "stations_source": "file",
    }
    return cloud_scenes.corner(N_SIDE, 0.05, deviation_m=DEVIATION_M, **(plain | more))


def labels(cloud: PointCloud) -> PointLabels:
    index = np.repeat(np.array([0, 1], np.int16), N_SIDE**2)
    index[::7] = -1
    assert len(index) == len(cloud)
    return PointLabels(plane_index=index)


def with_attributes(**more: Any) -> AttributedCloud:
    cloud = more.pop("cloud", None) or corner()
    plain: dict[str, Any] = {
        "cloud": cloud,
        "colouring": "rgb",
        "neighbourhoods": neighbourhoods_of(cloud),
        "planes": planes(),
        "labels": labels(cloud) if len(cloud) == 2 * N_SIDE**2 else None,
    }
    return AttributedCloud(**(plain | more))


# Any: an array of any kind.
Read = dict[str, Any]


def read_laz(path: Path) -> Read:
    found = laspy.read(path)
    names = [n for n in ("plane", "deviation", "photo") if n in found.point_format.dimension_names]
    return {
        "world": found.xyz,
        "rgb": np.column_stack([found.red, found.green, found.blue]) / 257.0,
        "normal": np.column_stack([found["NormalX"], found["NormalY"], found["NormalZ"]]),
        "scan": np.asarray(found.point_source_id),
        "intensity": np.asarray(found.intensity) / 65535.0,
        **{name: np.asarray(found[name]) for name in names},
    }


def read_ply(path: Path) -> Read:
    found = PlyData.read(path)["vertex"]
    names = [p.name for p in found.properties]
    parts = {"world": "x y z", "rgb": "red green blue", "normal": "nx ny nz"}
    joined = {
        part: np.column_stack([found[name] for name in text.split()])
        for part, text in parts.items()
    }
    return joined | {name: np.asarray(found[name]) for name in names[9:]}


def read_e57(path: Path) -> Read:
    with pye57.E57(str(path)) as file:
        scans = [file.read_scan(k, intensity=True, colors=True) for k in range(file.scan_count)]
    whole = {name: np.concatenate([scan[name] for scan in scans]) for name in scans[0]}
    sizes = [len(scan["cartesianX"]) for scan in scans]
    return {
        "world": np.column_stack([whole[f"cartesian{axis}"] for axis in "XYZ"]),
        "rgb": np.column_stack([whole[f"color{name}"] for name in ("Red", "Green", "Blue")]),
        "scan": np.repeat(np.arange(len(scans)), sizes),
        "intensity": whole["intensity"],
    }


FORMATS = {"laz": (write_laz, read_laz), "ply": (write_ply, read_ply), "e57": (write_e57, read_e57)}


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("block", [1 << 20, 1000], ids=["at once", "in blocks"])
def test_another_program_reads_every_point_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, block: int
) -> None:
    monkeypatch.setattr(attributes, "BLOCK", block)
    write, read = FORMATS[name]
    cloud = corner()
    assert write(tmp_path / "a", with_attributes()) == len(cloud)
    found = read(tmp_path / "a")
    assert cloud.scan is not None
    assert cloud.rgb is not None
    assert cloud.intensity is not None
    # E57 has scan after scan.
    order = np.argsort(cloud.scan, kind="stable") if name == "e57" else np.arange(len(cloud))
    # LAZ keeps tenths of a millimetre, doubles of 4e6 m nanometres.
    limit_m = 0.51e-4 if name == "laz" else 2e-9
    np.testing.assert_allclose(found["world"], cloud.points_world()[order], atol=limit_m, rtol=0)
    np.testing.assert_array_equal(np.rint(found["rgb"]), cloud.rgb[order])
    np.testing.assert_array_equal(found["scan"], cloud.scan[order])
    np.testing.assert_allclose(found["intensity"], cloud.intensity[order], atol=1e-5)
    if name == "e57":
        return
    np.testing.assert_array_equal(found["plane"], labels(cloud).plane_index)
    on_plane = labels(cloud).plane_index >= 0
    np.testing.assert_array_equal(np.isfinite(found["deviation"]), on_plane)
    np.testing.assert_allclose(found["deviation"][on_plane], DEVIATION_M, atol=1e-6)
    # Away from the edge, where two surfaces meet, normals are those of wall and floor.
    away = (cloud.x + cloud.z > 0.5) & (cloud.y > 0.0)
    is_wall = np.arange(len(cloud)) < N_SIDE**2
    truth = np.where(is_wall[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    np.testing.assert_allclose(found["normal"][away], truth[away], atol=1e-4)


def test_copc_holds_the_points_of_laz_in_nodes_of_an_octree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(copc, "KEPT_WHOLE", 300)
    # The nearer to a corner the denser, as about a scanner.
    x, y, z = (2.0 * np.random.default_rng(2).random((3, 8000)) ** 4).astype(np.float32)
    cloud = PointCloud(
        origin=ORIGIN, x=x, y=y, z=z, up=np.array([0.0, 0.0, 1.0]), intensity=x / 2.0
    )
    attributed = with_attributes(cloud=cloud, colouring="intensity", planes=None)
    path = tmp_path / "a.copc.laz"
    assert write_copc(path, attributed) == len(cloud)
    assert list(tmp_path.iterdir()) == [path]
    # In groups and blocks it gives the same bytes.
    monkeypatch.setattr(copc, "IN_MEMORY_POINTS", 500)
    monkeypatch.setattr(copc, "BLOCK", 1000)
    monkeypatch.setattr(attributes, "BLOCK", 1000)
    write_copc(tmp_path / "b.copc.laz", attributed)
    assert (tmp_path / "b.copc.laz").read_bytes() == path.read_bytes()
    write_laz(tmp_path / "a.laz", attributed)
    found, laz = laspy.read(path), laspy.read(tmp_path / "a.laz")
    rows = [sorted(row.tobytes() for row in read.points.array) for read in (found, laz)]
    assert rows[0] == rows[1]
    np.testing.assert_array_equal(found.header.mins, laz.header.mins)
    np.testing.assert_array_equal(found.header.maxs, laz.header.maxs)
    with CopcReader.open(path) as file:
        info, entries = file.copc_info, file.root_page.entries
        assert len(file.query().x) == len(cloud)
    nodes = sorted(entries.values(), key=lambda entry: entry.offset)
    places = {(node.key.level, node.key.x, node.key.y, node.key.z) for node in nodes}
    parents = {(level - 1, x // 2, y // 2, z // 2) for level, x, y, z in places if level}
    assert parents <= places
    assert max(level for level, *_ in places) >= 3
    first = 0
    for node in nodes:
        points = found.xyz[first : first + node.point_count]
        first += node.point_count
        side = 2.0 * info.halfsize / 2**node.key.level
        place = (node.key.x, node.key.y, node.key.z)
        within = (points - (info.center - info.halfsize)) / side - place
        assert ((within > 0.0) & (within < 1.0)).all()
        if (node.key.level, *place) in parents:
            cells = np.floor(128 * within)
            assert len(np.unique(cells, axis=0)) == len(points)
        else:
            assert len(points) <= 300
    assert first == len(cloud)
    # And orthoflow reads as much of it as one asks for.
    root = [node.point_count for node in nodes if node.key.level == 0]
    coarse = open_scan(path, query=PointQuery(spacing=info.spacing))
    assert [sum(block.n_read for block in coarse.read())] == root
    assert info.spacing == pytest.approx(2.0 * info.halfsize / 128)
    # A step of the file about all points, and an odd number of steps; no times are known.
    steps = round(float((found.header.maxs - found.header.mins).max()) / 1e-4) + 3
    assert 2.0 * info.halfsize == pytest.approx(1e-4 * (steps | 1), abs=1e-7)
    np.testing.assert_allclose(
        info.center - info.halfsize, found.header.mins - 1e-4, rtol=0, atol=1e-7
    )
    assert struct.unpack_from("<2d", path.read_bytes(), 375 + 54 + 56) == (0.0, 0.0)
    nothing = dataclasses.replace(attributed, box_world=ORIGIN + 100.0 + np.eye(2, 3))
    assert write_copc(tmp_path / "none", nothing) == 0


@pytest.mark.parametrize("name", FORMATS)
def test_the_same_cloud_gives_the_same_bytes(tmp_path: Path, name: str) -> None:
    for path in (tmp_path / "a", tmp_path / "b"):
        FORMATS[name][0](path, with_attributes())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_an_e57_says_of_each_scan_what_it_holds(
    tmp_path: Path, snapshot: SnapshotAssertion
) -> None:
    cloud = corner()
    path = tmp_path / "a.e57"
    write_e57(path, with_attributes(crs_wkt="PROJCS[x]"))
    points = cloud.points_world()
    colours = ("colorRed", "colorGreen", "colorBlue")
    with pye57.E57(str(path)) as file:
        root = file.image_file.root()
        assert root["coordinateMetadata"].value() == "PROJCS[x]"
        created = root["creationDateTime"]
        assert created["dateTimeValue"].value() == created["isAtomicClockReferenced"].value() == 0
        for scan in (0, 1):
            node = root["data3D"][scan]
            assert node["name"].value() == f"scan {scan}"
            np.testing.assert_allclose(file.get_header(scan).translation, STATIONS[scan])
            own = points[cloud.scan == scan] - STATIONS[scan]
            bounds = limits_of(node["cartesianBounds"], *"xyz")
            np.testing.assert_allclose(
                np.transpose(bounds), [own.min(axis=0), own.max(axis=0)], atol=1e-8
            )
            assert limits_of(node["colorLimits"], *colours) == [(0, 255)] * 3
            assert limits_of(node["intensityLimits"], "intensity") == [(0.0, 1.0)]
            turned = node["pose"]["rotation"]
            assert [turned[name].value() for name in "wxyz"] == [1.0, 0.0, 0.0, 0.0]
            # Metres from the scanner have every digit, normals and distances those of float32.
            fields = pye57.libe57.StructureNode(node["points"].prototype())
            found = {
                name: [
                    getattr(fields[name], limit, lambda: "")()
                    for limit in ("minimum", "maximum", "precision")
                ]
                for name in file.get_header(scan).point_fields
            }
            assert {name: list(map(str, limits)) for name, limits in found.items()} == snapshot(
                name="fields"
            )
    without = corner(stations=None, stations_source=None)
    write_e57(tmp_path / "b.e57", with_attributes(cloud=without))
    with pye57.E57(str(tmp_path / "b.e57")) as file:
        np.testing.assert_allclose(file.get_header(0).translation, ORIGIN)


def limits_of(node: Any, *names: str) -> list[tuple[float, float]]:
    ends = ("Minimum", "Maximum")
    return [tuple(node[name + end].value() for end in ends) for name in names]  # type: ignore[misc]


def test_colours_show_what_was_asked_for(tmp_path: Path) -> None:
    cloud = corner()
    write_laz(tmp_path / "a.laz", with_attributes(colouring="intensity"))
    grey = read_laz(tmp_path / "a.laz")["rgb"]
    assert (grey[:, 0] == grey[:, 1]).all()
    assert (np.diff(grey[:, 0]) >= 0).all()
    assert (grey[0, 0], grey[-1, 0]) == (0, 255)
    write_laz(tmp_path / "b.laz", with_attributes(colouring="plane"))
    by_plane = read_laz(tmp_path / "b.laz")["rgb"]
    for plane in (-1, 0, 1):
        mine = by_plane[labels(cloud).plane_index == plane]
        shade = mine.max(axis=1) / max(plane_colour(plane))
        # Rounded to whole steps of 255.
        np.testing.assert_allclose(mine, shade[:, None] * plane_colour(plane), atol=1.0)
        assert shade.min() >= 0.39
    attributed = with_attributes(colouring="deviation")
    assert attributed.scale_m == 0.005
    write_laz(tmp_path / "c.laz", attributed)
    by_distance = read_laz(tmp_path / "c.laz")["rgb"]
    on_plane = labels(cloud).plane_index >= 0
    # 4 of 5 mm: four fifths of the way from white to red.
    assert set(map(tuple, np.rint(by_distance[on_plane]).tolist())) == {(192, 69, 84)}
    assert set(map(tuple, np.rint(by_distance[~on_plane]).tolist())) == {(128, 128, 128)}
    describe_cloud(tmp_path / "c.json", attributed, "c.laz", len(cloud))
    said = json.loads((tmp_path / "c.json").read_text())
    assert said["colour_scale"]["+0.005"] == [178, 24, 43]
    assert said["scans"][1] == {"scan": 1, "station_world": STATIONS[1].tolist()}


def test_only_what_is_asked_for_is_written(tmp_path: Path) -> None:
    cloud = corner()
    frame = frame_over(planes().corners[0], planes().normal[0], gsd_m=0.01)
    slab = Slab(frame=frame, front_m=0.1, behind_m=0.05)
    n_wall = write_laz(tmp_path / "a.laz", with_attributes(wall=slab, wall_plane=0))
    found = read_laz(tmp_path / "a.laz")
    expected = (cloud.x <= 0.1) & (cloud.z > 0) & (cloud.y <= 2.0)
    assert n_wall == np.count_nonzero(expected)
    # The floor, up to 2 m from the plane of the wall, is not written and sets no scale.
    assert with_attributes(wall=slab, wall_plane=0).scale_m == 0.1
    # Of points on no plane as well, and of those of the floor beside the wall.
    np.testing.assert_allclose(found["deviation"], cloud.x[expected], atol=1e-6)
    box = ORIGIN + np.array([[0.5, 0.5, -1.0], [1.0, 1.5, 1.0]])
    write_ply(tmp_path / "a.ply", with_attributes(box_world=box))
    inside = read_ply(tmp_path / "a.ply")["world"]
    assert ((inside >= box[0]) & (inside <= box[1])).all()
    expected = np.all((cloud.points_world() >= box[0]) & (cloud.points_world() <= box[1]), axis=1)
    assert len(inside) == np.count_nonzero(expected)
    assert write_laz(tmp_path / "none.laz", with_attributes(box_world=box + 100.0)) == 0


@pytest.mark.parametrize("seed", seeds(3))
def test_cleaning_takes_the_outliers_and_nothing_else(tmp_path: Path, seed: int) -> None:
    cloud = corner()
    random = np.random.default_rng(seed)
    far = random.uniform([0.6, 0.6, 0.6], [3.0, 3.0, 3.0], (12, 3)).astype(np.float32)
    far[0] = 4000.0
    spoilt = PointCloud(
        origin=ORIGIN,
        x=np.append(cloud.x, far[:, 0]),
        y=np.append(cloud.y, far[:, 1]),
        z=np.append(cloud.z, far[:, 2]),
        up=cloud.up,
        intensity=np.ones(len(cloud) + 12, np.float32),
    )
    plain = with_attributes(cloud=spoilt, colouring="intensity", planes=None)
    assert write_laz(tmp_path / "a.laz", plain) == len(spoilt)
    clean = dataclasses.replace(plain, is_cleaned=True)
    assert write_laz(tmp_path / "b.laz", clean) == len(cloud)
    np.testing.assert_allclose(
        read_laz(tmp_path / "b.laz")["world"], cloud.points_world(), atol=0.51e-4
    )


# The header of LAZ, and the scale of its coordinates


def floor(size_m: float = 1.0) -> PointCloud:
    a, b = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0.0, size_m, 12)] * 2))
    x, y = (np.ascontiguousarray(axis, np.float32) for axis in (a, b))
    up = np.array([0.0, 0.0, 1.0])
    return PointCloud(origin=np.array([1e5, 2e5, 50.5]), x=x, y=y, z=np.zeros_like(x), up=up)


def written(path: Path, cloud: PointCloud, crs_wkt: str = "") -> laspy.LasData:
    write_laz(path, with_attributes(cloud=cloud, planes=None, crs_wkt=crs_wkt))
    return laspy.read(path)


@pytest.mark.parametrize("crs_wkt", ["", epsg_wkt(25832)], ids=["unknown", "known"])
def test_a_header_has_a_coordinate_system_where_there_is_one_and_only_wkt_ever(
    tmp_path: Path, crs_wkt: str
) -> None:
    found = written(tmp_path / "a.laz", floor(), crs_wkt)
    # LAS 1.4 has it for points of its formats from 6 on, whether there is one or not.
    assert found.header.global_encoding.wkt
    systems = [one.string for one in found.header.vlrs if one.record_id == 2112]
    assert systems == ([crs_wkt] if crs_wkt else [])


@pytest.mark.parametrize(
    ("size_m", "scale_m"),
    # 31 bits with a sign hold 214 km in steps of a tenth of a millimetre, and the origin may lie
    # anywhere within.
    [(1.0, 1e-4), (107_000.0, 1e-4), (108_000.0, 1e-3), (2_000_000.0, 1e-2)],
)
def test_coordinates_keep_a_tenth_of_a_millimetre_where_that_fits(
    tmp_path: Path, size_m: float, scale_m: float
) -> None:
    cloud = floor(size_m)
    # Of a mirrored cloud the farthest point has a negative offset.
    for one in (cloud, dataclasses.replace(cloud, x=-cloud.x, y=np.zeros_like(cloud.y))):
        found = written(tmp_path / "a.laz", one)
        np.testing.assert_allclose(found.header.scales, scale_m, rtol=1e-9)
        np.testing.assert_allclose(found.xyz, one.points_world(), atol=0.51 * scale_m)


# Which photo colours a point best, and what hides it ----------------------------------------------


# Looks along y from the origin: x right, y down is minus z.
ALONG_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
WIDTH, HEIGHT, FOCAL = 200, 100, 100.0
PLACE = np.array([1000.0, 2000.0, 50.0])


def camera(at: tuple[float, float, float] = (0.0, 0.0, 0.0), focal: float = FOCAL) -> Any:
    return samples.camera(
        ALONG_Y, PLACE + at, width=WIDTH, height=HEIGHT,
        fx=focal, fy=focal, cx=0.5 * WIDTH, cy=0.5 * HEIGHT,
    )  # fmt: skip


def cloud(points_m: NDArray[np.float64]) -> PointCloud:
    x, y, z = np.ascontiguousarray(points_m.T.astype(np.float32))
    return PointCloud(origin=PLACE, x=x, y=y, z=z, up=np.array([0.0, 0.0, 1.0]))


def photo(grey: int) -> Photo:
    encoded = encode_png(np.full((HEIGHT, WIDTH, 3), grey, np.uint8))
    return Photo(name=f"{grey}.png", width=WIDTH, height=HEIGHT, encoded=encoded)


def colours_of(count: int) -> PointColours:
    return PointColours(
        rgb=np.full((count, 3), 99, dtype=np.uint8),
        best=np.zeros(count, dtype=np.float32),
        photo=np.full(count, -1, dtype=np.int16),
    )


@pytest.mark.parametrize("keeps_photo", [True, False])
def test_a_point_gets_the_colour_of_the_photo_that_shows_it_largest(keeps_photo: bool) -> None:
    rng = np.random.default_rng(1)
    # A wall two metres before the first camera; the second stands nearer and more to the right.
    points = np.column_stack(
        [rng.uniform(-3.0, 3.0, 4_000), np.full(4_000, 2.0), rng.uniform(-1.4, 1.4, 4_000)]
    )
    cameras = [camera(), camera((0.8, 1.0, 0.0))]
    colours = colours_of(4_000)
    if not keeps_photo:
        colours = replace(colours, photo=None)
    colour_points(cloud(points), list(zip(map(photo, (40, 200)), cameras, strict=True)), colours)
    qualities = []
    for one in cameras:
        placed = one.project(points + PLACE)
        inside = one.sees(placed[:, :2])
        # Pixels per metre squared, less within a twentieth of the shorter side of the border.
        from_border = np.minimum(placed[:, :2], (WIDTH, HEIGHT) - placed[:, :2]).min(axis=1)
        known = (FOCAL / placed[:, 2]) ** 2 * np.clip(from_border / (0.05 * HEIGHT), 1e-3, 1.0)
        qualities.append(np.where(inside, known, 0.0))
    best = np.argmax(qualities, axis=0)
    nobody = np.max(qualities, axis=0) == 0.0
    assert {0, 1} == set(best[~nobody].tolist())
    assert nobody.any()
    np.testing.assert_allclose(colours.best, np.max(qualities, axis=0), rtol=1e-4)
    expected = np.where(nobody, 99, np.array([40, 200])[best])
    np.testing.assert_array_equal(colours.rgb, np.repeat(expected[:, None], 3, axis=1))
    if colours.photo is not None:
        np.testing.assert_array_equal(colours.photo, np.where(nobody, -1, best))


def test_a_point_behind_a_board_is_not_coloured() -> None:
    a, b = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-1.0, 1.0, 161)] * 2))
    wall = np.column_stack([2.0 * a, np.full(len(a), 4.0), b])
    board = np.column_stack([0.25 * a, np.full(len(a), 2.0), 0.25 * b])
    colours = colours_of(2 * len(a))
    colour_points(cloud(np.vstack([wall, board])), [(photo(40), camera(focal=150.0))], colours)
    assert colours.photo is not None
    # The board, 0.25 m at 2 m, hides 0.5 m at 4 m.
    off = np.maximum(np.abs(2.0 * a), np.abs(b))
    assert (colours.photo[: len(a)][off < 0.45] == -1).all()
    assert (colours.photo[: len(a)][(off > 0.55) & (np.abs(a) < 0.6)] == 0).all()
    assert (colours.rgb[: len(a)][off < 0.45] == 99).all()
    assert (colours.photo[len(a) :] == 0).all()
