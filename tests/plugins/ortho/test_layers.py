"""Layers of the photos: joined by wall, counted, and bare where none paints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.ortho.layers import (
    NO_SOURCE,
    LayerStack,
    count_shown,
)

from orthoflow.errors import MethodError
from orthoflow.products import Layer, LayerMask, Layers, Walls
from orthoflow.sdk import StepContext
from tests import samples
from tests.raster_scenes import context

SHAPE = (4, 6)
OUTSIDE, PAINTED, HIDDEN, VOID = (
    LayerMask.OUTSIDE,
    LayerMask.PAINTED,
    LayerMask.OCCLUDED,
    LayerMask.NO_SURFACE,
)


def walls(n: int = 3) -> Walls:
    frame = samples.facing_south(0.01, SHAPE[1], SHAPE[0])
    depths = np.zeros(SHAPE, dtype=np.float32)
    depths[3] = np.nan
    return samples.walls(
        *(
            samples.wall(frame, name=f"wall {k}", plane_index=k + 4, depth_m=depths)
            for k in range(n)
        )
    )


def mask_of(**rows: LayerMask) -> np.ndarray:
    """States of the first rows; the last one is void."""
    mask = np.full(SHAPE, VOID, dtype=np.uint8)
    mask[:3] = [[state] for state in rows.values()]
    return mask


def layer(wall: int, source: str, mask: np.ndarray, *, deep: bool = False) -> Layer:
    rgb = np.zeros((*SHAPE, 3), dtype=np.uint16 if deep else np.uint8)
    return samples.layer(mask, wall=wall, source=source, rgb=rgb)


def stacked(ctx: StepContext, *found: Layer) -> LayerStack:
    stack = LayerStack(walls(), ctx)
    for each in found:
        stack.add(each)
    return stack


def test_layers_come_by_wall_and_then_by_photo(tmp_path: Path) -> None:
    shown = mask_of(a=PAINTED, b=HIDDEN, c=OUTSIDE)
    photos = (layer(wall, name, shown) for wall, name in ((2, "a"), (0, "a"), (1, "b"), (0, "b")))
    ctx = context(tmp_path)
    found = stacked(ctx, *photos).joined(np.uint8)
    assert [(each.wall, each.source) for each in found.layers] == [
        (0, "a"), (0, "b"), (1, "b"), (2, "a"),
    ]  # fmt: skip
    assert found.names == ("wall 0", "wall 1", "wall 2")
    assert found.plane_indices == (4, 5, 6)
    assert ctx.warnings == []
    with pytest.raises(MethodError, match="no oriented photo sees a wall"):
        stacked(ctx).joined(np.uint8)


def test_a_wall_that_no_photo_paints_is_bare_but_states_what_is_hidden(tmp_path: Path) -> None:
    shown = layer(0, "a", mask_of(a=PAINTED, b=HIDDEN, c=OUTSIDE), deep=True)
    ctx = context(tmp_path)
    stack = stacked(ctx, shown)
    mask = mask_of(a=HIDDEN, b=OUTSIDE, c=OUTSIDE)
    stack.note_reached(1, mask)
    # The mask of the next photo lies where that of the first did.
    mask[:3] = [[OUTSIDE], [HIDDEN], [OUTSIDE]]
    stack.note_reached(1, mask)
    # A photo paints this wall.
    stack.note_reached(0, mask_of(a=HIDDEN, b=HIDDEN, c=HIDDEN))
    found = stack.joined(np.uint16)
    first, second, third = found.layers
    assert first is shown
    assert [one.values["walls"] for one in ctx.diagnostics] == ["wall 1, wall 2"]
    assert (second.wall, second.source, third.wall, third.source) == (1, NO_SOURCE, 2, NO_SOURCE)
    np.testing.assert_array_equal(second.mask, mask_of(a=HIDDEN, b=HIDDEN, c=OUTSIDE))
    np.testing.assert_array_equal(third.mask, mask_of(a=OUTSIDE, b=OUTSIDE, c=OUTSIDE))
    for bare in (second, third):
        assert bare.rgb.dtype == shown.rgb.dtype
        assert not bare.rgb.any()
        assert not bare.quality.any()
        assert bare.rgb.shape == (*SHAPE, 3)


def test_cells_are_counted_once_however_many_photos_show_them() -> None:
    layered = Layers(
        layers=(
            layer(0, "a", mask_of(a=PAINTED, b=HIDDEN, c=OUTSIDE)),
            layer(0, "b", mask_of(a=PAINTED, b=PAINTED, c=HIDDEN)),
            layer(1, "a", mask_of(a=HIDDEN, b=HIDDEN, c=OUTSIDE)),
            layer(2, "b", mask_of(a=OUTSIDE, b=OUTSIDE, c=OUTSIDE)),
        ),
        names=("wall 0", "wall 1", "wall 2"),
        plane_indices=(4, 5, 6),
    )
    # Three of four rows have a depth; two are painted on the first wall, one hidden, and two on
    # the second one.
    assert count_shown(walls(), layered) == (3 * 18, 12, 6 + 12)
