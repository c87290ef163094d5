"""`read.scan`: a cloud in metres from files in any unit, its scales and figures."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.read import scales
from orthoflow_plugins.read.assembly import CloudAssembly, rounding_m
from orthoflow_plugins.read.figures import plan_view, polar_view_png
from orthoflow_plugins.read.scales import ColourScale, IntensityScale, choose_scales, normalise
from orthoflow_plugins.read.scan import ReadScan

from orthoflow.errors import InputError, StoreError
from orthoflow.files.points.scan_file import PointBlock, PointField, Scan, ScanFile
from orthoflow.products import PointCloud
from tests import scan_files
from tests.method_runs import Reader
from tests.plane_scenes import cloud_of
from tests.raster_scenes import context

POINTS = np.round(np.random.default_rng(3).uniform(-5.0, 5.0, (400, 3)), 4)


class ScanReader(Reader):
    """Function that returns the cloud of files."""

    def __call__(self, *paths: Path, **params: object) -> PointCloud:
        cloud: PointCloud = self.run(paths, params).cloud
        return cloud


@pytest.fixture
def read(tmp_path: Path) -> ScanReader:
    return ScanReader(ReadScan, tmp_path)


def scan_of(cloud: PointCloud) -> dict[str, Any]:
    """Return the summary of the only scan of a cloud."""
    (scan,) = cloud.source["scans"]  # type: ignore[misc]
    return scan  # type: ignore[return-value]


def write_text(path: Path, table: Iterable[Iterable[float]], header: str = "") -> Path:
    rows = [" ".join(repr(float(value)) for value in row) for row in table]
    path.write_text("\n".join([*([header] if header else []), *rows, ""]))
    return path


# Coordinates


@pytest.mark.parametrize(
    ("unit", "factor"),
    [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("ft", 0.3048), ("us-ft", 1200 / 3937)],
)
def test_survey_coordinates_come_out_in_metres_to_a_hundredth_of_a_millimetre(
    tmp_path: Path, read: ScanReader, unit: str, factor: float
) -> None:
    shift = np.array([634512.347, 486215.781, 112.193])
    world_m = POINTS + shift
    cloud = read(write_text(tmp_path / "a.xyz", world_m / factor), unit=unit)
    np.testing.assert_allclose(cloud.points_world(), world_m, atol=1e-5)
    assert (cloud.origin == np.floor(cloud.origin)).all()
    assert np.abs(cloud.origin - shift).max() < 5.0
    assert scan_of(cloud)["unit"] == unit
    assert cloud.x.dtype == np.float32
    sides_m = np.ptp(world_m, axis=0)
    assert [read.metrics[f"extent_{axis}_m"] for axis in "xyz"] == pytest.approx(sides_m, abs=1e-5)
    assert not any(said in read.warnings for said in ("are rounded to", "are kept to"))
    # Offsets are five to eight metres.
    assert cloud.source["resolution_m"] == 2.0**-21


def test_a_box_keeps_the_points_in_it_and_on_its_faces(tmp_path: Path, read: ScanReader) -> None:
    world_m = POINTS + np.array([634512.347, 486215.781, 112.193])
    # The file is in feet; the box is in metres, like all later steps.
    corner = world_m[7]
    box = [[*(corner - 4.0)], [*corner]]
    cloud = read(write_text(tmp_path / "a.xyz", world_m / 0.3048), unit="ft", box=box)
    inside = ((world_m >= corner - 4.0) & (world_m <= corner + 1e-9)).all(axis=1)
    assert 3 < inside.sum() < 300
    kept = cloud.points_world()
    # Within 1e-9 m, since the corner was converted to feet and back.
    assert len(kept) in (inside.sum(), inside.sum() - 1)
    assert (kept >= corner - 4.00001).all()
    assert (kept <= corner + 1e-5).all()
    assert scan_of(cloud)["left_out"] == {"outside_box": 400 - len(kept)}
    steps = np.stack(np.meshgrid(*[np.arange(5.0)] * 3), axis=-1).reshape(-1, 3) + 1.0
    path = write_text(tmp_path / "b.xyz", steps)
    far = [[10, 10, 10], [11, 11, 11]]
    with pytest.raises(
        InputError, match=r"125 are outside .* from \(1.00, 1.00, 1.00\) to \(5.00, "
    ):
        read(path, box=far)
    # One of several files may be completely outside the box.
    assert len(read(path, write_text(tmp_path / "c.xyz", steps + 7.0), box=far)) == 8


def test_gsd_and_box_select_nodes_of_copc_files(tmp_path: Path, read: ScanReader) -> None:
    rng = np.random.default_rng(3)
    coarse, left, right = (
        rng.uniform(low, high, (400, 3)) for low, high in ((0.1, 7.9), (0.1, 3.9), (4.1, 7.9))
    )
    nodes = [{(0, 0, 0): coarse}, {(0, 0, 0): left, (1, 1, 1): right}]
    path = scan_files.write_copc(tmp_path / "a.copc.laz", nodes)
    # The file is in feet; the points of its root are half a foot apart.
    assert len(read(path, unit="ft", gsd_m=0.5 * 0.3048)) == 400
    assert len(read(path, unit="ft", gsd_m=0.4 * 0.3048)) == 1200
    box = [[0.0, 0.0, 0.0], [3.9 * 0.3048] * 3]
    cloud = read(path, unit="ft", box=box)
    assert len(cloud) == 400 + np.count_nonzero((coarse <= 3.9).all(axis=1))
    assert scan_of(cloud)["n_read"] == 800
    assert "gsd_m applies only" not in read.warnings
    read(scan_files.write_las(tmp_path / "b.laz", POINTS), gsd_m=0.1)
    assert "gsd_m has no effect: it applies only to COPC files" in read.warnings


def test_a_box_without_an_inside_is_refused() -> None:
    with pytest.raises(ValueError, match="the lowest corner and then the highest"):
        ReadScan.Params(box=((0.0, 0.0, 1.0), (1.0, 1.0, 1.0)))


def test_classes_choose_points_of_las_files(tmp_path: Path, read: ScanReader) -> None:
    classes = np.arange(400) % 3
    path = scan_files.write_las(tmp_path / "a.laz", POINTS, classification=classes.astype(np.uint8))
    cloud = read(path, classes=[0, 2])
    np.testing.assert_allclose(cloud.points_world(), POINTS[classes != 1], atol=6e-5)
    assert scan_of(cloud)["left_out"] == {"other_class": 133}
    with pytest.raises(InputError, match="400 are of other classes than requested; change"):
        read(path, classes=[9])
    read(write_text(tmp_path / "a.xyz", POINTS), classes=[2])
    assert "classes has no effect: it applies only to LAS and LAZ files" in read.warnings


def test_stray_points_do_not_cost_the_scan_its_precision(tmp_path: Path, read: ScanReader) -> None:
    world = POINTS + np.array([634512.347, 486215.781, 112.193])
    world[:3] = 1.0
    cloud = read(write_text(tmp_path / "a.xyz", world))
    np.testing.assert_allclose(cloud.points_world()[3:], world[3:], atol=1e-5)
    assert "coordinates are rounded to 62.50 mm" in read.warnings


@pytest.mark.parametrize("up", ["x", "-y"])
def test_up_is_told_and_nothing_is_turned(tmp_path: Path, read: ScanReader, up: str) -> None:
    cloud = read(write_text(tmp_path / "a.xyz", POINTS), up=up)
    expected = np.zeros(3)
    expected["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    np.testing.assert_array_equal(cloud.up, expected)
    np.testing.assert_allclose(cloud.points_world(), POINTS, atol=1e-6)


def test_rounding_and_tiny_scans_are_reported(tmp_path: Path, read: ScanReader) -> None:
    path = write_text(tmp_path / "a.xyz", POINTS)
    read(path)
    assert "rounded" not in read.warnings
    assert "which is unusual" not in read.warnings
    read(path, unit="mm")
    assert "m (unit mm), which is unusual: set {step}.unit=m if" in read.warnings
    read(write_text(tmp_path / "b.xyz", np.round(POINTS, 2)))
    assert "the coordinates of b.xyz are rounded to 10 mm" in read.warnings


# Several files and scans


def test_several_files_become_one_cloud(tmp_path: Path, read: ScanReader) -> None:
    half, moved = np.sqrt(0.5), np.array([3.0, 4.0, 0.5])
    pose = {"rotation": (half, 0, 0, half), "translation": tuple(moved)}
    fields = scan_files.cartesian(POINTS)
    scans = scan_files.write_e57(
        tmp_path / "b.e57", [{"fields": fields}, {"fields": fields} | pose]
    )
    cloud = read(scans, unit="ft")
    np.testing.assert_allclose(cloud.stations, np.array([np.zeros(3), moved]) * 0.3048)
    assert cloud.stations_source == "file"
    np.testing.assert_array_equal(cloud.scan, np.repeat([0, 1], 400))
    assert (read.metrics["n_scans"], read.metrics["n_stations"]) == (2, 2)
    cloud = read(write_text(tmp_path / "a.xyz", POINTS), scans)
    # Scan numbers that are not indices of stations are not stored.
    assert cloud.scan is None
    assert len(cloud) == 1200
    np.testing.assert_allclose(cloud.points_world()[400:800], POINTS, atol=1e-6)
    np.testing.assert_array_equal(cloud.stations, [np.zeros(3), moved])
    assert "only 2 of 3 scans contain a scanner position" in read.warnings


# Stations


def test_view_from_is_used_without_a_scanner_position(tmp_path: Path, read: ScanReader) -> None:
    cloud = read(write_text(tmp_path / "a.xyz", POINTS), view_from=[1.0, 2, 3.5], unit="ft")
    np.testing.assert_array_equal(cloud.stations, [[1.0, 2.0, 3.5]])
    assert cloud.stations_source == "view_from"
    scan = scan_files.write_e57(tmp_path / "a.e57", [{"fields": scan_files.cartesian(POINTS)}])
    cloud = read(scan, view_from=[1.0, 2.0, 3.5])
    assert cloud.stations_source == "file"
    assert "view_from has no effect" in read.warnings


# Intensity


def test_the_user_can_set_full_intensity(tmp_path: Path, read: ScanReader) -> None:
    table = np.column_stack([POINTS, np.arange(400)])
    cloud = read(write_text(tmp_path / "a.xyz", table), intensity_max=200.0)
    np.testing.assert_allclose(cloud.intensity, np.minimum(np.arange(400) / 200, 1), atol=1e-6)
    assert "199 intensities are outside 0 to 200 (intensity_max) and were clipped" in read.warnings
    with pytest.raises(InputError, match=r"intensity_field=Echo: no file has such a field; they"):
        read(tmp_path / "a.xyz", intensity_field="Echo")


def test_zero_intensity_and_colours_are_missing(tmp_path: Path, read: ScanReader) -> None:
    zeros = np.zeros((400, 3), np.int64)
    path = scan_files.write_las(tmp_path / "a.laz", POINTS, intensity=zeros[:, 0], rgb=zeros)
    cloud = read(path)
    assert cloud.intensity is None
    assert cloud.rgb is None
    assert cloud.source["intensity_source"] == "none"
    assert "the intensity of all points is zero and is treated as missing" in read.warnings
    assert "the colour of all points is zero" in read.warnings


def test_luminance_is_no_laser_intensity(tmp_path: Path, read: ScanReader) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (400, 3))
    grey = np.rint(rgb @ [0.299, 0.587, 0.114] * 257).astype(np.int64)
    cloud = read(scan_files.write_las(tmp_path / "a.laz", POINTS, intensity=grey, rgb=rgb * 256))
    assert cloud.intensity is None
    assert cloud.source["intensity_source"] == "luminance"
    assert "the intensity is not laser intensity but the luminance of the colours" in read.warnings
    # Grey colours computed from the intensity do not invalidate it.
    rgb = np.repeat(rgb[:, :1], 3, axis=1)
    path = scan_files.write_las(tmp_path / "b.laz", POINTS, intensity=rgb[:, 0] * 200, rgb=rgb)
    cloud = read(path)
    assert cloud.intensity is not None
    assert cloud.source["intensity_source"] == "laser"
    assert "they do not come from photos" in read.warnings


# The method as a whole


@pytest.mark.usefixtures("charts")
def test_a_picture_from_above_is_drawn(tmp_path: Path, read: ScanReader) -> None:
    read(write_text(tmp_path / "a.xyz", POINTS))
    (figure,) = read.ctx.figures
    assert figure.path.read_bytes().startswith(b"RIFF")  # WebP
    # A scan with rows and columns also has a view from the scanner.
    places = np.indices((8, 10)).reshape(2, -1).T * 0.1
    table = np.column_stack([places, np.ones(80), np.linspace(0.0, 1.0, 80)])
    read(scan_files.write_ptx(tmp_path / "a.ptx", [(table, 10, np.eye(4))]))
    assert [figure.name for figure in read.ctx.figures] == ["plan", "polar", "scan-lines"]


def test_too_little_scratch_space_is_said_before_anything_is_written(
    tmp_path: Path, read: ScanReader, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=1000))
    with pytest.raises(StoreError, match=r"400 points need 0\.00 GB of scratch space, but only"):
        read(scan_files.write_las(tmp_path / "a.laz", POINTS))


# Real scans


@pytest.mark.parametrize(
    ("name", "up", "n_points", "bounds", "fields"),
    [
        ("heritage-hall-west-wall/west_wall.laz", "z", 3_022_234,
         ([-3.459, -13.567, -1.101], [-1.500, 11.275, 3.894]), {"rgb"}),
        ("fountain-p11/cloud_from_photos.laz", "-z", 1_505_670,
         ([-23.064, -16.171, -5.829], [-10.970, -7.678, 1.821]), {"rgb"}),
        ("pump-e57/pumpAVisualReferenceImage.e57", "z", 155_201,
         ([-2.904, -5.301, -1.900], [1.722, -0.793, 1.843]),
         {"rgb", "intensity", "row", "column", "stations"}),
        ("lion-takanawa/lion_takanawa_1mm.laz", "z", 341_989,
         ([-4.985, 1.039, -3.445], [-0.789, 6.724, 1.124]), {"rgb"}),
        ("lion-takanawa/lion_takanawa.copc.laz", "z", 341_989,
         ([-4.99, 1.04, -3.45], [-0.79, 6.72, 1.12]), {"rgb"}),
        ("indoor-laz/indoor.laz", "y", 808_042,
         ([-22.99, -1.97, -7.90], [5.63, 7.55, 12.36]), set()),
        ("ceiling-808/808_db.ply", "z", 47_043,
         ([-2.289, -3.123, 1.431], [6.019, 7.651, 4.588]), {"rgb"}),
        ("ceiling-808/808-60.ply", "y", 211_368,
         ([8.090, 2.468, -4.472], [15.891, 5.822, 3.962]), {"rgb"}),
        ("tls-targets-sp1/T1.1.txt", "z", 12_174,
         ([-0.141, 5.283, -0.030], [0.001, 5.821, 0.115]), {"rgb", "intensity"}),
    ],
)  # fmt: skip
def test_real_scans_come_out_whole(
    shared_data: Path,
    read: ScanReader,
    name: str,
    up: str,
    n_points: int,
    bounds: tuple[list[float], list[float]],
    fields: set[str],
) -> None:
    cloud = read(shared_data / name, up=up)
    assert len(cloud) == n_points
    extremes = [(float(axis.min()), float(axis.max())) for axis in (cloud.x, cloud.y, cloud.z)]
    # The values in the README are rounded to a millimetre.
    np.testing.assert_allclose(np.array(extremes)[:, 0] + cloud.origin, bounds[0], atol=6e-4)
    np.testing.assert_allclose(np.array(extremes)[:, 1] + cloud.origin, bounds[1], atol=6e-4)
    optional = ("rgb", "intensity", "row", "column", "scan", "stations")
    assert {item for item in optional if getattr(cloud, item) is not None} == fields
    is_rounded = name.endswith(("indoor.laz", "copc.laz"))
    assert ("are rounded to 10 mm" in read.warnings) == is_rounded
    assert ("luminance of the colours" in read.warnings) == ("lion" in name)


FIELDS: tuple[PointField, ...] = ("intensity", "rgb", "grid")
HERE = np.array([634_512.25, 486_215.5, 101.75])


def block(seed: int, n: int, *, scan: int = 0, **more: object) -> PointBlock:
    rng = np.random.default_rng(seed)
    plain: dict[str, object] = {
        "points": HERE + rng.uniform(-5.0, 5.0, (n, 3)),
        "scan": scan,
        "n_read": n,
        "intensity": rng.uniform(0.0, 2048.0, n).astype(np.float32),
        "rgb": rng.integers(0, 256, (n, 3)).astype(np.uint8),
        "row": rng.integers(0, 3000, n),
        "column": rng.integers(0, 3000, n),
    }
    return PointBlock(**(plain | more))  # type: ignore[arg-type]


def file(name: str, *blocks: PointBlock, fields: Sequence[PointField] = FIELDS) -> ScanFile:
    n_scans = max(one.scan for one in blocks) + 1
    return ScanFile(
        name=name,
        format_name="toy",
        n_most=sum(len(one.points) for one in blocks),
        scans=[Scan(fields=frozenset(fields)) for _ in range(n_scans)],
        read=lambda: iter(blocks),
    )


def assembled(
    folder: Path, *files: ScanFile, unit_m: float = 1.0, box_m: NDArray[np.float64] | None = None
) -> CloudAssembly:
    folder.mkdir(exist_ok=True)
    growing = CloudAssembly(context(folder), list(files), lambda _: np.full(3, unit_m), box_m)
    for one in files:
        growing.add_file(one)
    return growing


def dirtied(clean: PointBlock) -> PointBlock:
    """Return a block with each kind of unusable point."""
    points = clean.points.copy()
    points[3, 1] = np.nan
    points[5, 2] = np.inf
    points[7, 0] = -2e9
    points[8, 2] = 1e9
    assert clean.intensity is not None
    intensity = clean.intensity.copy()
    intensity[0], intensity[1] = np.nan, np.inf
    return replace(clean, points=points, intensity=intensity)


@pytest.mark.parametrize("unit_m", [1.0, 0.001])
@pytest.mark.parametrize("has_box", [False, True])
def test_blocks_are_assembled_in_full(tmp_path: Path, unit_m: float, *, has_box: bool) -> None:
    first, second, third = block(1, 40), dirtied(block(2, 30, scan=1)), block(3, 20)
    blocks = [replace(one, points=one.points / unit_m) for one in (first, second, third)]
    box_m = np.array([HERE - 2.0, HERE + 4.0]) if has_box else None
    found = assembled(
        tmp_path, file("a", *blocks[:2]), file("b", blocks[2]), unit_m=unit_m, box_m=box_m
    )
    points = np.vstack([one.points for one in blocks]) * unit_m
    usable = (np.abs(points) < 1e9).all(axis=1)
    inside = usable.copy()
    if box_m is not None:
        with np.errstate(invalid="ignore"):
            inside &= ((points >= box_m[0]) & (points <= box_m[1])).all(axis=1)
    assert 0 < inside.sum() <= usable.sum() == len(points) - 4
    of_first = np.arange(len(points)) < 40
    own = inside[of_first]
    # The origin is in whole metres near the first usable points.
    origin = np.floor(np.median(points[of_first][own], axis=0))
    np.testing.assert_array_equal(found.origin, origin)
    assert found.n_points == inside.sum()
    expected = (points[inside] - origin).astype(np.float32)
    np.testing.assert_array_equal(np.column_stack(found.offsets), expected)
    for name in ("row", "column", "intensity"):
        values = np.concatenate([getattr(one, name) for one in blocks])[inside]
        np.testing.assert_array_equal(found.array(name), values)
    np.testing.assert_array_equal(
        found.array("rgb"), np.vstack([one.rgb for one in blocks if one.rgb is not None])[inside]
    )
    scans = np.repeat([0, 1, 2], [40, 30, 20])
    np.testing.assert_array_equal(found.array("scan"), scans[inside])
    for scan, count in enumerate(found.counts):
        mine = scans == scan
        assert (count.n_read, count.n_kept) == (mine.sum(), inside[mine].sum())
        assert count.left_out["outside_box"] == np.count_nonzero(usable[mine] & ~inside[mine])
        np.testing.assert_array_equal(scans[inside][count.start : count.stop], scan)
    assert [count.left_out["not_finite"] for count in found.counts] == [0, 2, 0]
    assert [count.left_out["too_far"] for count in found.counts] == [0, 2, 0]
    assert found.counts[1].first_far_m == pytest.approx(tuple(points[47]))


def test_a_file_without_a_point_that_can_be_used_is_refused_with_its_counts(tmp_path: Path) -> None:
    lost = block(
        1, 4, points=np.full((4, 3), np.nan), n_read=9, left_out={"invalid": 3, "withheld": 2}
    )
    with pytest.raises(InputError) as caught:
        assembled(tmp_path, file("a", lost))
    assert str(caught.value) == (
        "a contains no usable points: all 9 were left out (3 invalid, 2 withheld, 4 not finite); "
        "export it again"
    )


def test_more_points_than_a_header_states_are_refused(tmp_path: Path) -> None:
    short = replace(file("a", block(1, 10), block(2, 10)), n_most=19)
    with pytest.raises(InputError, match=r"^a contains more points than its header declares$"):
        assembled(tmp_path, short)
    exact = replace(short, n_most=20)
    assert assembled(tmp_path / "exact", exact).n_points == 20


# --- how coordinates are rounded ---


@pytest.mark.parametrize("step", [0.005, 0.01, 0.02, 0.05, 0.1, 0.5, 1.0, 100.0, 0.0078125, 8.0])
def test_a_coarse_step_is_found(step: float) -> None:
    rng = np.random.default_rng(7)
    rounded = step * rng.integers(0, 1000, (3000, 3)) + 12.0 * step
    assert rounding_m(rounded, 1.0) == pytest.approx(step)
    if step in (0.005, 0.01, 0.02, 0.05, 0.1, 0.5):
        # This also works in millimetres, where half a metre is the coarsest step tested.
        assert rounding_m(1000.0 * rounded, 0.001) == pytest.approx(step)


Range = tuple[float, float]


@pytest.mark.parametrize(
    ("seen", "stated", "intensity_max", "scale"),
    [
        ((2.0, 9.0), (0.0, 10.0), 50.0, (0.0, 50.0, "intensity_max")),
        ((2.0, 9.0), (0.0, 10.0), None, (0.0, 10.0, "stated")),
        # An excess of a millionth is rounding; more means another scale.
        ((-0.000_005, 10.000_005), (0.0, 10.0), None, (0.0, 10.0, "stated")),
        ((0.0, 10.000_02), (0.0, 10.0), None, (0.0, 10.000_02, "data")),
        ((-0.000_02, 10.0), (0.0, 10.0), None, (-0.000_02, 10.0, "data")),
        # If the data use less than a quarter of the limits, the limits are those of the sensor.
        ((0.0, 2.49), (0.0, 10.0), None, (0.0, 2.49, "data")),
        ((0.0, 2.51), (0.0, 10.0), None, (0.0, 10.0, "stated")),
        ((2.0, 9.0), None, None, (2.0, 9.0, "data")),
        ((7.0, 7.0), None, None, (0.0, 7.0, "data")),
        ((-7.0, -7.0), None, None, (-7.0, 0.0, "data")),
    ],
)
def test_a_scan_has_the_users_scale_the_one_it_states_or_that_of_its_data(
    seen: Range, stated: Range | None, intensity_max: float | None, scale: tuple[float, float, str]
) -> None:
    (found,) = choose_scales([seen], [stated], intensity_max)
    assert found is not None
    assert (found.low, found.high, found.rule) == scale
    assert found.stated == (stated if scale[2] == "data" else None)


def test_each_scan_is_scaled_by_its_own_limits_and_similar_ones_together() -> None:
    ranges = [(0.1, 0.9), (7000.0, 60000.0), None, (0.0, 255.0), (5.0, 200.0), (-2048.0, 2047.0)]
    ranges += [(0.0, 90000.0)]  # beyond its limits
    stated = [(0.0, 1.0), (0.0, 65535.0), (0.0, 1.0), None, None, None, (0.0, 65535.0)]
    scales = choose_scales(ranges, stated, None)
    assert scales[2] is None
    assert [(scale.low, scale.high) for scale in scales if scale is not None] == [
        *((0.0, 1.0), (0.0, 65535.0), (0.0, 255.0), (0.0, 255.0), (-2048.0, 2047.0)),
        (0.0, 90000.0),
    ]


def test_intensities_go_from_nought_to_one_and_what_lies_beyond_is_clipped_and_counted() -> None:
    scale = IntensityScale(low=10.0, high=30.0, rule="data")
    values = np.array([10.0, 20.0, 30.0, 5.0, 40.0, np.nan, np.inf, -np.inf])
    values = values.astype(np.float32)
    assert normalise(values, scale) == 2
    np.testing.assert_array_equal(values, [0.0, 0.5, 1.0, 0.0, 1.0, np.nan, np.nan, np.nan])
    # An excess of a millionth is not counted.
    near = np.array([30.0 + 1e-5, 10.0 - 1e-5], dtype=np.float64).astype(np.float32)
    assert normalise(near, scale) == 0
    np.testing.assert_array_equal(near, [1.0, 0.0])


def test_intensity_that_is_the_grey_of_the_colours_is_told_by_either_grey() -> None:
    rng = np.random.default_rng(1)
    rgb = rng.integers(0, 256, (500, 3), dtype=np.uint8)
    luma, mean = (rgb @ [0.299, 0.587, 0.114]).astype(np.float32), rgb.mean(axis=1)
    for grey in (luma, mean.astype(np.float32), 3.0 * luma + 5.0, np.rint(luma)):
        assert (scales.correlation_with_grey(grey, rgb) or 0.0) > 0.999
    assert scales.correlation_with_grey(rng.random(500).astype(np.float32), rgb) is None
    # A scene of two colours correlates with any intensity, so differences beyond rounding decide.
    rgb = np.where(rng.random((500, 1)) < 0.5, 200, 50).astype(np.uint8).repeat(3, axis=1)
    laser = rgb[:, 0] / 255.0 + rng.normal(0.0, 0.005, 500)
    assert scales.correlation_with_grey(laser.astype(np.float32), rgb) is None


def stored(*blocks: np.ndarray, limit: float | None = None) -> tuple[list[list[int]], str | None]:
    count = sum(map(len, blocks))
    into = np.zeros((count, 3), dtype=np.uint8)
    scale = ColourScale(into, limit)
    for block in blocks:
        scale.add(block)
    return into.tolist(), scale.scale


def test_colours_are_of_the_widest_scale_that_any_block_shows() -> None:
    unit = np.array([[0.0, 0.5, 1.0]], dtype=np.float32)
    byte = np.array([[0.0, 128.0, 255.0]], dtype=np.float32)
    word = np.array([[0, 128 * 257, 255 * 256]], dtype=np.uint16)
    assert stored(unit) == ([[0, 128, 255]], "0..1")
    assert stored(byte) == ([[0, 128, 255]], "8 bit")
    assert stored(word) == ([[0, 128, 255]], "16 bit")
    # Zeros and ones are full brightness until a block shows that the scale is 255.
    ones = np.array([[0.0, 1.0, 1.0]], dtype=np.float32)
    assert stored(ones) == ([[0, 255, 255]], "0..1")
    assert stored(ones, byte) == ([[0, 1, 1], [0, 128, 255]], "8 bit")
    # Values below 256 of 65536 are almost black.
    assert stored(byte, word) == ([[0, 0, 1], [0, 128, 255]], "16 bit")
    assert stored(word, byte) == ([[0, 128, 255], [0, 0, 0]], "16 bit")
    assert stored(byte, unit) == ([[0, 128, 255], [0, 0, 1]], "8 bit")
    # A stated limit also holds for dark colours.
    assert stored(np.array([[0.0, 360.0, 900.0]]), limit=65535.0) == ([[0, 1, 3]], "16 bit")
    # A few values beyond a scale do not change it.
    stray = np.repeat(byte, 2000, axis=0)
    stray[7, 0] = 300.0
    assert stored(stray)[1] == "8 bit"


@pytest.mark.parametrize(
    ("largest", "limit", "expected", "scale"),
    [
        (1.0, 1.0, [0, 102, 255], "0..1"),
        (255.0, 255.0, [0, 102, 255], "8 bit"),
        (1023.0, 1023.0, [0, 102, 255], "stated limit"),
        (1023.0, None, [0, 102, 255], "10 bit"),
        (4095.0, None, [0, 102, 255], "12 bit"),
        (4095.0, 1023.0, [0, 102, 255], "12 bit"),
        # Data that do not fit the limit are scaled by their values.
        (255.0, 1.0, [0, 102, 255], "8 bit"),
        (65535.0, 255.0, [0, 102, 255], "16 bit"),
    ],
)
def test_a_stated_limit_is_full_brightness_where_data_fit_it(
    largest: float, limit: float | None, expected: list[int], scale: str
) -> None:
    block = np.array([[0.0, 0.4 * largest, largest]])
    assert stored(block, limit=limit) == ([expected], scale)
    colours = ColourScale(np.zeros((1, 3), dtype=np.uint8), limit)
    colours.add(block)
    assert colours.misfit == (limit if limit != largest else None)


def pixels(encoded: bytes | None) -> NDArray[np.uint8]:
    assert encoded is not None
    return np.asarray(cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED))


# --- view from above ---


def test_a_plan_is_as_bright_as_the_logarithm_of_its_points() -> None:
    # The cloud is a grid of 2 m x 1 m with one point per pixel, and seven more points at one
    # position.
    x, y = np.meshgrid(np.arange(640) / 320.0, np.arange(320) / 320.0)
    grid = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    crowd = np.tile([1.6, 0.8, 3.0], (7, 1))
    shown, frame = plan_view(cloud_of(np.concatenate([grid, crowd])))
    # The outermost thousandth is omitted.
    assert shown.shape[1] == 640
    assert shown.shape[0] == pytest.approx(320, abs=2)
    values, counts = np.unique(shown, return_counts=True)
    # Pixels have one point, or two or none because of rounding; the dense pixel has eight or nine.
    assert shown.max() == 255
    row, column = np.unravel_index(shown.argmax(), shown.shape)
    assert column / 639 == pytest.approx(0.8, abs=0.01)
    # Row 0 is at the top, so this is four fifths up.
    assert 1.0 - row / (len(shown) - 1) == pytest.approx(0.8, abs=0.01)
    # The centre of that pixel is the dense position, in world metres.
    place = frame.raster_from_wall(np.array([[column + 0.5, row + 0.5]]))[0]
    np.testing.assert_allclose(place, [1.6, 0.8], atol=0.004)
    assert frame.raster_axes == "level"
    single = values[counts.argmax()]
    crowded = {round(255.0 * np.log(2.0) / np.log(1.0 + n)) for n in (8, 9, 10)}
    assert int(single) in crowded


# --- view from the scanner ---


def scanned(rows: int = 20, columns: int = 30) -> PointCloud:
    """Return a scan of a cylinder from its axis; row 0 is lowest, columns run left from east."""
    row, column = (grid.ravel() for grid in np.mgrid[:rows, :columns])
    azimuth, elevation = np.radians(3.0 * column), np.radians(2.0 * (row - 9.5))
    points = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
    cloud = cloud_of(points, stations=np.zeros((1, 3)))
    return replace(
        cloud,
        row=row.astype(np.uint32),
        column=column.astype(np.uint32),
        intensity=(row / (rows - 1.0)).astype(np.float32),
    )


def expected_grey(cloud: PointCloud, rows: int, columns: int) -> NDArray[np.uint8]:
    """Return the brightness by row and column number."""
    assert cloud.intensity is not None
    values = np.full((rows, columns), np.nan)
    values[cloud.row, cloud.column] = cloud.intensity
    low, high = np.nanquantile(values, (0.01, 0.99))
    bright = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.where(np.isnan(values), 0.0, np.rint(32.0 + 223.0 * bright)).astype(np.uint8)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("upside_down", [False, True])
def test_a_scan_is_shown_as_its_station_saw_it(mirrored: bool, upside_down: bool) -> None:
    cloud = scanned()
    # One cell of the grid has no point, and there is an additional point next to it.
    column = np.where((cloud.row == 3) & (cloud.column == 4), 5, cloud.column)
    cloud = replace(cloud, column=column.astype(np.uint32))
    # Azimuth increases with the columns, to the left.
    truth = expected_grey(cloud, 20, 30)[::-1, ::-1]
    if mirrored:
        cloud = replace(cloud, column=29 - cloud.column)
    if upside_down:
        cloud = replace(cloud, row=19 - cloud.row)
    here = np.array([400.0, -300.0, 50.0])
    cloud = replace(cloud, origin=here, stations=here[None])
    shown = pixels(polar_view_png(cloud))
    assert np.abs(shown.astype(int) - truth).max() <= 1
    assert shown[16, 25] == 0


# --- rows and columns in rectangular coordinates ---
