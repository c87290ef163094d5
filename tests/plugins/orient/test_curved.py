"""Photos matched with an unrolled vault, spire and dome and oriented, judged by the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match.guided import MatchGuided
from orthoflow_plugins.match.sift import MatchSift
from orthoflow_plugins.orient.bundle import OrientColmapBundle
from orthoflow_plugins.orient.pnp import OrientPnp
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.raster.grid import RasterGrid

from orthoflow.geometry import WallFrame
from orthoflow.products import Intrinsics, Layer, LayerMask, Photos
from tests import curved_scenes, ortho_scenes
from tests.curved_scenes import Drum
from tests.long_loops import long_only
from tests.method_runs import run
from tests.raster_scenes import cloud_of, context

GSD_M = 0.004
# Limit per coordinate: 0.35 mm and a tenth of a cell.
LIMIT_M = 0.35e-3 + 0.1 * GSD_M
BLOCK_CELLS = 24
LOOSE = {
    "min_quadrant_ties": 0,
    "min_hull_ratio": 0.1,
    "max_sigma_wall_cells": 4,
    "max_sigma_corner_cells": 8,
}


def texture_of(drum: Drum, frame: WallFrame) -> NDArray[np.float64]:
    """The true grey values of a wall."""
    rows, columns = np.mgrid[: frame.height, : frame.width] + 0.5
    places = drum.places(frame.world_from_wall(np.column_stack([columns.ravel(), rows.ravel()])))
    return drum.texture(places).reshape(frame.shape)


def shifts_m(layer: Layer, true: NDArray[np.float64]) -> NDArray[np.float64]:
    """Displacements (n, 2) along u and v of blocks of a layer, by least squares, in metres."""
    down, right = np.gradient(true)
    off, found = layer.rgb[..., 0] / 255.0 - true, []
    for row in range(0, true.shape[0] - BLOCK_CELLS, BLOCK_CELLS):
        for column in range(0, true.shape[1] - BLOCK_CELLS, BLOCK_CELLS):
            part = slice(row, row + BLOCK_CELLS), slice(column, column + BLOCK_CELLS)
            shown = layer.mask[part] == LayerMask.PAINTED
            if shown.mean() > 0.98:
                slopes = [values[part][shown] for values in (right, down, true)]
                design = np.column_stack([*slopes, np.ones(shown.sum())])
                solution = np.linalg.lstsq(design, off[part][shown], rcond=None)[0]
                found.append(-GSD_M * solution[:2])
    return np.array(found)


# The drum, and the angles of cameras, their positions along it and distances.
SCENES = {
    "vault": (
        curved_scenes.vault(half_deg=32.0, length_m=1.2, band_m=(0.2, 0.35), height_m=0.08),
        [(-16.0, -0.2, 2.4), (16.0, 0.2, 2.5)],
    ),
    "spire": (
        curved_scenes.spire(half_deg=60.0, band_m=(3.2, 3.35), height_m=0.08),
        [(-40.0, 3.3, 2.4), (0.0, 3.7, 2.5), (40.0, 3.3, 2.4)],
    ),
    "dome": (
        curved_scenes.dome(most_deg=60.0, band_m=(0.5, 0.6), height_m=0.05),
        [(-40.0, 0.5, 0.9), (90.0, 0.4, 0.9), (200.0, 0.5, 0.9)],
    ),
}


@pytest.mark.parametrize("name", ["vault", *long_only("spire", "dome")])
def test_oriented_photos_are_unrolled_to_a_tenth_of_a_cell(name: str, tmp_path: Path) -> None:
    drum, poses = SCENES[name]
    random = np.random.default_rng(11)
    points = drum.cloud(0.7 * GSD_M)
    world = points.points_world()
    world += random.normal(0.0, 1e-3, len(world))[:, None] * drum.shape.normals(world)
    cloud = replace(cloud_of(world, intensity=points.intensity), rgb=points.rgb)
    viewers = [curved_scenes.camera(drum, *pose, width=1000) for pose in poses]
    pictures = [drum.rendered(viewer) for viewer in viewers]
    noisy = [
        np.clip(picture + random.normal(0.0, 2.0, picture.shape), 0.0, 255.0).astype(np.uint8)
        for picture in pictures
    ]
    photos = Photos(
        photos=tuple(
            replace(photo, intrinsics=Intrinsics.of(viewer))
            for photo, viewer in zip(ortho_scenes.photos(*noisy).photos, viewers, strict=True)
        )
    )
    scan = {"cloud": cloud, "planes": curved_scenes.NO_PLANES, "surfaces": drum.surfaces()}
    walls = run(RasterGrid, context(tmp_path), scan, gsd_m=GSD_M).walls
    given = {"photos": photos, "walls": walls}
    ties = run(MatchSift, context(tmp_path), given).ties
    assert ties.walls[0].frame.has_cells_of(walls.walls[0].frame)
    inputs = {"ties": ties, "photos": photos}
    first = run(OrientPnp, context(tmp_path), inputs, **LOOSE).cameras
    more = {**given, "cameras": first, "cloud": cloud}
    again = run(MatchGuided, context(tmp_path), more).ties
    inputs = {"ties": again, "photos": photos}
    cameras = run(OrientColmapBundle, context(tmp_path), inputs).cameras
    assert [camera.status for camera in cameras.cameras] == ["ok"] * len(poses)
    for camera, viewer in zip(cameras.cameras, viewers, strict=True):
        assert np.linalg.norm(camera.viewing().centre_world - viewer.centre_world) < 1.5e-3

    shown = {**given, "cloud": cloud, "cameras": cameras}
    layers = run(DsmBackward, context(tmp_path), shown).layers.layers
    true = texture_of(drum, walls.walls[0].frame)
    shifts = np.vstack([shifts_m(layer, true) for layer in layers])
    assert len(shifts) > 100
    assert (np.sqrt((shifts**2).mean(axis=0)) < LIMIT_M).all()
