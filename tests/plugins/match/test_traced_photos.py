"""Traced photos lie on the walls again as they lay there in the end."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from orthoflow_plugins.match.guided import MatchGuided, _laid_out, _rule
from orthoflow_plugins.match.traced_photos import TracedPhoto
from orthoflow_plugins.match.tracing import trace_photo

from orthoflow.products import Cameras
from orthoflow.testing.examples import example_inputs
from orthoflow.testing.trials import Trial, run_trial


def test_a_photo_is_laid_on_the_walls_again() -> None:
    inputs: Any = MatchGuided.In(**example_inputs(MatchGuided))
    desk, walls = _laid_out(inputs), inputs.walls.walls
    photo, camera = inputs.photos.photos[0], inputs.cameras.cameras[0].viewing()
    found = trace_photo(0, photo, camera, desk.targets, _rule(MatchGuided.Params(), 1), desk.before)
    assert found.n_ties
    kept = TracedPhoto.of(found, camera)
    again = kept.trace(photo, walls, desk.before)
    assert (again.n_ties, again.content, again.held_out_px) == (
        found.n_ties,
        found.content,
        found.held_out_px,
    )
    assert again.pieces[0].role is found.pieces[0].role
    for one, other in zip(again.view.projections, found.view.projections, strict=True):
        assert (one is None) == (other is None)
        if one is not None and other is not None:
            assert one.part == other.part
            np.testing.assert_array_equal(one.u, other.u)
            np.testing.assert_array_equal(one.v, other.v)


def test_a_photo_without_a_pose_is_found_by_what_others_show(tmp_path: Path) -> None:
    inputs = example_inputs(MatchGuided)
    cameras: Any = inputs["cameras"]
    lost = dataclasses.replace(
        cameras.cameras[-1],
        status="too few ties",
        rotation_camera_from_world=None,
        translation_camera_from_world=None,
    )
    missing = Cameras(cameras=(*cameras.cameras[:-1], lost))
    trial = Trial(method=MatchGuided, inputs={**inputs, "cameras": missing})
    whole = run_trial(trial, tmp_path / "whole", draws=False)
    assert any("found by what other photos show" in event.text for event in whole.events)
