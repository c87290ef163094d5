"""`inspect.truth` measures known errors exactly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.inspect import plane_errors
from orthoflow_plugins.inspect.truth import InspectTruth
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.errors import MethodError
from orthoflow.geometry import frame_over
from orthoflow.geometry.scene_views import TrueOrthoimage, render
from orthoflow.products import (
    Cameras,
    Inspection,
    Orthoimage,
    Orthoimages,
    OrthoMask,
    PointCloud,
    PointLabels,
    Truth,
    Wall,
)
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms
from tests import inspect_scenes, samples, scenes
from tests.inspect_scenes import BUFFER_M, inspected
from tests.method_runs import run
from tests.raster_scenes import context, peak_bytes

GSD_M = 0.017

# True orthoimages, rendered once for all tests, by displacement.
_RENDERED: dict[tuple[float, float], TrueOrthoimage] = {}


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    ctx = context(tmp_path_factory.mktemp("room"))
    made = run(SimulateRoom, ctx, {}, scan_step_m=0.05, photo_layout="none")
    return made.truth  # type: ignore[no-any-return]


def rendered(truth: Truth, shift_cells: tuple[float, float] = (0.0, 0.0)) -> TrueOrthoimage:
    """Return the true orthoimage of the main wall, with its content displaced along u and v."""
    if shift_cells not in _RENDERED:
        frame = frame_over(truth.planes.corners[0], truth.planes.normal[0], gsd_m=GSD_M)
        displacement = shift_cells[0] * frame.u_world + shift_cells[1] * frame.v_world
        moved = replace(frame, origin_world=frame.origin_world - GSD_M * displacement)
        image = render(truth.scene, moved, front_m=BUFFER_M, behind_m=BUFFER_M, cores=2)
        _RENDERED[shift_cells] = replace(image, frame=frame)
    return _RENDERED[shift_cells]


def painted(image: TrueOrthoimage) -> Orthoimage:
    known = image.rectangle >= 0
    return samples.orthoimage(
        image.frame,
        name="main wall",
        rgb=np.nan_to_num(image.rgb).round().astype(np.uint8),
        mask=np.where(known, OrthoMask.PAINTED, OrthoMask.NO_SURFACE).astype(np.uint8),
        sources=("truth",),
    )


def walled(image: TrueOrthoimage) -> Wall:
    sigma_m = np.full(image.frame.shape, 0.001, dtype=np.float32)
    return samples.wall(image.frame, name="main wall", depth_m=image.depth_m, sigma_m=sigma_m)


def inspect(
    folder: Path, truth: Truth, image: Orthoimage, wall: Wall, **more: object
) -> tuple[dict[str, float], Inspection, StepContext]:
    walls = samples.walls(wall, up=truth.planes.up, intensity_source="laser", buffer_m=BUFFER_M)
    inputs = {"orthoimages": Orthoimages(images=(image,)), "walls": walls, "truth": truth}
    return inspected(InspectTruth, folder, **inputs, **more)


def test_the_true_orthoimage_has_no_error(tmp_path: Path, truth: Truth) -> None:
    image = rendered(truth)
    both = {"planes": truth.planes, "labels": PointLabels(plane_index=truth.labels)}
    metrics, found, ctx = inspect(tmp_path, truth, painted(image), walled(image), **both)
    nothing = ("plane_angle_deg", "plane_offset_mm", "depth_rmse_mm", "depth_step_rmse_mm")
    assert [metrics[name] for name in nothing] == pytest.approx([0.0] * 4, abs=1e-6)
    # There is only the error of rounding to whole grey levels, sqrt(1 / 12).
    assert metrics["colour_rmse_grey"] == pytest.approx(0.289, abs=0.01)
    assert max(metrics["rmse_u_mm"], metrics["rmse_v_mm"]) < 0.05 * 1e3 * GSD_M
    for name in ("depth_within_3sigma", "completeness", "label_f1_mean", "label_iou_mean"):
        assert metrics[name] == 1.0, name
    assert metrics["true_planes_found"] == metrics["true_planes"] == len(truth.planes)
    assert len(found.displacement_m) == metrics["n_patches"] > 20
    drawn = [figure.name for figure in ctx.figures]
    assert drawn == ["wall_0_depth_error", "wall_0_colour_error"]


@pytest.mark.parametrize("shift", [(1.5, 0.0), (-0.6, 0.3)])
def test_a_displaced_orthoimage_has_just_that_displacement(
    tmp_path: Path, truth: Truth, shift: tuple[float, float]
) -> None:
    shown = painted(rendered(truth, shift))
    metrics, _, _ = inspect(tmp_path, truth, shown, walled(rendered(truth)))
    for axis, expected_cells in zip(("u", "v"), shift, strict=True):
        # The tolerance is a twentieth of a cell, because rosettes and lines are sharper than cells.
        tolerance = 0.05 * 1e3 * GSD_M
        expected = 1e3 * GSD_M * expected_cells
        assert metrics[f"mean_{axis}_mm"] == pytest.approx(expected, abs=tolerance)
        assert metrics[f"rmse_{axis}_mm"] == pytest.approx(abs(expected), abs=2.0 * tolerance)
    assert metrics["displaced_share"] < 0.1


def test_a_tilted_plane_has_its_angle_and_offset(tmp_path: Path, truth: Truth) -> None:
    image = rendered(truth)
    frame = image.frame
    centre = truth.planes.corners[0].mean(axis=0)
    turn = scenes.rotation_about(frame.v_world, 0.2)
    tilted = replace(
        frame,
        origin_world=centre + turn @ (frame.origin_world - centre) + 0.004 * frame.normal_world,
        u_world=turn @ frame.u_world,
        normal_world=turn @ frame.normal_world,
    )
    shown, wall = (replace(raster, frame=tilted) for raster in (painted(image), walled(image)))
    metrics, _, _ = inspect(tmp_path, truth, shown, wall)
    assert metrics["plane_angle_deg"] == pytest.approx(0.2, abs=1e-6)
    assert metrics["plane_offset_mm"] == pytest.approx(4.0, abs=1e-3)


def inspect_planes(folder: Path, truth: Truth, **inputs: Any) -> tuple[dict[str, float], list[str]]:
    """Return metrics and codes of diagnostics."""
    metrics, _, ctx = inspected(InspectTruth, folder, truth=truth, **inputs)
    return metrics, [one.code for one in ctx.diagnostics]


def test_labels_are_compared_point_by_point(tmp_path: Path, truth: Truth) -> None:
    n_points = len(truth.labels)
    chosen = np.random.default_rng(1).permutation(n_points)[: n_points // 2]
    x = np.zeros(n_points, dtype=np.float32)
    whole = PointCloud(origin=np.zeros(3), up=np.array([0.0, 0.0, 1.0]), x=x, y=x, z=x)
    labels = PointLabels(plane_index=truth.labels[chosen])
    # Points that a filter removes before the detection do not reduce the scores.
    given: dict[str, Any] = {"planes": truth.planes, "labels": labels}
    metrics, codes = inspect_planes(tmp_path, truth, **given, cloud=whole.selected(chosen))
    assert metrics["label_iou"] == metrics["label_iou_mean"] == 1.0
    assert codes == ["points-left-out-before-labels"]
    # Without the indices of the points, only the planes are compared.
    metrics, codes = inspect_planes(tmp_path, truth, **given)
    assert (metrics["main_found"], "label_iou" in metrics) == (1.0, False)
    assert codes == ["labels-not-compared"]


def test_a_missed_main_wall_is_reported(tmp_path: Path, truth: Truth) -> None:
    true = truth.planes
    near, far = true.offset.copy(), true.offset.copy()
    near[0] += 0.004
    far[0] += 0.4
    metrics, _ = inspect_planes(tmp_path, truth, planes=replace(true, offset=near))
    assert metrics["plane_offset_mm"] == pytest.approx(4.0, abs=1e-6)
    assert metrics["worst_plane_offset_mm"] == pytest.approx(4.0, abs=1e-6)
    assert metrics["plane_angle_deg"] < 1e-5
    lost, codes = inspect_planes(tmp_path, truth, planes=replace(true, offset=far))
    assert codes == ["main-wall-missed"]
    assert lost["main_found"] == 0.0
    assert lost["true_planes_found"] == len(true) - 1
    assert "plane_angle_deg" not in lost
    with pytest.raises(MethodError, match="nothing to inspect: connect orthoimages and walls, or"):
        inspect_planes(tmp_path, truth)
    with pytest.raises(MethodError, match="no orthoimage to inspect"):
        inspect_planes(tmp_path, truth, orthoimages=Orthoimages(images=()), walls=samples.walls())


def test_what_is_wired_and_not_compared_is_told(tmp_path: Path, truth: Truth) -> None:
    given: Any = {"truth": truth, "planes": truth.planes, "cameras": Cameras(cameras=())}
    _, _, ctx = inspected(InspectTruth, tmp_path, **given)
    (one,) = ctx.diagnostics
    assert (one.code, one.values["dropped"]) == ("truth-not-compared", "cameras")
    image = rendered(truth)
    _, _, ctx = inspect(tmp_path, truth, painted(image), walled(image), cameras=given["cameras"])
    (one,) = ctx.diagnostics
    assert (one.code, one.values["names"]) == ("truth-not-traced", "truth")


def finer(times: int) -> dict[str, Any]:
    """Return the scene of `truth_inputs` with cells that are smaller by the factor `times`."""
    given = inspect_scenes.truth_inputs()
    (image,), (wall,) = given["orthoimages"].images, given["walls"].walls
    height, width = (times * size for size in image.frame.shape)
    frame = replace(image.frame, gsd_m=image.frame.gsd_m / times, width=width, height=height)

    def larger(raster: Orthoimage | Wall, *names: str) -> Any:
        arrays = {name: getattr(raster, name) for name in names}
        for axis in (0, 1):
            arrays = {name: np.repeat(array, times, axis) for name, array in arrays.items()}
        return replace(raster, frame=frame, **arrays)

    return {
        "truth": given["truth"],
        "orthoimages": Orthoimages(images=(larger(image, "rgb", "mask", "source"),)),
        "walls": samples.walls(larger(wall, "depth_m", "sigma_m", "count", "mask")),
    }


def test_bands_of_a_wall_give_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    lens = {"width": 900, "height": 640, "fx": 1200.0, "fy": 1200.0, "cx": 450.0, "cy": 320.0}
    true, found = (
        ms.cameras(
            ms.oriented(samples.camera(rotation, np.array([x, -1.9, 0.4]), **lens), name="photo")
        )
        for x in (0.6, 0.603)
    )
    monkeypatch.setattr("orthoflow_plugins.inspect.truth.SUPERSAMPLE", 1)
    given = finer(2)
    inputs = given | {"truth": replace(given["truth"], cameras=true), "cameras": found}

    def outcome() -> tuple[dict[str, float], Inspection]:
        return inspected(InspectTruth, tmp_path, **inputs)[:2]

    whole, at_once = outcome()
    assert whole["mean_u_mm"] == pytest.approx(3.0, abs=0.3)
    assert whole["n_traced"] > 13_000
    # The photo's image of a chair in front of the wall is painted on the wall behind it.
    image, wall = given["orthoimages"].images[0], given["walls"].walls[0]
    painted = np.argwhere((image.mask == OrthoMask.PAINTED) & np.isfinite(wall.depth_m))
    cells = image.frame.world_from_wall(painted[:, ::-1] + 0.5, wall.depth_m[tuple(painted.T)])
    way = cells - np.array([0.603, -1.9, 0.4])
    in_chair_plane = np.array([0.6, -1.9, 0.4]) + way * (1.5 / way[:, 1:2])
    off = np.abs(in_chair_plane[:, [0, 2]] - np.array([0.88, 0.16]))
    n_hidden = np.count_nonzero((off <= [0.08, 0.16]).all(axis=1))
    assert n_hidden > 450
    assert whole["n_ghost_cells"] == pytest.approx(n_hidden, rel=0.02)
    assert 0.5 < whole["completeness_seen_by_both"] < 1.0
    monkeypatch.setattr("orthoflow_plugins.inspect.truth.BAND_CELLS", 1000)
    parts, in_bands = outcome()
    assert parts == {name: pytest.approx(value) for name, value in whole.items()}
    assert at_once.kinds == ("patch", "painted cell")
    for product in (at_once, in_bands):
        # If the camera is estimated 3 mm too far to the right, a cell shows a point 3 mm to its
        # left.
        cells = product.kind == 1
        assert 1000 < np.count_nonzero(cells) <= 5000
        assert np.median(product.displacement_m[cells, 0]) == pytest.approx(3e-3, abs=1e-4)
    patches = [product.points_world[product.kind == 0] for product in (at_once, in_bands)]
    np.testing.assert_allclose(*patches)
    # If not all errors are kept, every nth gives the same result.
    monkeypatch.setattr("orthoflow_plugins.inspect.cell_errors.MAX_KEPT_ERRORS", 4000)
    some, _ = outcome()
    assert some["n_traced"] == whole["n_traced"]
    for name in ("rmse_u_mm", "nmad_v_mm", "depth_median_mm", "depth_rmse_mm"):
        assert some[name] == pytest.approx(whole[name], rel=0.1), name


def test_walls_take_the_memory_of_a_band(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = finer(4)
    n_cells = inputs["orthoimages"].images[0].mask.size
    for name, value in (
        ("truth.SUPERSAMPLE", 1),
        ("truth.BAND_CELLS", 1000),
        ("cell_errors.COLOUR_CELLS", 20_000),
        ("cell_errors.MAX_KEPT_ERRORS", 5000),
        ("image_quality.TILE_CELLS", 128),
    ):
        monkeypatch.setattr(f"orthoflow_plugins.inspect.{name}", value)
    with peak_bytes() as peak:
        metrics, _, _ = inspected(InspectTruth, tmp_path, **inputs)
        # A band with its margin has half of the cells; the whole wall needed 174 bytes per cell.
        assert peak() < 110 * n_cells
    assert metrics["depth_median_mm"] == pytest.approx(1e3 * 2.0**-9, rel=1e-6)


def test_labels_are_scored_by_plane_whichever_number_they_have(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    three = samples.planes(
        normal=np.tile([0.0, 0.0, 1.0], (3, 1)),
        offset=np.arange(3.0),
        corners=np.zeros((3, 4, 3)),
        names=("floor 0", "floor 1", "floor 2"),
    )
    labels: Any = SimpleNamespace(plane_index=np.array([2, 2, -1, 0, 0, 0], dtype=np.int16))
    truth: Any = SimpleNamespace(labels=np.array([0, 0, 0, 1, 1, -1], dtype=np.int16), planes=three)
    scores = plane_errors.label_findings(labels, None, truth, ctx)
    found = {finding.name: finding.value for finding in scores}
    # The third plane has no points.
    expected = {
        "precision": (1.0, 2.0 / 3.0, 0.0),
        "recall": (2.0 / 3.0, 1.0, 0.0),
        "f1": (0.8, 0.8, 0.0),
        "iou": (2.0 / 3.0, 2.0 / 3.0, 0.0),
    }
    for score, values in expected.items():
        of_each = [found[f"label_{score}[floor {k}]"] for k in range(3)]
        assert of_each == pytest.approx(values), score
        assert found[f"label_{score}_mean"] == pytest.approx(sum(values) / 3.0), score
