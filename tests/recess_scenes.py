"""A wall with one recess and relief, and outlines of the recess moved by known amounts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from orthoflow_plugins.simulate.building import Extent, Paint, SceneDraft, wall_side

from orthoflow.geometry import frame_over
from orthoflow.geometry.scenes import SurfaceRole, TextureKind
from orthoflow.products import Opening, Openings, Product, Truth, Walls
from orthoflow.testing.examples import example
from tests import samples

GSD_M = 0.02
FULL: Extent = (-1.5, 1.5, -1.0, 1.0)
RECESS: Extent = (-0.413, 0.387, -0.609, 0.611)
DEPTH_M = 0.2
PAINT = Paint(kind=TextureKind.PLAIN, rgb=(200, 200, 200), reflectance=0.5, seed=1)


def scene() -> tuple[Truth, Walls]:
    """The wall: one recess, and a slab of relief beside it."""
    draft = SceneDraft()
    side = wall_side(draft, omega_deg=90.0, phi_deg=0.0, distance_m=2.0)
    plane = side.true_plane("wall", FULL)
    hole = side.recess(RECESS, DEPTH_M, PAINT)
    side.place(FULL, 0.0, PAINT, SurfaceRole.WALL, plane=plane, holes=[hole])
    side.box((0.7, 0.9, -1.0, 1.0), 0.1, PAINT)
    truth = example("truth")
    assert isinstance(truth, Truth)
    outline = draft.planes[plane]
    frame = frame_over(outline.outline, outline.plane.normal, gsd_m=GSD_M)
    wall = samples.wall(frame, plane_index=3, name="wall 3")
    walls = samples.walls(wall, buffer_behind_m=0.3)
    return replace(truth, scene=draft.finished(spectral_gap=0.0)), walls


def opening(
    walls: Walls, *, outwards_m: float = 0.0, right_m: float = 0.0, unseen: int | None = None
) -> Opening:
    """The true outline, grown and moved, with a millimetre of stated error."""
    a0, a1, b0, b1 = RECESS
    # The wall spans 3 x 2 m about its middle.
    corners_m = np.array(
        [
            [a0 - outwards_m, b1 + outwards_m],
            [a0 - outwards_m, b0 - outwards_m],
            [a1 + outwards_m, b0 - outwards_m],
            [a1 + outwards_m, b1 + outwards_m],
        ]
    ) + np.array([right_m, 0.0])
    places = corners_m + np.array([1.5, -1.0])
    cells = places * [1.0, -1.0] / GSD_M
    source = np.zeros(4, dtype=np.uint8)
    sigma = np.full(4, 0.001)
    if unseen is not None:
        source[unseen], sigma[unseen] = 2, np.nan
    return Opening(
        wall=3,
        wall_name="wall 3",
        kind="niche",
        outline_m=places,
        outline_world=walls.walls[0].frame.world_from_wall(cells),
        side_sigma_m=sigma,
        side_source=source,
        depth_m=DEPTH_M + 0.003,
        area_m2=0.8 * 1.22,
        width_m=0.8,
        height_m=1.22,
        sill_m=0.391,
        seen_share=1.0,
    )


def inputs() -> Mapping[str, Product]:
    """What `inspect.openings` takes: the outline 30 mm too large, and one of nothing."""
    truth, walls = scene()
    found = (opening(walls, outwards_m=0.03), opening(walls, right_m=0.9))
    return {"truth": truth, "walls": walls, "openings": Openings(openings=found, walls=(3,))}
