"""How far beside the truth a result may lie: below each limit it passes, above it is named."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from orthoflow.products import Layer, LayerMask, Orthoimages, OrthoMask, Planes
from orthoflow.testing import photographed, physics
from orthoflow.testing.examples import example_room
from tests import samples


@pytest.fixture(scope="module")
def truth() -> Planes:
    _, planes = example_room(n_points=1000)
    return planes


@pytest.mark.parametrize(("angle_deg", "fits"), [(0.015, True), (0.03, False)])
def test_planes_may_be_a_fiftieth_of_a_degree_off(
    truth: Planes, angle_deg: float, fits: bool
) -> None:
    turn = math.radians(angle_deg)
    beside = np.linalg.svd(truth.normal[0][None])[2][1]
    normal = math.cos(turn) * truth.normal[0] + math.sin(turn) * beside
    # Turned about the middle of the rectangle, which so stays on the plane.
    offset = truth.corners[0].mean(axis=0) @ normal
    found = replace(
        truth,
        normal=np.vstack([normal, truth.normal[1:]]),
        offset=np.append(offset, truth.offset[1:]),
    )
    if fits:
        physics.match_planes(found, truth)
        return
    with pytest.raises(
        AssertionError, match=r"plane 0 of a rotated and shifted room is 0\.030 deg and 0\.00 mm"
    ):
        physics.match_planes(found, truth)


def oriented(shift_m: float) -> Any:
    """A subject that finds both photos, shifted along the wall."""
    found = [
        photographed.oriented(
            photographed.nudged(camera, (0.0, 0.0, 0.0, shift_m, 0.0, 0.0)), name=name
        )
        for name, camera in photographed.PHOTOGRAPHING.items()
    ]
    run = SimpleNamespace(outputs={"cameras": photographed.cameras(*found)})
    return SimpleNamespace(run_on_photographs=lambda: run)


def test_photos_may_be_oriented_a_little_beside_their_true_pose() -> None:
    # A shift along the wall moves every pixel's place by as much: 1 mm is 0.7 mm per coordinate.
    physics.poses_are_recovered(oriented(0.001))
    with pytest.raises(AssertionError, match=r"the pose of a\.png is off by 0\.99 mm on the wall"):
        physics.poses_are_recovered(oriented(0.0014))


def test_a_photo_that_is_not_oriented_is_named() -> None:
    lost = replace(oriented(0.0).run_on_photographs().outputs["cameras"].cameras[1], status="few")
    for cameras, said in (
        (photographed.cameras(lost), r"b\.png was not oriented: few"),
        (None, "output cameras is missing"),
    ):
        run = SimpleNamespace(outputs={"cameras": cameras})
        subject: Any = SimpleNamespace(run_on_photographs=lambda run=run: run)
        with pytest.raises(AssertionError, match=said):
            physics.poses_are_recovered(subject)


def layer(
    *, columns: float = 0.0, rows: float = 0.0, share: float = 1.0, lighter: int = 0
) -> Layer:
    """The wall in its true colours, shifted, in a share of its columns, and made lighter."""
    scene = photographed.textured_wall(gsd_m=0.01)
    frame = scene.frame
    across, down = photographed.places_of_cells(frame)
    grey = scene.grey(across - columns * frame.gsd_m, down - rows * frame.gsd_m)
    shown = np.broadcast_to(np.arange(frame.width) < share * frame.width, frame.shape)
    values = np.clip(np.rint(255.0 * grey) + lighter, 0, 255).astype(np.uint8)
    return Layer(
        frame=frame,
        wall=0,
        source="a.png",
        rgb=np.repeat(values[..., None], 3, axis=2),
        mask=np.where(shown, LayerMask.PAINTED, LayerMask.OUTSIDE).astype(np.uint8),
        quality=np.ones(frame.shape, dtype=np.float32),
    )


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (
            {"columns": 0.3},
            r"a\.png at 0\.01 m: colours are shifted by -0\.\d\d columns and [+-]0\.0\d rows",
        ),
        ({"rows": -0.3}, r"colours are shifted by [+-]0\.0\d columns and \+0\.\d\d rows"),
        ({"share": 0.25}, r"only 25% of the wall is covered"),
        ({"lighter": 24}, r"half of the colours are wrong by 2\d grey levels or more"),
    ],
    ids=str,
)
def test_cells_that_show_another_place_are_reported(image: dict[str, Any], message: str) -> None:
    shown = layer(**image)
    scene = photographed.textured_wall(gsd_m=0.01)
    with pytest.raises(AssertionError, match=message):
        physics.check_cells(scene, shown, "a.png", shown.mask == LayerMask.PAINTED)


@pytest.mark.parametrize(("hidden", "passes"), [(0.02, True), (0.05, False)])
def test_a_mosaic_paints_what_its_layers_show(hidden: float, passes: bool) -> None:
    def run_on(**inputs: object) -> object:
        (left, right) = inputs["layers"].layers  # type: ignore[attr-defined]
        rgb = np.where(left.mask[..., None] == LayerMask.PAINTED, left.rgb, right.rgb)
        mask = np.full(left.frame.shape, OrthoMask.PAINTED, dtype=np.uint8)
        mask[: round(hidden * len(mask))] = OrthoMask.OCCLUDED
        image = samples.orthoimage(left.frame, rgb=rgb, mask=mask, sources=("left", "right"))
        return SimpleNamespace(outputs={"orthoimages": Orthoimages(images=(image,))})

    subject: Any = SimpleNamespace(run_on_photographs=run_on)
    if passes:
        physics.mosaics_show_cells_in_place(subject)
        return
    with pytest.raises(AssertionError, match=r"wall 0 at 0\.006 m: 95% of the cells are covered"):
        physics.mosaics_show_cells_in_place(subject)
