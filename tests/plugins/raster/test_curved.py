"""Curved surfaces in `raster.grid`: exact depths in their developments, as a viewer sees them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.ortho.pointcloud_direct import PointcloudDirect
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.simulate.curved import SimulateCurved

from orthoflow.errors import MethodError
from orthoflow.geometry.surfaces import angles_around
from orthoflow.products import LayerMask, SurfaceMask, Surfaces, Wall
from orthoflow.testing import Trial, run_trial
from tests import curved_scenes, samples
from tests.curved_scenes import Drum
from tests.method_runs import run
from tests.raster_scenes import UP, cell_centres, cloud_of, context

GSD_M = 0.02
BAND: dict[str, Any] = {"band_m": (0.2, 0.5), "height_m": 0.1}
DRUMS = {
    "vault": curved_scenes.vault(half_deg=50.0, **BAND),
    "tower": curved_scenes.tower(**BAND),
    "apse": curved_scenes.tower(is_concave=True, **BAND),
    # A whole turn is 188.5 cells wide.
    "column": curved_scenes.tower(radius_m=0.6, half_deg=180.0, **BAND),
    "cone": curved_scenes.spire(band_m=(3.2, 3.5), height_m=0.1),
    "dome": curved_scenes.dome(band_m=(0.5, 0.8), height_m=0.1),
}


def rastered(drum: Drum, folder: Path, **params: Any) -> Wall:
    inputs = {
        "cloud": drum.cloud(0.6 * GSD_M),
        "planes": curved_scenes.NO_PLANES,
        "surfaces": drum.surfaces(),
    }
    walls = run(RasterGrid, context(folder), inputs, gsd_m=GSD_M, **params).walls
    assert walls.buffers_m[0][0] < 0.2
    return walls.walls[0]  # type: ignore[no-any-return]


@pytest.mark.parametrize("name", DRUMS)
def test_depths_are_distances_from_the_surface(name: str, tmp_path: Path) -> None:
    drum = DRUMS[name]
    wall = rastered(drum, tmp_path)
    frame = wall.frame
    assert (wall.name, wall.plane_index) == (f"{name} 0", 0)
    sides_m = sorted((frame.gsd_m * frame.width, frame.gsd_m * frame.height))
    np.testing.assert_allclose(sides_m, sorted(drum.sides_m), atol=2.0 * GSD_M)
    is_shown = frame.shown_cells(slice(0, frame.height))
    assert (wall.mask[is_shown] != SurfaceMask.VOID).mean() > 0.99
    assert (wall.mask[~is_shown] == SurfaceMask.VOID).all()
    cells = np.column_stack(cell_centres(frame.shape))
    places = drum.places(frame.world_from_wall(cells))
    from_edges_m = np.abs(places[:, 1, None] - drum.band_m).min(axis=1)
    known = np.isfinite(wall.depth_m.ravel()) & (from_edges_m > 2.0 * GSD_M)
    is_band = (places[:, 1] >= drum.band_m[0]) & (places[:, 1] < drum.band_m[1])
    np.testing.assert_allclose(wall.depth_m.ravel()[known], 0.1 * is_band[known], atol=1e-5)
    assert wall.intensity is not None
    errors = wall.intensity.ravel()[known] - drum.texture(places[known])
    assert np.sqrt((errors**2).mean()) < 0.125
    # A person in front of an upright surface sees it upright, and to the right what is right.
    middle = frame.axes_at(np.array([[0.5 * frame.width, 0.5 * frame.height]]))[0]
    assert np.sign(float(middle[2] @ drum.shape.normals(frame.middle_world[None])[0])) == 1.0
    if name == "vault":
        np.testing.assert_allclose(frame.u_world, drum.shape.axis_world)
        assert frame.raster_axes == "plane"
    elif name == "cone":
        assert float(middle[1] @ UP) < -0.95
        assert frame.raster_axes == "plane"
        slants_m = np.linalg.norm(frame.raster_from_wall(cells), axis=1)
        np.testing.assert_allclose(slants_m, places[:, 1], atol=1e-9)
    elif name == "dome":
        # East is to the right, and south up, as one who looks up sees them.
        np.testing.assert_allclose(middle, [[1, 0, 0], [0, 1, 0], [0, 0, -1]], atol=1e-9)
        from_pole_m = np.linalg.norm(frame.raster_from_wall(cells), axis=1)
        np.testing.assert_allclose(from_pole_m, places[:, 1], atol=1e-9)
    else:
        assert float(frame.v_world @ UP) < -0.99
        assert frame.raster_axes == "wall"


def test_a_cropped_tower_has_the_same_cells(tmp_path: Path) -> None:
    drum = DRUMS["tower"]
    whole, part = (
        rastered(drum, tmp_path, buffer_m=0.15, **crop)
        for crop in ({}, {"crop": (1.0, 0.4, 2.0, 1.2)})
    )
    assert part.frame.has_cells_of(whole.frame.part((50.0, 20.0), width=50, height=40))
    np.testing.assert_allclose(part.depth_m[2:-2, 2:-2], whole.depth_m[22:58, 52:98], atol=1e-5)
    assert part.frame.left_m == 1.0
    assert part.frame.crs == whole.frame.crs


def test_curved_walls_follow_planes_and_cover_their_facets(tmp_path: Path) -> None:
    drum = DRUMS["vault"]
    # A strip of the vault that a detector took for a plane, and a floor below.
    strip = drum.points(np.array([-0.2, -0.2, 0.2, 0.2]), np.array([-1.0, 0.1, 0.1, -1.0]))
    normal = drum.shape.normals(strip[:1] + 0.1 * (strip[2:3] - strip[:1]))[0]
    strip -= np.outer((strip - strip.mean(axis=0)) @ normal, normal)
    floor = np.array([[3.0, 6.0, 0.0], [3.0, 4.0, 0.0], [5.0, 4.0, 0.0], [5.0, 6.0, 0.0]])
    planes = samples.planes(
        normal=np.array([normal, UP]),
        offset=np.array([float(normal @ strip[0]), 0.0]),
        corners=np.array([strip, floor]),
        names=("ceiling 0", "floor 1"),
    )
    on_floor = np.random.default_rng(2).uniform([3.0, 4.0], [5.0, 6.0], (20_000, 2))
    both = np.vstack([drum.cloud(0.02).points_world(), np.insert(on_floor, 2, 0.0, axis=1)])
    inputs = {"cloud": cloud_of(both), "planes": planes, "surfaces": drum.surfaces()}

    def names(**params: Any) -> tuple[list[str], list[int]]:
        walls = run(RasterGrid, context(tmp_path), inputs, gsd_m=0.04, **params).walls
        return [wall.name for wall in walls.walls], [wall.plane_index for wall in walls.walls]

    assert names() == (["floor 1", "vault 2"], [1, 2])
    del inputs["planes"]
    with pytest.raises(MethodError, match="planes are needed"):
        names()
    (vault,) = drum.surfaces().surfaces
    inputs["surfaces"] = Surfaces(surfaces=(replace(vault, name="vault 2"),), up=UP, planes=planes)
    assert names() == (["floor 1", "vault 2"], [1, 2])
    springing = tuple(drum.points(np.array([3.5]), np.zeros(1))[0].tolist())
    assert names(near=[springing]) == (["vault 2"], [2])
    assert names(ranks=(2, 1)) == (["floor 1", "vault 2"], [1, 2])
    assert names(constraint="horizontal") == (["ceiling 0", "floor 1"], [0, 1])
    with pytest.raises(MethodError, match="ranks contains 3"):
        names(ranks=(3,))
    inputs["planes"] = planes
    with pytest.raises(MethodError, match="given twice"):
        names()


def test_crossing_vaults_end_at_their_groins(tmp_path: Path) -> None:
    params = {"subject": "cross-vault", "scan_step_m": 0.04}
    trial = Trial(method=SimulateCurved, inputs={}, params=params, seed=3)
    room = run_trial(trial, tmp_path / "room").outputs
    surfaces = room["truth"].surfaces
    inputs = {"cloud": room["cloud"], "planes": curved_scenes.NO_PLANES, "surfaces": surfaces}
    walls = run(RasterGrid, context(tmp_path), inputs, gsd_m=0.04).walls
    coloured = {"walls": walls, "cloud": room["cloud"]}
    layers = run(PointcloudDirect, context(tmp_path), coloured, inpaint="none").layers.layers
    assert len(walls.walls) == 2
    for wall, layer, surface in zip(walls.walls, layers, surfaces.surfaces, strict=True):
        rows, columns = np.mgrid[: wall.frame.height, : wall.frame.width] + 0.5
        points = wall.frame.world_from_wall(np.column_stack([columns.ravel(), rows.ravel()]))
        shape = surface.shape
        angles = angles_around(points, shape.point_world, shape.axis_world, surface.zero_world)
        along_m = np.abs((points - shape.point_world) @ shape.axis_world)
        # The plane of a groin is at 45 degrees to both axes.
        beyond_m = (shape.radius_m * np.abs(np.sin(angles)) - along_m).reshape(wall.mask.shape)
        assert not wall.mask[beyond_m > 0.001].any()
        assert (layer.mask[beyond_m > 0.001] != LayerMask.PAINTED).all()
        on = (beyond_m < -0.06) & (along_m.reshape(wall.mask.shape) < surface.along_m[1] - 0.1)
        assert (wall.mask[on] > 0).mean() > 0.9
        assert np.abs(np.nanmedian(wall.depth_m[on])) < 0.001
