"""Simulated buildings with curved walls: points and truth agree, without and with errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from orthoflow_plugins.simulate.curved import SimulateCurved
from orthoflow_plugins.simulate.curved_model import Subject

from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.geometry.surfaces import Cylinder, Sphere, angles_around
from orthoflow.testing import Trial, run_trial


@pytest.mark.parametrize("subject", get_args(Subject))
def test_exact_points_are_on_the_true_surfaces(subject: Subject, tmp_path: Path) -> None:
    exact: dict[str, Any] = {"noise_m": 0.0, "outlier_share": 0.0, "beam_m": 0.0}
    params = {"subject": subject, "scan_step_m": 0.1, "shift_world_m": (4e6, 0, 9.0)} | exact
    out = run_trial(Trial(method=SimulateCurved, inputs={}, params=params), tmp_path).outputs
    points, truth = out["cloud"].points_world(), out["truth"]
    truth.surfaces.check_against({"cloud": out["cloud"]})
    on_any = np.zeros(len(points), dtype=np.bool_)
    for surface in truth.surfaces.surfaces:
        shape = surface.shape
        on = np.abs(shape.distances_m(points)) < 1e-4
        if isinstance(shape, Sphere):
            angles = np.zeros(np.count_nonzero(on))
            cosines = (points[on] - shape.centre_world) @ surface.axis_world / shape.radius_m
            along = shape.radius_m * np.arccos(np.clip(cosines, -1.0, 1.0))
        else:
            start = shape.point_world if isinstance(shape, Cylinder) else shape.apex_world
            angles = angles_around(points[on], start, shape.axis_world, surface.zero_world)
            along = (points[on] - start) @ shape.axis_world
        inside = (angles > surface.arc_rad[0] - 1e-6) & (angles < surface.arc_rad[1] + 1e-6)
        inside &= (along > surface.along_m[0] - 1e-3) & (along < surface.along_m[1] + 1e-3)
        assert surface.n_points <= np.count_nonzero(inside) <= 1.02 * surface.n_points + 5
        assert surface.n_points > 300
        on_any |= on
    on_plane = truth.labels >= 0
    distances = points @ truth.planes.normal.T - truth.planes.offset
    assert np.abs(distances[on_plane, truth.labels[on_plane]]).max() < 1e-4
    assert (on_any | on_plane).mean() > 0.75


def test_photos_of_a_vault_show_it(tmp_path: Path) -> None:
    params = {"scan_step_m": 0.2, "photo_gsd_m": 0.02}
    run = run_trial(Trial(method=SimulateCurved, inputs={}, params=params), tmp_path)
    (vault,) = run.outputs["truth"].surfaces.surfaces
    scene = SceneCameras(run.outputs["truth"].scene)
    cameras = run.outputs["cameras"].cameras
    assert len(cameras) == len(run.outputs["photos"].photos) >= 9
    for camera in cameras:
        lens = camera.intrinsics
        pose = camera.rotation_camera_from_world, camera.translation_camera_from_world
        seen = scene.trace(lens.posed(*pose), np.array([[lens.cx, lens.cy]]))
        assert 0.0 <= vault.shape.distances_m(seen.points)[0] + 1e-9 < 0.07
