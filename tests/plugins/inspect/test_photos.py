"""`inspect.truth` with cameras: errors of poses and of painted cells are just those put in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.inspect.truth import InspectTruth
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.geometry import frame_over
from orthoflow.geometry.scene_views import SceneCameras, TrueOrthoimage, Viewers, render_frame
from orthoflow.products import (
    Camera,
    Cameras,
    Orthoimage,
    OrthoMask,
    SurfaceMask,
    Truth,
)
from orthoflow.sdk import StepContext
from tests import samples, scenes
from tests.inspecting import BUFFER_M, inspect

GSD_M = 0.02

# Made once for all tests, by the truth that a fixture holds.
_RENDERED: dict[int, TrueOrthoimage] = {}
_PAINTED: dict[int, Orthoimage] = {}


def simulate(folder: Path, **params: object) -> Truth:
    folder.mkdir(parents=True, exist_ok=True)
    context = StepContext(rng=np.random.default_rng(3), cores=2, scratch=folder)
    chosen = SimulateRoom.Params.model_validate(
        {"scan_step_m": 0.1, "photo_layout": "quick", "photo_gsd_m": 0.02, **params}
    )
    return SimulateRoom().run(SimulateRoom.In(), chosen, context).truth


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    """A room in survey coordinates."""
    context = StepContext(
        rng=np.random.default_rng(3), cores=2, scratch=tmp_path_factory.mktemp("room")
    )
    params = SimulateRoom.Params(
        scan_step_m=0.1,
        photo_layout="quick",
        photo_gsd_m=0.02,
        shift_world_m=tuple(scenes.SURVEY_SHIFT_M.tolist()),
    )
    return SimulateRoom().run(SimulateRoom.In(), params, context).truth


def true_cameras(truth: Truth) -> Cameras:
    assert truth.cameras is not None
    return truth.cameras


def moved(camera: Camera, shift_world_m: np.ndarray) -> Camera:
    """The camera with its projection centre displaced."""
    rotation, translation = camera.rotation_camera_from_world, camera.translation_camera_from_world
    assert rotation is not None
    assert translation is not None
    return replace(camera, translation_camera_from_world=translation - rotation @ shift_world_m)


def rendered(truth: Truth) -> TrueOrthoimage:
    if id(truth) not in _RENDERED:
        _RENDERED[id(truth)] = _rendered(truth)
    return _RENDERED[id(truth)]


def _rendered(truth: Truth) -> TrueOrthoimage:
    frame = frame_over(truth.planes.corners[0], truth.planes.normal[0], gsd_m=GSD_M)
    viewers = Viewers(positions_world=np.unique(truth.stations, axis=0), up=truth.planes.up)
    return render_frame(
        truth.scene,
        frame,
        buffer_front_m=BUFFER_M,
        buffer_behind_m=BUFFER_M,
        viewers=viewers,
        cores=2,
    )


def painted(truth: Truth) -> Orthoimage:
    """Every cell that a photo sees, painted from the first photo that does."""
    if id(truth) not in _PAINTED:
        _PAINTED[id(truth)] = _painted(rendered(truth), truth)
    return _PAINTED[id(truth)]


def _painted(true: TrueOrthoimage, truth: Truth) -> Orthoimage:
    cameras = true_cameras(truth).cameras
    views = SceneCameras(truth.scene)
    rows, columns = np.nonzero(true.rectangle >= 0)
    places = np.column_stack([columns + 0.5, rows + 0.5])
    near = replace(true.frame, origin_world=true.frame.origin_world - truth.scene.origin)
    points = near.world_from_wall(places, true.depth_m[rows, columns].astype(np.float64))
    source = np.full(true.frame.shape, -1, dtype=np.int16)
    for index in reversed(range(len(cameras))):
        seen = views.sees(cameras[index].viewing(), points)
        source[rows[seen], columns[seen]] = index
    return Orthoimage(
        frame=true.frame,
        wall=0,
        name="main wall",
        rgb=np.nan_to_num(true.rgb).round().astype(np.uint8),
        mask=np.where(source >= 0, OrthoMask.PAINTED, OrthoMask.OCCLUDED).astype(np.uint8),
        source=source,
        sources=tuple(camera.photo for camera in cameras),
    )


def inspect_cameras(
    folder: Path,
    truth: Truth,
    cameras: Cameras,
    *,
    image: Orthoimage | None = None,
    lift_m: float = 0.0,
) -> tuple[dict[str, float], InspectTruth.Out, StepContext]:
    """Inspect an image, the true one unless given, on a wall whose depths are wrong by so much."""
    true = rendered(truth)
    shape = true.frame.shape
    wall = samples.wall(
        true.frame,
        name="main wall",
        depth_m=true.depth_m + np.float32(lift_m),
        sigma_m=np.full(shape, 0.001, dtype=np.float32),
        mask=np.where(true.rectangle >= 0, SurfaceMask.MEASURED, SurfaceMask.VOID).astype(np.uint8),
    )
    shown = painted(truth) if image is None else image
    return inspect(folder, truth, shown, wall, InspectTruth.Params(supersample=1), cameras=cameras)


def test_true_cameras_and_true_depths_have_no_error(tmp_path: Path, truth: Truth) -> None:
    metrics, out, context = inspect_cameras(tmp_path, truth, true_cameras(truth))
    assert metrics["n_photos"] == metrics["n_oriented"] == 6
    assert metrics["n_misoriented"] == 0
    # Millimetres: what is hidden by less than half a millimetre counts as seen.
    assert metrics["rmse_u_mm"] < 5e-3
    assert metrics["rmse_v_mm"] < 5e-3
    assert metrics["pose_centre_max_mm"] < 1e-5
    assert metrics["pose_rotation_max_deg"] < 1e-9
    assert metrics["pose_wall_max_mm"] < 1e-5
    assert metrics["ghost_share"] == 0.0
    assert metrics["completeness_seen_by_both"] == 1.0
    # The band at true depth steps is apart: there a hair decides what is hit.
    assert metrics["far_source_share"] < 0.002
    assert {"patch_rmse_u_mm", "step_rmse_u_mm", "step_rmse_v_mm"} <= metrics.keys()
    assert [figure.name for figure in context.figures][-1] == "wall_0_displacement"
    traced = out.inspection.kind == out.inspection.kinds.index("painted cell")
    assert np.count_nonzero(traced) > 1000


def test_shifted_cameras_shift_the_image_the_other_way(tmp_path: Path, truth: Truth) -> None:
    frame = rendered(truth).frame
    shift = 0.004 * frame.u_world - 0.002 * frame.v_world + 0.001 * frame.normal_world
    cameras = Cameras(cameras=tuple(moved(c, shift) for c in true_cameras(truth).cameras))
    metrics, out, _ = inspect_cameras(tmp_path, truth, cameras)
    assert metrics["pose_centre_max_mm"] == pytest.approx(1e3 * np.linalg.norm(shift), rel=1e-6)
    assert metrics["pose_rotation_max_deg"] < 1e-9
    # A camera believed to stand 4 mm too far right looks 4 mm too far left for each cell: what a
    # cell shows belongs 4 mm to its left. 1 mm in depth adds up to half of that at the borders.
    assert metrics["mean_u_mm"] == pytest.approx(4.0, abs=0.1)
    assert metrics["mean_v_mm"] == pytest.approx(-2.0, abs=0.1)
    assert metrics["rmse_u_mm"] == pytest.approx(4.0, abs=0.2)
    assert metrics["rmse_v_mm"] == pytest.approx(2.0, abs=0.2)
    # One coordinate in the wall: the mean square of 4 and 2 mm.
    assert metrics["pose_wall_rms_mm"] == pytest.approx(np.sqrt(10.0), abs=0.3)
    traced = out.inspection.kind == 1
    assert np.median(out.inspection.displacement_m[traced], axis=0) == pytest.approx(
        [0.004, -0.002], abs=2e-4
    )


def test_a_cell_painted_from_the_object_is_a_ghost(tmp_path: Path, truth: Truth) -> None:
    true = rendered(truth)
    fair = painted(truth)
    cameras = true_cameras(truth).cameras
    # The photo of the lower middle, in whose way the object stands, paints all it holds.
    middle = 1
    source = fair.source.copy()
    rows, columns = np.nonzero(true.rectangle >= 0)
    points = true.frame.world_from_wall(
        np.column_stack([columns + 0.5, rows + 0.5]), true.depth_m[rows, columns].astype(float)
    )
    camera = cameras[middle].viewing()
    inside = camera.sees(camera.project(points)[:, :2])
    source[rows[inside], columns[inside]] = middle
    mask = np.where(source >= 0, OrthoMask.PAINTED, OrthoMask.OCCLUDED).astype(np.uint8)
    metrics, _, _ = inspect_cameras(
        tmp_path, truth, true_cameras(truth), image=replace(fair, source=source, mask=mask)
    )
    # The object hides 1.2 m x 1.7 m or so of 16 m2 of wall from this photo.
    assert 0.1 < metrics["ghost_share"] < 0.15
    # In the middle of the object a ghost is of a place right before the wall's own.
    assert metrics["far_source_share"] > 0.1
    # Ghosts are counted apart; what relief hides stays in the error.
    assert metrics["nmad_u_mm"] < 1e-3


def test_a_stated_sigma_is_compared_with_the_error(tmp_path: Path, truth: Truth) -> None:
    frame = rendered(truth).frame
    shift = 0.003 * (frame.u_world + frame.v_world)
    good, *rest = (moved(c, shift) for c in true_cameras(truth).cameras)
    cameras = Cameras(
        cameras=(
            replace(good, sigma_wall_m=0.0001),
            *(replace(camera, sigma_wall_m=0.0015) for camera in rest),
        )
    )
    metrics, out, _ = inspect_cameras(tmp_path, truth, cameras)
    # Error over sigma: 30 for the first, 2 for five others; 30 is called wrong.
    assert metrics["n_misoriented"] == 1
    expected = np.sqrt((30.0**2 + 5 * 2.0**2) / 6)
    assert metrics["pose_error_over_sigma"] == pytest.approx(expected, rel=0.1)
    poses = out.inspection.details["poses"]
    assert isinstance(poses, list)
    assert isinstance(poses[0], dict)
    assert poses[0]["sigma_wall_mm"] == pytest.approx(0.1)
