"""What is told of photos before they are laid onto walls."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.dsm_forward import DsmForward
from orthoflow_plugins.ortho.photos_on_walls import warn_of_heads

from orthoflow.diagnostics import Diagnostic
from orthoflow.geometry.frames import rotation_from_vector
from orthoflow.products import Camera, Photo
from orthoflow.sdk import StepContext
from tests import ortho_scenes as scenes
from tests.raster_scenes import context


def posed(*turns_deg: float) -> list[tuple[Photo, Camera]]:
    """Photos of the board, turned about their axes."""
    where = scenes.frame()
    viewer = scenes.camera(where)
    turned = []
    for turn_deg in turns_deg:
        turn = rotation_from_vector(np.array([0.0, 0.0, np.radians(turn_deg)]))
        turned.append(
            replace(viewer, rotation=turn @ viewer.rotation, translation=turn @ viewer.translation)
        )
    pictures = [np.zeros((8, 8, 3), np.uint8)] * len(turned)
    photos, cameras = scenes.photos(*pictures).photos, scenes.cameras(*turned).cameras
    return list(zip(photos, cameras, strict=True))


def said(folder: Path, *turns_deg: float, sign: float = 1.0) -> list[Diagnostic]:
    ctx: StepContext = context(folder)
    warn_of_heads(sign * scenes.walls(scenes.frame()).up, posed(*turns_deg), ctx)
    return ctx.diagnostics


def test_a_scan_whose_up_is_down_is_told_by_its_photos(tmp_path: Path) -> None:
    (told,) = said(tmp_path, 0.0, 10.0, -20.0, 180.0, sign=-1.0)
    assert (told.values["n_down"], told.values["n_photos"], told.values["opposite"]) == (3, 4, "z")
    (told,) = said(tmp_path, 180.0)
    assert told.values["opposite"] == "-z"


@pytest.mark.parametrize(
    "turns_deg", [(0.0, 0.0), (90.0, -90.0), (180.0, 0.0), (110.0, 115.0)], ids=str
)
def test_upright_sideways_and_divided_photos_say_nothing(
    tmp_path: Path, turns_deg: tuple[float, float]
) -> None:
    assert said(tmp_path, *turns_deg) == []


@pytest.mark.parametrize("method", [DsmBackward, DsmForward])
def test_methods_that_lay_photos_tell_it(
    tmp_path: Path, method: type[DsmBackward] | type[DsmForward]
) -> None:
    where = scenes.frame()
    walls = replace(scenes.walls(where), up=-scenes.walls(where).up)
    ctx = context(tmp_path)
    method().run(scenes.inputs(method.In, walls=walls), method.Params(), ctx)
    assert "photos-upside-down" in [one.code for one in ctx.diagnostics]
