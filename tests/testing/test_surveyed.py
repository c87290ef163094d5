"""The examples: the same bits on every processor, and what methods need to show anything."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from orthoflow.engine.store import digest_of
from orthoflow.geometry import Plane
from orthoflow.products import (
    Calibration,
    CheckPoints,
    Intrinsics,
    LayerMask,
    Layers,
    Openings,
    Orthoimages,
    OrthoMask,
    OutlineSource,
    Planes,
    PointCloud,
    PointLabels,
    SurfaceMask,
    Truth,
    Walls,
)
from orthoflow.testing.examples import example
from orthoflow.testing.photographed import (
    PHOTOGRAPHED,
    photographed_scene,
    photographing_cameras,
)
from orthoflow.testing.surveyed import SURVEYED, settled

_DIGESTS = """
import json
from orthoflow.engine.store import digest_of
from orthoflow.testing.photographed import PHOTOGRAPHED
from orthoflow.testing.surveyed import SURVEYED
both = {"surveyed": SURVEYED, "photographed": PHOTOGRAPHED}
print(json.dumps({f"{a} {b}": digest_of(make()) for a in both for b, make in both[a].items()}))
"""


def test_examples_keep_their_bits_without_wide_instructions() -> None:
    switched_off = {"NPY_DISABLE_CPU_FEATURES": "X86_V3", "OPENBLAS_CORETYPE": "Nehalem"}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", _DIGESTS],
        env={**os.environ, **switched_off, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    both = {"surveyed": SURVEYED, "photographed": PHOTOGRAPHED}
    here = {f"{a} {b}": digest_of(make()) for a in both for b, make in both[a].items()}
    assert json.loads(done.stdout) == here


# Examples that methods of ours take, each held by what they gave for it.
TAKEN = {
    "surveyed": ("cloud", "truth", "planes", "walls", "layers"),
    "photographed": ("photos", "cameras", "ties", "walls", "cloud"),
}


def test_golden_results_are_of_these_examples() -> None:
    """Where an example moved, every result of it would be recorded anew and none be held."""
    golden = json.loads((Path(__file__).parents[1] / "golden.json").read_text())
    recorded = {
        (port, given["digest"])
        for result in golden.values()
        for port, given in result["inputs"].items()
    }
    for scene, makers in (("surveyed", SURVEYED), ("photographed", PHOTOGRAPHED)):
        for port in TAKEN[scene]:
            assert (port, digest_of(makers[port]())) in recorded, (scene, port)


def test_the_opening_is_the_void_of_the_main_wall() -> None:
    walls, openings = example("walls"), example("openings")
    assert isinstance(walls, Walls)
    assert isinstance(openings, Openings)
    wall, (opening,) = walls.walls[0], openings.openings
    frame = wall.frame
    rows, columns = np.nonzero(wall.mask == SurfaceMask.VOID)
    low = np.array([columns.min(), rows.min()])
    high = np.array([columns.max(), rows.max()]) + 1
    cells = np.array([[low[0], low[1]], [low[0], high[1]], [high[0], high[1]], [high[0], low[1]]])
    np.testing.assert_allclose(frame.wall_from_world(opening.outline_world)[:, :2], cells)
    # Metres from the upper left corner, upwards.
    np.testing.assert_allclose(opening.outline_m, frame.gsd_m * cells * [1, -1])
    assert opening.area_m2 == pytest.approx(frame.gsd_m**2 * len(rows))
    assert (opening.width_m, opening.height_m) == pytest.approx(frame.gsd_m * (high - low))
    assert opening.sill_m == pytest.approx(frame.gsd_m * (frame.height - high[1]))
    assert (opening.wall, openings.walls) == (wall.plane_index, (wall.plane_index,))
    assert set(opening.side_source) == {OutlineSource.DEPTH}
    assert len(set(opening.side_sigma_m)) == 1
    assert 0.0 < opening.side_sigma_m[0] < frame.gsd_m
    assert (opening.depth_m, opening.seen_share) == (None, 1.0)


def test_the_lens_and_the_check_points_are_those_of_the_photographed_wall() -> None:
    calibration, checks = PHOTOGRAPHED["calibration"](), PHOTOGRAPHED["checkpoints"]()
    assert isinstance(calibration, Calibration)
    assert isinstance(checks, CheckPoints)
    first = photographing_cameras()["a.png"]
    assert (calibration.patterns, calibration.intrinsics) == (("*",), (Intrinsics.of(first),))
    frame = photographed_scene().frame
    assert (len(set(checks.names)), set(checks.classes)) == (5, {"flat"})
    assert not checks.wall.any()
    places = frame.wall_from_world(checks.points_world)
    np.testing.assert_allclose(places[:, :2], checks.pixels_wall)
    np.testing.assert_allclose(places[:, 2], 0.0, atol=1e-12)
    # All over the wall, and within it.
    assert (checks.pixels_wall > 0).all()
    assert (checks.pixels_wall < [frame.width, frame.height]).all()
    assert (np.ptp(checks.pixels_wall, axis=0) > 0.6 * np.array([frame.width, frame.height])).all()


@pytest.mark.parametrize("noise", [1e-16, -3e-13])
def test_settled_numbers_lose_rounding_errors_and_the_sign_of_zero(noise: float) -> None:
    exact = np.array([0.0, 1.25, -2.4, 0.978052255])
    assert settled(exact + noise).tobytes() == settled(exact).tobytes() == exact.tobytes()
    assert not np.signbit(settled(np.array([-1e-15]))[0])


def test_the_rasters_lie_on_the_planes_that_the_cloud_shows() -> None:
    planes, walls, cloud = example("planes"), example("walls"), example("cloud")
    labels, truth = example("labels"), example("truth")
    assert isinstance(planes, Planes)
    assert isinstance(walls, Walls)
    assert isinstance(cloud, PointCloud)
    assert isinstance(labels, PointLabels)
    assert isinstance(truth, Truth)
    points = cloud.points_world()
    for index, wall in enumerate(walls.walls):
        plane = planes.plane(index)
        assert isinstance(plane, Plane)
        np.testing.assert_allclose(plane.distances_m(wall.frame.corners_world()), 0.0, atol=1e-8)
        on_plane = labels.plane_index == index
        np.testing.assert_array_equal(on_plane, truth.labels == index)
        assert set(np.unique(labels.plane_index)) == {-1, 0, 1}
        distances = np.abs(plane.distances_m(points[on_plane]))
        assert np.median(distances) < 0.003  # metres; the scanner's noise is 1.5 mm
        cells = wall.frame.wall_from_world(points[on_plane])[:, :2]
        assert (cells > -1.0).all()
        assert (cells < [wall.frame.width + 1.0, wall.frame.height + 1.0]).all()


def test_every_state_of_a_cell_occurs() -> None:
    walls, layers, orthoimages = example("walls"), example("layers"), example("orthoimages")
    assert isinstance(walls, Walls)
    assert isinstance(layers, Layers)
    assert isinstance(orthoimages, Orthoimages)
    for wall in walls.walls:
        assert set(np.unique(wall.mask)) == set(SurfaceMask)
        void = wall.mask == SurfaceMask.VOID
        np.testing.assert_array_equal(np.isnan(wall.depth_m), void)
        assert wall.intensity is not None
        np.testing.assert_array_equal(np.isnan(wall.intensity), void)
        np.testing.assert_array_equal(wall.count > 0, wall.mask == SurfaceMask.MEASURED)
    for layer in layers.layers:
        assert set(np.unique(layer.mask)) == set(LayerMask)
        painted = layer.mask == LayerMask.PAINTED
        np.testing.assert_array_equal(layer.quality > 0.0, painted)
        assert layer.filled is not None
        assert layer.filled.any()
        assert painted[layer.filled > 0].all()
        assert not layer.rgb[~painted].any()
    for index, image in enumerate(orthoimages.images):
        assert set(np.unique(image.mask)) == set(OrthoMask) - {
            OrthoMask.NONE,
            OrthoMask.CONTRADICTED,
        }
        left, right = layers.layers[2 * index : 2 * index + 2]
        for place, layer in enumerate((left, right)):
            shown = image.source == place
            np.testing.assert_array_equal(image.rgb[shown], layer.rgb[shown])
            assert (layer.mask[shown] == LayerMask.PAINTED).all()
        # The better of the two; where neither sees anything, one row of four is grey.
        seen = (left.mask == LayerMask.PAINTED) | (right.mask == LayerMask.PAINTED)
        np.testing.assert_array_equal(image.mask == OrthoMask.PAINTED, seen)
        np.testing.assert_array_equal(image.source >= 0, seen)
        np.testing.assert_array_equal(image.source == 1, right.quality > left.quality)
        filled = image.mask == OrthoMask.FILLED
        hidden = (left.mask == LayerMask.OCCLUDED) & ~seen
        np.testing.assert_array_equal(filled | (image.mask == OrthoMask.OCCLUDED), hidden)
        assert {*np.flatnonzero(filled.any(axis=1))} == {
            row for row in np.flatnonzero(hidden.any(axis=1)) if row % 4 == 0
        }
        assert (image.rgb[filled] == 128).all()
        assert image.sources == (left.source, right.source) == ("left.jpg", "right.jpg")


def test_walls_are_stained_smoothly_from_dark_to_light() -> None:
    walls = example("walls")
    assert isinstance(walls, Walls)
    for wall in walls.walls:
        assert wall.intensity is not None
        grey = 256.0 * wall.intensity.astype(np.float64)
        known = np.isfinite(grey)
        assert np.nanmin(grey) >= 40.0
        assert np.nanmax(grey) <= 215.0
        assert np.nanstd(grey) > 20.0
        # Straight between places eight cells apart: nowhere steeper than that and bent only there.
        for axis in (0, 1):
            assert np.nanmax(abs(np.diff(grey, axis=axis))) <= 175.0 / 8.0 + 1e-3
            bend = abs(np.diff(grey, n=2, axis=axis))
            lines = np.moveaxis(bend, axis, 0)
            at_places = (np.arange(len(lines)) + 1) % 8 == 0
            assert np.nanmax(lines[~at_places]) < 1e-3
            assert np.nanmax(lines[at_places]) > 1.0
        assert known.any()
