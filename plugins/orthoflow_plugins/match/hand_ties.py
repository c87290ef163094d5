"""Ties that a person measured, laid on the walls and joined with those that matching finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from orthoflow.products import Photos, Ties, Walls
from orthoflow.sdk import StepContext
from orthoflow_plugins.match.pictures import require_intensity
from orthoflow_plugins.match.tie_pieces import ties_of


def is_by_hand_alone(hand: Ties | None, walls: Walls) -> bool:
    """Whether the walls show nothing that a photo could be matched with, but there are ties.

    Raises:
        MethodError: the walls show nothing, and nobody measured a tie.
    """
    if hand is None or any(wall.intensity is not None for wall in walls.walls):
        require_intensity(walls)
        return False
    return True


def ties_by_hand_alone(
    hand: Ties | None, photos: Photos, walls: Walls, ctx: StepContext
) -> Ties | None:
    """Give the ties by hand where the walls show nothing that a photo could be matched with.

    Returns:
        None where the walls show something.

    Raises:
        MethodError: the walls show nothing, and nobody measured a tie.
    """
    if not is_by_hand_alone(hand, walls):
        return None
    ctx.warn(
        "the scan has neither intensity nor colour that a photo could be matched with: only the "
        "ties measured by hand are used"
    )
    return with_ties_by_hand(ties_of([], photos, walls, {}), hand, walls, ctx)


def with_ties_by_hand(ties: Ties, hand: Ties | None, walls: Walls, ctx: StepContext) -> Ties:
    """Put ties that a person measured behind those that matching found.

    Args:
        ties: of all photos, with their walls.
        hand: measured by a person, in the photos of the same names; None for none.
        walls: the walls of `ties`.
        ctx: takes how many they are.
    """
    if hand is None or not len(hand.photo):
        return ties
    place = {name: index for index, name in enumerate(ties.photo_names)}
    known = np.array([place.get(name, -1) for name in hand.photo_names], dtype=np.int32)
    kept = np.flatnonzero(known[hand.photo] >= 0)
    ctx.metric("n_by_hand", len(kept), "1")
    own_walls = walls.nearest(hand.points_world[kept])
    return replace(
        ties,
        photo=np.concatenate([ties.photo, known[hand.photo[kept]]]),
        wall=np.concatenate([ties.wall, own_walls]),
        pixels_photo=np.concatenate([ties.pixels_photo, hand.pixels_photo[kept]]),
        points_world=np.concatenate([ties.points_world, hand.points_world[kept]]),
        sigma_px=np.concatenate([ties.sigma_px, hand.sigma_px[kept]]),
        sigma_m=np.concatenate([ties.sigma_m, hand.sigma_m[kept]]),
        role=np.concatenate([ties.role, hand.role[kept]]),
        residual_px=np.concatenate([ties.residual_px, np.full((len(kept), 2), np.nan)]),
        by_hand=np.repeat(np.array([0, 1], dtype=np.uint8), [len(ties.photo), len(kept)]),
    )
