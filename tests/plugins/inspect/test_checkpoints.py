"""`inspect.checkpoints` finds points, tells how far they lie off, and sums up as the paper did."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.inspect import checkpoints, figures
from orthoflow_plugins.inspect.checkpoints import InspectCheckpoints
from orthoflow_plugins.inspect.findings import (
    check_findings,
    outliers_at_once,
    outliers_iterated,
)
from orthoflow_plugins.inspect.point_places import ShownPoint
from orthoflow_plugins.plane.given import GivenPlane
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.read.scan import ReadScan

from orthoflow.errors import MethodError
from orthoflow.geometry import bands
from orthoflow.products import (
    CheckPoints,
    InputFiles,
    Inspection,
    Orthoimage,
    Orthoimages,
    Truth,
    Walls,
)
from orthoflow.sdk import StepContext
from tests import inspect_scenes, samples
from tests.inspect_scenes import BUFFER_M, GSD_M, points_at


def context(folder: Path) -> StepContext:
    return StepContext(rng=np.random.default_rng(0), cores=1, scratch=folder)


def inspect(
    folder: Path,
    points: CheckPoints,
    walls: Walls,
    image: Orthoimage | None = None,
    truth: Truth | None = None,
    **params: object,
) -> tuple[dict[str, float], Inspection, StepContext]:
    inputs = InspectCheckpoints.In(
        checkpoints=points,
        walls=walls,
        orthoimages=None if image is None else Orthoimages(images=(image,)),
        truth=truth,
    )
    ctx = context(folder)
    out = InspectCheckpoints().run(inputs, InspectCheckpoints.Params.model_validate(params), ctx)
    return {item.name: item.value for item in ctx.metrics}, out.inspection, ctx


def test_measured_points_give_their_residuals_by_class(tmp_path: Path) -> None:
    walls = inspect_scenes.walls()
    places = np.array([[50.0, 40.0], [200.0, 90.0], [300.0, 220.0], [120.0, 150.0]])
    surveyed = walls.walls[0].frame.world_from_wall(places, 0.01)
    off = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, -2.0], [0.0, -2.0]])
    points = points_at(
        surveyed, classes=("flat", "flat", "vertical edge", "vertical edge"), pixels=places + off
    )
    metrics, found, ctx = inspect(tmp_path, points, walls, inspect_scenes.displaced(0, 0))
    np.testing.assert_allclose(found.displacement_m, GSD_M * off, atol=1e-9)
    assert metrics["flat_rmse_x_mm"] == pytest.approx(1e3 * GSD_M)
    assert metrics["flat_rmse_y_mm"] == pytest.approx(0.0, abs=1e-6)
    assert metrics["vertical_edge_rms_mm"] == pytest.approx(2e3 * GSD_M)
    assert metrics["mean_y_mm"] == pytest.approx(-1e3 * GSD_M)
    assert metrics["flat_mean_shift_share"] == pytest.approx(1.0)
    assert metrics["n_found"] == metrics["n_points"] == 4
    assert [figure.name for figure in ctx.figures] == ["wall_0_residuals"]
    table = found.details["points"]
    assert isinstance(table, list)
    assert table[2] == {
        "name": "P2",
        "class": "vertical edge",
        "how": "measured",
        "wall": 0,
        "u_px": 300.0,
        "v_px": 218.0,
        "x_mm": 0.0,
        "y_mm": -8.0,
    }


def test_points_that_no_picture_shows_are_told_with_the_reason(tmp_path: Path) -> None:
    walls = inspect_scenes.walls()
    frame = walls.walls[0].frame
    places = np.array([[50.0, 40.0], [60.0, frame.height + 0.5], [-300.0, 9.0], [60.0, 60.0]])
    surveyed = frame.world_from_wall(places)
    surveyed[3] = frame.world_from_wall(places[3:], BUFFER_M + 0.25)[0]
    pixels = np.full((4, 2), np.nan)
    pixels[0] = places[0]
    points = points_at(surveyed, pixels=pixels)
    points = replace(points, wall=np.array([0, -1, -1, -1], dtype=np.int32))
    image = inspect_scenes.displaced(0, 0)
    elsewhere = replace(points, wall=np.array([0, 0, 7, 0], dtype=np.int32))
    _, _, ctx = inspect(tmp_path, elsewhere, walls, image)
    assert "P2 (there is no orthoimage of wall 7)" in ctx.warnings[0]
    metrics, _, ctx = inspect(tmp_path, points, walls, image)
    assert (metrics["n_points"], metrics["n_found"]) == (4, 1)
    (said,) = ctx.warnings
    assert said.startswith(
        f"3 of 4 check points are not used: P1 (2 mm below {image.name}), "
        f"P2 (1.2 m left of {image.name}), P3 (250 mm before {image.name}, beyond its buffer): "
    )
    assert "margin_m" in said


def test_points_that_are_no_targets_are_not_helped_by_larger_walls(tmp_path: Path) -> None:
    walls = inspect_scenes.walls()
    places = np.array([[50.0, 40.0], [60.0, 60.0]])
    pixels = np.full((2, 2), np.nan)
    pixels[0] = places[0]
    points = points_at(walls.walls[0].frame.world_from_wall(places), pixels=pixels)
    points = replace(points, wall=np.array([0, -1], dtype=np.int32))
    image = inspect_scenes.displaced(0, 0)
    _, _, ctx = inspect(tmp_path, points, walls, image)
    (said,) = ctx.warnings
    assert said == (
        "1 of 2 check points are not used: P1 (no black and white quadrant target was recognised "
        f"on {image.name}): measure them in an orthoimage"
    )


def test_a_rule_that_runs_into_its_cap_says_so_in_words(tmp_path: Path) -> None:
    walls = inspect_scenes.walls()
    places = np.column_stack([np.linspace(40.0, 300.0, 20), np.linspace(40.0, 200.0, 20)])
    surveyed = walls.walls[0].frame.world_from_wall(places, 0.01)
    off = np.zeros((20, 2))
    off[:, 0] = np.append(np.full(12, 0.1), np.linspace(1.0, 2.0, 8))
    image = inspect_scenes.displaced(0, 0)
    metrics, _, ctx = inspect(tmp_path, points_at(surveyed, pixels=places + off), walls, image)
    assert metrics["n_outliers_iterated_capped"] == 5
    (said,) = ctx.diagnostics
    assert (said.code, said.values["numbers"]) == (
        "outlier-rule-capped",
        "n_outliers_iterated_capped 5",
    )
    off[12:] = off[:8]
    metrics, _, ctx = inspect(tmp_path, points_at(surveyed, pixels=places + off), walls, image)
    assert metrics["n_outliers_iterated"] == 0
    assert ctx.warnings == []


def test_the_papers_numbers_for_points_fit_the_iterated_rule_only() -> None:
    # skarlatos2012, Table 1, point cloud: 30 points, RMS 4.39 cm, 2 outliers, 4.00 cm without.
    length = np.append(np.full(28, 0.0400), [0.0805, 0.0806])
    assert np.sqrt(np.mean(length**2)) == pytest.approx(0.0439, abs=5e-5)
    assert outliers_at_once(length).sum() == 0
    assert outliers_iterated(length).sum() == 2
    shift_m = length[:, None] * np.array([0.6, 0.8])
    numbers = {finding.name: finding.value for finding in check_findings(shift_m, 0.02)}
    assert numbers["rms_mm"] == pytest.approx(43.9, abs=0.05)
    assert numbers["rms_after_iterated_mm"] == pytest.approx(40.0)
    assert numbers["rms_after_once_mm"] == pytest.approx(numbers["rms_mm"])
    assert numbers["n_outliers_iterated"] == 2


def test_what_is_not_found_is_said(tmp_path: Path) -> None:
    walls = inspect_scenes.walls()
    far = points_at(np.array([[50.0, 50.0, 50.0]]))
    with pytest.raises(
        MethodError, match=r"none of the 1 check points was found in an orthoimage: \S+ \(.* beyond"
    ):
        inspect(tmp_path, far, walls)
    with pytest.raises(MethodError, match="there is no image in which to find check points"):
        inspect(tmp_path, far, inspect_scenes.walls(source="none"))


TLS_PATCHES = ("T1.1", "T1.2", "T1.3", "T2.1", "T2.2", "T2.3", "T3.1", "T3.2")


@pytest.mark.parametrize(
    "names",
    [
        pytest.param(("T2.1", "T3.1"), id="two"),
        pytest.param(
            TLS_PATCHES,
            id="all",
            marks=pytest.mark.long,
        ),
    ],
)
def test_targets_of_a_real_scan_are_found_and_carried_back_into_space(
    tmp_path: Path, shared_data: Path, names: tuple[str, ...]
) -> None:
    folder = shared_data / "tls-targets-sp1"
    centres = json.loads((folder / "target_centers_SP1.json").read_text())
    errors_mm = []
    for name in names:
        points = np.array([centres[name[:2]][int(name[3]) - 1]])
        walls = _intensity_of(folder / f"{name}.txt", tmp_path)
        metrics, _, _ = inspect(tmp_path, points_at(points), walls)
        assert metrics["n_3d"] == 1
        errors_mm.append(metrics["max_3d_mm"])
    assert max(errors_mm) <= 0.5
    assert np.sqrt(np.mean(np.square(errors_mm))) <= 0.3


def _intensity_of(path: Path, scratch: Path) -> Walls:
    """The intensity of a patch on the plane through it, scanned from the origin."""
    files = InputFiles(name="scan", paths=(path,))
    params = ReadScan.Params(view_from=(0.0, 0.0, 0.0))
    cloud = ReadScan().run(ReadScan.In(files=files), params, context(scratch)).cloud
    points = cloud.points_world()
    near = np.ones(len(points), dtype=np.bool_)
    for _ in range(10):
        middle = points[near].mean(axis=0)
        normal = np.linalg.svd(points[near] - middle, full_matrices=False)[2][2]
        off = (points - middle) @ normal
        near = np.abs(off) < max(4.0 * float(np.median(np.abs(off[near]))), 0.001)
    normal = -normal * np.sign(normal @ middle)
    given = GivenPlane.Params(
        normal=tuple(float(value) for value in normal), offset_m=float(normal @ middle)
    )
    planes = GivenPlane().run(GivenPlane.In(cloud=cloud), given, context(scratch)).planes
    # As fine as the points lie.
    grid = RasterGrid.Params(gsd_m=0.0013)
    return RasterGrid().run(RasterGrid.In(cloud=cloud, planes=planes), grid, context(scratch)).walls


@pytest.mark.parametrize("has_image", [False, True], ids=["intensity", "orthoimage"])
def test_points_are_measured_without_memory_per_cell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_image: bool
) -> None:
    where = inspect_scenes.frame(shape=(1600, 2000))
    n_cells = where.width * where.height
    for place in (bands, figures):
        name = "_BAND_CELLS" if place is bands else "_WHOLE_CELLS"
        monkeypatch.setattr(place, name, 1 << 17)
    monkeypatch.setattr("orthoflow_plugins.inspect.checkpoints.IN_MEMORY_CELLS", 1 << 17)
    monkeypatch.setattr("orthoflow_plugins.inspect.figures._LONGEST_PX", 200)
    monkeypatch.setattr("orthoflow_plugins.inspect.image_quality._TILE_CELLS", 256)
    grey = np.random.default_rng(1).random(where.shape, dtype=np.float32)
    wall = samples.wall(
        where,
        depth_m=np.zeros(where.shape, dtype=np.float32),
        sigma_m=np.zeros(where.shape, dtype=np.float32),
        count=np.ones(where.shape, dtype=np.uint32),
        mask=np.ones(where.shape, dtype=np.uint8),
        intensity=grey,
    )
    image = inspect_scenes.image_of(255.0 * grey) if has_image else None
    place = np.array([[1000.5, 800.5]])
    points = points_at(where.world_from_wall(place), pixels=place + 0.25)
    inspect(tmp_path, points, inspect_scenes.walls(), inspect_scenes.displaced(0, 0))  # loaded
    tracemalloc.start()
    try:
        metrics, _, _ = inspect(tmp_path, points, samples.walls(wall), image)
        assert tracemalloc.get_traced_memory()[1] < 4.0 * n_cells
    finally:
        tracemalloc.stop()
    assert metrics["mean_x_mm"] == pytest.approx(0.25e3 * GSD_M)


def shown_at(wall: int, place: list[float], point_world: list[float]) -> ShownPoint:
    return ShownPoint(
        how="target",
        wall=wall,
        expected=np.array([10.0, 20.0]),
        place=np.array(place),
        point_world=np.array(point_world),
    )


def test_points_that_are_carried_back_into_space_are_off_by_their_distance() -> None:
    nowhere = [np.nan] * 3
    points = [
        shown_at(0, [0.0, 0.0], [1.0, 2.0, 3.0]),
        shown_at(0, [0.0, 0.0], nowhere),
        shown_at(0, [0.0, 0.0], [5.003, 6.0, 7.004]),
    ]
    surveyed = points_at(np.array([[9.0, 9, 9], [1, 2, 3], [1, 1, 1], [5, 6, 7]]))
    found = checkpoints._findings_in_space(points, surveyed, [1, 2, 3])
    assert {item.name: (item.value, item.unit) for item in found} == {
        "n_3d": (2.0, "1"),
        "rms_3d_mm": (pytest.approx(np.sqrt(12.5)), "mm"),
        "max_3d_mm": (pytest.approx(5.0), "mm"),
    }
    assert checkpoints._findings_in_space(points[1:2], surveyed, [2]) == []


def test_points_without_a_class_are_check_points(tmp_path: Path) -> None:
    walls = inspect_scenes.walls()
    places = np.array([[50.0, 40.0], [200.0, 90.0], [300.0, 220.0]])
    points = points_at(
        walls.walls[0].frame.world_from_wall(places), classes=("", "flat", ""), pixels=places
    )
    _, found, _ = inspect(tmp_path, points, walls)
    assert found.kinds == ("check point", "flat")
    assert found.kind.tolist() == [0, 1, 0]
