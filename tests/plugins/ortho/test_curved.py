"""Photos and points projected onto unrolled surfaces: colours, visibility and quality."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.colour.photos import ColourPhotos
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.dsm_forward import DsmForward
from orthoflow_plugins.ortho.pointcloud_direct import PointcloudDirect
from orthoflow_plugins.raster.grid import RasterGrid

from orthoflow.errors import OrthoflowError
from orthoflow.geometry.bends import CylinderBend
from orthoflow.products import Cameras, LayerMask
from tests import curved_scenes, ortho_scenes
from tests.curved_scenes import Drum
from tests.long_loops import long_only
from tests.method_runs import run
from tests.raster_scenes import cell_centres, context, numbers

GSD_M = 0.01
BAND: dict[str, Any] = {"band_m": (0.2, 0.5), "height_m": 0.15}
RING: dict[str, Any] = {"band_m": (3.4, 3.7), "height_m": 0.15}
# The drum, and cameras: place along the arc in degrees, along the axis, and distance.
SCENES: dict[str, tuple[Drum, list[tuple[float, float, float]]]] = {
    "vault": (curved_scenes.vault(length_m=2.0, **BAND), [(0.0, -0.6, 2.5), (30.0, 0.7, 2.4)]),
    "tower": (curved_scenes.tower(**BAND), [(0.0, -0.6, 2.5), (60.0, 0.5, 1.6)]),
    "apse": (curved_scenes.tower(is_concave=True, **BAND), [(100.0, 0.3, 1.5)]),
    # The second camera faces the cut of the closed surface.
    "column": (
        curved_scenes.tower(radius_m=0.6, half_deg=180.0, **BAND),
        [(0.0, -0.6, 2.0), (175.0, 0.3, 1.5)],
    ),
    "spire": (curved_scenes.spire(**RING), [(0.0, 3.0, 2.5), (60.0, 3.9, 1.6)]),
    "dome": (
        curved_scenes.dome(band_m=(0.5, 0.8), height_m=0.1),
        [(20.0, 0.3, 0.8)],
    ),
    "ball": (
        curved_scenes.dome(is_concave=False, band_m=(0.3, 0.6), height_m=0.1),
        [(20.0, 0.3, 2.0), (100.0, 0.9, 2.0)],
    ),
    "funnel": (curved_scenes.spire(is_concave=True, **RING), [(100.0, 3.8, 1.3)]),
}


def projected(
    name: str, folder: Path, method: Any = DsmBackward, sigma_m: float = 0.0
) -> tuple[Any, ...]:
    """Layers of the photos of a scene, the drum, its cameras, its wall, and the metrics.

    The cameras are displaced by three standard deviations to the right.
    """
    drum, poses = SCENES[name]
    cloud = drum.cloud(0.6 * GSD_M)
    found = {"cloud": cloud, "planes": curved_scenes.NO_PLANES, "surfaces": drum.surfaces()}
    walls = run(RasterGrid, context(folder), found, gsd_m=GSD_M).walls
    cameras = [curved_scenes.camera(drum, *pose, width=500) for pose in poses]
    inputs = {"walls": walls, "cloud": cloud}
    if method is not PointcloudDirect:
        inputs["photos"] = ortho_scenes.photos(*map(drum.rendered, cameras))
        off = [camera.shifted(-3.0 * sigma_m * camera.rotation[0]) for camera in cameras]
        found = ortho_scenes.cameras(*off)
        inputs["cameras"] = Cameras(
            cameras=tuple(replace(camera, sigma_wall_m=sigma_m) for camera in found.cameras)
        )
    ctx = context(folder)
    layers = run(method, ctx, inputs).layers.layers
    return layers, drum, cameras, walls.walls[0], numbers(ctx)


# The others differ from these in the direction of the axis or in their opening angle.
NAMES = ["vault", "column", "spire", "dome", "funnel", *long_only("tower", "apse", "ball")]


@pytest.mark.parametrize("name", NAMES)
def test_photos_colour_what_they_see_of_a_curved_surface(name: str, tmp_path: Path) -> None:
    layers, drum, cameras, wall, metrics = projected(name, tmp_path)
    frame = wall.frame
    cells = np.column_stack(cell_centres(frame.shape))
    places = drum.places(frame.world_from_wall(cells))
    points, grey = drum.points(*places.T), drum.texture(places)
    for camera, layer in zip(cameras, layers, strict=True):
        rays = points - camera.centre_world
        lengths_m = np.linalg.norm(rays, axis=1)
        met = drum.met(np.broadcast_to(camera.centre_world, rays.shape), rays)
        pixels = camera.project(points)[:, :2]
        is_seen = (met > 1.0 - GSD_M / lengths_m) & camera.sees(pixels) & frame.shows(cells)
        cosines = -np.einsum("ij,ij->i", rays, frame.axes_at(cells)[:, 2]) / lengths_m
        mask = layer.mask.ravel()
        is_painted = mask == LayerMask.PAINTED
        assert (is_painted & ~is_seen).mean() < 5e-4
        # Cells beside hidden ones are left out.
        assert (is_seen & (cosines > 0.3) & ~is_painted).mean() < 0.035
        assert (is_painted & is_seen).mean() > 0.9 * (is_seen & (cosines > 0.3)).mean() > 0.05
        errors = layer.rgb.reshape(-1, 3)[:, 0] / 255.0 - grey
        assert np.sqrt((errors[is_painted & is_seen] ** 2).mean()) < 0.13
        # Quality: pixels per cell, by the distances of the cells' corners in the photo.
        some = np.flatnonzero(is_painted)[::50]
        depths = wall.depth_m.ravel()[some].astype(np.float64)
        here, right, below = (
            camera.project(frame.world_from_wall(cells[some] + np.array(step), depths))[:, :2]
            for step in ((0.0, 0.0), (1e-3, 0.0), (0.0, 1e-3))
        )
        (a, b), (c, d) = (right - here).T, (below - here).T
        inside = np.minimum(here, [camera.width, camera.height] - here).min(axis=1)
        rim = np.minimum(inside / (0.05 * camera.height), 1.0)
        ratio = layer.quality.ravel()[some] / (np.abs(a * d - b * c) * 1e6 * rim)
        assert 0.85 < np.percentile(ratio, 1) < np.percentile(ratio, 99) < 1.05
    assert metrics["obliquity_deg"] < 60.0


def test_nobody_sees_through_the_wall_of_an_apse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SCENES, "apse", (SCENES["apse"][0], [(0.0, 0.0, -1.5)]))
    with pytest.raises(OrthoflowError, match="no oriented photo shows a wall"):
        projected("apse", tmp_path)


def test_no_cell_shows_what_is_behind_the_outline_of_a_column(tmp_path: Path) -> None:
    sigma_m = 0.01
    layers, drum, cameras, wall, _ = projected("column", tmp_path, sigma_m=sigma_m)
    frame = wall.frame
    cells = np.column_stack(cell_centres(frame.shape))
    points = frame.world_from_wall(cells)
    # The ends and the band have outlines of their own.
    is_inside = np.abs(drum.places(points)[:, 1] + 0.4) < 0.5
    for camera, layer in zip(cameras, layers, strict=True):
        is_painted = layer.mask.ravel() == LayerMask.PAINTED
        assert layer.rgb.reshape(-1, 3)[is_painted & is_inside].min() > 5
        rays = camera.centre_world - points
        cosines = np.einsum("ij,ij->i", rays, frame.axes_at(cells)[:, 2])
        sines = np.sqrt(1.0 - (cosines / np.linalg.norm(rays, axis=1)) ** 2)
        # Nothing else is left out: two cells and a pixel, and twice three standard deviations.
        pixel_m = np.linalg.norm(rays, axis=1) / camera.fx
        is_safe = drum.radius_m * (1.0 - sines) > 2.0 * GSD_M + pixel_m + 6.0 * sigma_m
        is_seen = (cosines > 0.0) & camera.sees(camera.project(points)[:, :2])
        assert is_painted[is_seen & is_safe].mean() > 0.9


@pytest.mark.parametrize("name", ["tower", "dome"])
def test_points_colour_a_curved_surface(name: str, tmp_path: Path) -> None:
    (layer,), drum, _, wall, _ = projected(name, tmp_path, PointcloudDirect)
    frame = wall.frame
    is_shown = frame.shown_cells(slice(0, frame.height))
    assert (layer.mask[is_shown] == LayerMask.PAINTED).mean() > 0.99
    cells = np.column_stack(cell_centres(frame.shape))
    places = drum.places(frame.world_from_wall(cells))
    errors = layer.rgb.reshape(-1, 3)[:, 0] / 255.0 - drum.texture(places)
    assert np.sqrt((errors[is_shown.ravel()] ** 2).mean()) < 0.13


@pytest.mark.parametrize("name", ["vault", "column"])
def test_points_get_the_colours_of_photos(name: str, tmp_path: Path) -> None:
    drum, poses = SCENES[name]
    # The cloud has no points on the sides of the band, through which the back would be seen.
    drum = replace(drum, height_m=0.0)
    cameras = [curved_scenes.camera(drum, *pose, width=500) for pose in poses]
    inputs = {
        "cloud": drum.cloud(GSD_M),
        "photos": ortho_scenes.photos(*map(drum.rendered, cameras)),
        "cameras": ortho_scenes.cameras(*cameras),
    }
    cloud = run(ColourPhotos, context(tmp_path), inputs).cloud
    points = cloud.points_world()
    is_seen = np.zeros(len(points), dtype=np.bool_)
    for camera in cameras:
        rays = points - camera.centre_world
        met = drum.met(np.broadcast_to(camera.centre_world, rays.shape), rays)
        is_seen |= (met > 1.0 - 0.05 / np.linalg.norm(rays, axis=1)) & camera.sees(
            camera.project(points)[:, :2]
        )
    assert is_seen.mean() > 0.99
    errors = cloud.rgb[:, 0] / 255.0 - drum.texture(drum.places(points))
    assert np.sqrt((errors**2).mean()) < 0.13


def test_pixels_are_not_thrown_onto_a_cylinder(tmp_path: Path) -> None:
    curved = replace(ortho_scenes.frame(), bend=CylinderBend(along="u", radius_m=3.0))
    given = ortho_scenes.inputs(walls=ortho_scenes.walls(curved))
    with pytest.raises(OrthoflowError, match="dsm-forward does not take curved walls"):
        ortho_scenes.laid(DsmForward, tmp_path, given)
