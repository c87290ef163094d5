"""`inspect.checkpoints` finds points, measures their errors, and reports implausible ones."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect import checkpoints, point_doubts
from orthoflow_plugins.inspect.checkpoints import InspectCheckpoints
from orthoflow_plugins.inspect.findings import check_findings, outliers_at_once, outliers_iterated
from orthoflow_plugins.inspect.point_doubts import with_reasons
from orthoflow_plugins.inspect.point_places import ShownPoint
from orthoflow_plugins.plane.given import GivenPlane
from orthoflow_plugins.read.scan import ReadScan

from orthoflow.errors import MethodError
from orthoflow.products import CheckPoints, InputFiles, Inspection, Orthoimage, Orthoimages, Walls
from orthoflow.sdk import StepContext
from tests import inspect_scenes, samples
from tests.inspect_scenes import BUFFER_M, GSD_M, points_at
from tests.long_loops import long_only
from tests.method_runs import run
from tests.raster_scenes import context, peak_bytes, rastered


def inspect(
    folder: Path, points: CheckPoints, walls: Walls, image: Orthoimage | None = None
) -> tuple[dict[str, float], Inspection, StepContext]:
    images = None if image is None else Orthoimages(images=(image,))
    inputs: Any = {"checkpoints": points, "walls": walls, "orthoimages": images}
    return inspect_scenes.inspected(InspectCheckpoints, folder, **inputs)


PLACES = np.array([[50.0, 40.0], [200.0, 90.0], [300.0, 220.0], [120.0, 150.0]])


def surveyed(places: NDArray[np.float64] = PLACES) -> NDArray[np.float64]:
    return inspect_scenes.frame().world_from_wall(places, 0.01)


def shown(folder: Path, points: CheckPoints) -> tuple[dict[str, float], Inspection, StepContext]:
    return inspect(folder, points, inspect_scenes.walls(), inspect_scenes.displaced(0, 0))


def test_measured_points_give_their_residuals_by_class(tmp_path: Path) -> None:
    off = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, -2.0], [0.0, -2.0]])
    classes = ("flat", "flat", "vertical edge", "vertical edge")
    points = points_at(surveyed(), classes=classes, pixels=PLACES + off)
    metrics, found, ctx = shown(tmp_path, points)
    np.testing.assert_allclose(found.displacement_m, GSD_M * off, atol=1e-9)
    assert metrics["flat_rmse_x_mm"] == pytest.approx(1e3 * GSD_M)
    assert metrics["flat_rmse_y_mm"] == pytest.approx(0.0, abs=1e-6)
    assert metrics["vertical_edge_rms_mm"] == pytest.approx(2e3 * GSD_M)
    assert metrics["mean_y_mm"] == pytest.approx(-1e3 * GSD_M)
    assert metrics["flat_mean_shift_share"] == pytest.approx(1.0)
    assert metrics["n_found"] == metrics["n_points"] == 4
    assert [figure.name for figure in ctx.figures] == ["wall_0_residuals"]
    table: Any = found.details["points"]
    place = {"wall": 0, "u_px": 300.0, "v_px": 218.0, "x_mm": 0.0, "y_mm": -8.0}
    assert table[2] == {"name": "P2", "class": "vertical edge", "how": "measured", **place}


def test_points_that_no_picture_shows_are_told_with_the_reason(tmp_path: Path) -> None:
    frame, image = inspect_scenes.frame(), inspect_scenes.displaced(0, 0)
    places = np.array([[50, 40], [60, frame.height + 0.5], [-300, 9], [60, 60], [60, 60]])
    pixels = np.full((5, 2), np.nan)
    pixels[0] = places[0]
    depths_m = [0.0, 0.0, 0.0, BUFFER_M + 0.25, 0.0]
    points = points_at(frame.world_from_wall(places, depths_m), pixels=pixels)

    def missed(*wall: int) -> dict[str, Any]:
        numbered = replace(points, wall=np.array(wall, dtype=np.int32))
        metrics, _, ctx = shown(tmp_path, numbered)
        assert (metrics["n_points"], metrics["n_found"]) == (5, 1)
        (said,) = ctx.diagnostics
        assert said.code == "check-points-missed"
        return said.values

    assert "P2 (there is no orthoimage of wall 7)" in missed(0, 0, 7, 0, 0)["reasons"]
    found = missed(0, -1, -1, -1, -1)
    assert (found["n_missed"], found["n_points"]) == (4, 5)
    assert found["reasons"] == (
        f"P1 (2 mm below {image.name}), P2 (1.2 m left of {image.name}), P3 (250 mm in "
        f"front of {image.name}, beyond its buffer), P4 (no black and white quadrant target was "
        f"recognised on {image.name})"
    )


def test_a_rule_that_runs_into_its_cap_says_so_in_words(tmp_path: Path) -> None:
    places = np.column_stack([np.linspace(40.0, 300.0, 20), np.linspace(40.0, 200.0, 20)])
    off = np.zeros((20, 2))
    off[:, 0] = np.append(np.full(12, 0.1), np.linspace(1.0, 2.0, 8))
    metrics, _, ctx = shown(tmp_path, points_at(surveyed(places), pixels=places + off))
    assert metrics["n_outliers_iterated_capped"] == 5
    (said,) = ctx.diagnostics
    assert (said.code, said.values["numbers"]) == (
        "outlier-rule-capped",
        "n_outliers_iterated_capped 5",
    )
    off[12:] = off[:8]
    metrics, _, ctx = shown(tmp_path, points_at(surveyed(places), pixels=places + off))
    assert metrics["n_outliers_iterated"] == 0
    assert ctx.warnings == []


def test_the_papers_numbers_for_points_fit_the_iterated_rule_only() -> None:
    # skarlatos2012, Table 1, point cloud: 30 points, RMS 4.39 cm, 2 outliers, 4.00 cm without.
    length = np.append(np.full(28, 0.0400), [0.0805, 0.0806])
    assert np.sqrt(np.mean(length**2)) == pytest.approx(0.0439, abs=5e-5)
    assert outliers_at_once(length).sum() == 0
    assert outliers_iterated(length).sum() == 2
    shift_m = length[:, None] * np.array([0.6, 0.8])
    found = {finding.name: finding.value for finding in check_findings(shift_m, 0.02)}
    assert found["rms_mm"] == pytest.approx(43.9, abs=0.05)
    assert found["rms_after_iterated_mm"] == pytest.approx(40.0)
    assert found["rms_after_once_mm"] == pytest.approx(found["rms_mm"])
    assert found["n_outliers_iterated"] == 2


def test_what_is_not_found_is_said(tmp_path: Path) -> None:
    walls = inspect_scenes.walls()
    far = points_at(np.array([[50.0, 50.0, 50.0]]))
    with pytest.raises(
        MethodError, match=r"none of the 1 check points was found in an orthoimage: \S+ \(.* beyond"
    ):
        inspect(tmp_path, far, walls)
    with pytest.raises(MethodError, match="there is no image in which check points can be found"):
        inspect(tmp_path, far, inspect_scenes.walls(source="none"))


TLS_PATCHES = ("T1.1", "T1.2", "T1.3", "T2.1", "T2.2", "T2.3", "T3.1", "T3.2")


@pytest.mark.parametrize("names", [("T2.1", "T3.1"), *long_only((TLS_PATCHES,))], ids=len)
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
    """Return the intensity of a patch on its plane, scanned from the origin."""
    files = InputFiles(name="scan", paths=(path,))
    ctx = context(scratch)
    cloud = run(ReadScan, ctx, {"files": files}, view_from=(0.0, 0.0, 0.0)).cloud
    points = cloud.points_world()
    near = np.ones(len(points), dtype=np.bool_)
    for _ in range(10):
        middle = points[near].mean(axis=0)
        normal = np.linalg.svd(points[near] - middle, full_matrices=False)[2][2]
        off = (points - middle) @ normal
        near = np.abs(off) < max(4.0 * float(np.median(np.abs(off[near]))), 0.001)
    normal = -normal * np.sign(normal @ middle)
    given = {"normal": tuple(normal.tolist()), "offset_m": float(normal @ middle)}
    planes = run(GivenPlane, ctx, {"cloud": cloud}, **given).planes
    # The cell size is the point spacing.
    return rastered(cloud, planes, scratch, gsd_m=0.0013)[0]


@pytest.mark.parametrize("has_image", [False, True], ids=["intensity", "orthoimage"])
def test_points_are_measured_without_memory_per_cell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_image: bool
) -> None:
    where = inspect_scenes.frame(shape=(1600, 2000))
    n_cells = where.width * where.height
    for name, limit in (
        ("orthoflow.geometry.bands.BAND_CELLS", 1 << 17),
        ("orthoflow_plugins.inspect.figures.WHOLE_CELLS", 1 << 17),
        ("orthoflow_plugins.inspect.checkpoints.IN_MEMORY_CELLS", 1 << 17),
        ("orthoflow_plugins.inspect.figures.LONGEST_PX", 200),
        ("orthoflow_plugins.inspect.image_quality.TILE_CELLS", 256),
    ):
        monkeypatch.setattr(name, limit)
    grey = np.random.default_rng(1).random(where.shape, dtype=np.float32)
    wall = samples.wall(where, intensity=grey)
    image = inspect_scenes.image_of(255.0 * grey) if has_image else None
    place = np.array([[1000.5, 800.5]])
    points = points_at(where.world_from_wall(place), pixels=place + 0.25)
    inspect(tmp_path, points, inspect_scenes.walls(), inspect_scenes.displaced(0, 0))  # loaded
    with peak_bytes() as peak:
        metrics, _, _ = inspect(tmp_path, points, samples.walls(wall), image)
        assert peak() < 4.0 * n_cells
    assert metrics["mean_x_mm"] == pytest.approx(0.25e3 * GSD_M)


def test_points_that_are_carried_back_into_space_are_off_by_their_distance() -> None:
    places = ([1.0, 2.0, 3.0], [np.nan] * 3, [5.003, 6.0, 7.004])
    points = [ShownPoint(how="target", point_world=np.array(place)) for place in places]
    checks = points_at(np.array([[9.0, 9, 9], [1, 2, 3], [1, 1, 1], [5, 6, 7]]))
    found = checkpoints.findings_in_space(points, checks, [1, 2, 3])
    assert {item.name: (item.value, item.unit) for item in found} == {
        "n_3d": (2.0, "1"),
        "rms_3d_mm": (pytest.approx(np.sqrt(12.5)), "mm"),
        "max_3d_mm": (pytest.approx(5.0), "mm"),
    }
    assert checkpoints.findings_in_space(points[1:2], checks, [2]) == []


def test_points_without_a_class_are_check_points(tmp_path: Path) -> None:
    points = points_at(surveyed(PLACES[:3]), classes=("", "flat", ""), pixels=PLACES[:3])
    _, found, _ = inspect(tmp_path, points, inspect_scenes.walls())
    assert found.kinds == ("check point", "flat")
    assert found.kind.tolist() == [0, 1, 0]


def test_points_in_another_unit_are_told(tmp_path: Path) -> None:
    _, _, ctx = shown(tmp_path, points_at(surveyed(100.0 * PLACES), pixels=PLACES))
    (one,) = ctx.diagnostics
    assert (one.code, one.values["n"], one.values["n_points"]) == ("check-points-far", 4, 4)


def test_what_was_shown_holds_for_cells_of_any_size(tmp_path: Path) -> None:
    off = np.array([[1.5, 0.0], [1.5, 0.0], [0.0, -2.0], [0.0, -2.0]])
    clicked = inspect_scenes.frame().world_from_wall(PLACES + off, 0.02)
    points = points_at(surveyed(), pixels=np.full((4, 2), np.nan))
    metrics, _, ctx = shown(tmp_path, replace(points, shown_world=clicked))
    assert ctx.diagnostics == []
    assert metrics["n_found"] == 4
    assert metrics["mean_x_mm"] == pytest.approx(0.75e3 * GSD_M)
    assert metrics["mean_y_mm"] == pytest.approx(-1e3 * GSD_M)


def test_clicked_points_that_nobody_surveyed_are_no_check(tmp_path: Path) -> None:
    points = points_at(surveyed(), pixels=np.full((4, 2), np.nan))
    own = surveyed()
    with pytest.raises(MethodError, match="enter the surveyed coordinates"):
        shown(tmp_path, replace(points, shown_world=own))
    own[3, 0] += 0.001
    metrics, _, ctx = shown(tmp_path, replace(points, shown_world=own))
    (one,) = ctx.diagnostics
    assert (one.code, one.values["n"]) == ("check-points-of-the-image", 3)
    assert metrics["n_found"] == 4


@pytest.mark.parametrize("side", [(-1.0, 0.3), (2.0, 0.3), (0.3, -1.0), (0.3, 2.0)])
def test_points_are_far_beyond_the_length_of_their_wall(side: tuple[float, float]) -> None:
    image = inspect_scenes.displaced(0, 0)
    picture: Any = SimpleNamespace(frame=image.frame)
    rows, columns = image.frame.shape
    for further, is_far in ((0.95, False), (1.05, True)):
        off = further * max(rows, columns)
        place = [
            -off if part < 0.0 else size + off if part > 1.0 else part * size
            for part, size in zip(side, (columns, rows), strict=True)
        ]
        point: Any = SimpleNamespace(expected=np.array(place))
        expected = GSD_M * off if is_far else 0.0
        assert point_doubts.beyond_wall_m(point, picture) == pytest.approx(expected)
    assert point_doubts.beyond_wall_m(point, None) == 0.0


def test_four_unused_points_are_named_and_the_others_counted() -> None:
    missed = {f"P{k}": "2 mm below wall" for k in range(6)}
    named = "P0 (2 mm below wall), P1 (2 mm below wall), P2 (2 mm below wall), P3 (2 mm below wall)"
    assert with_reasons(missed) == f"{named} and 2 more, see the log"
    assert with_reasons(dict([*missed.items()][:4])) == named
