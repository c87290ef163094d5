"""What leaves the simulation besides its points: the step of the scan, axes, a contact sheet."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.simulate import deliverables
from orthoflow_plugins.simulate.building import Paint, SceneDraft, wall_side
from orthoflow_plugins.simulate.room_model import Room
from orthoflow_plugins.simulate.scanning import SPOILT, Scan, Scanned

from orthoflow.files.images import encode_png
from orthoflow.geometry.scenes import SurfaceRole, TextureKind
from orthoflow.products import Photo, Photos, PointCloud
from orthoflow.sdk import StepContext
from tests import samples

UP = np.array([0.0, 0.0, 1.0])


def scanned(step_m: float, *, side_m: float = 2.0, hole: bool = False) -> tuple[Any, PointCloud]:
    """A wall scanned in a square grid, and some points of another plane before it."""
    at = np.arange(step_m / 2, side_m, step_m)
    u, v = (grid.ravel() for grid in np.meshgrid(at, at))
    if hole:
        keep = ~((np.abs(u - 1.0) < 0.05) & (np.abs(v - 1.0) < 0.05))
        u, v = u[keep], v[keep]
    beside = np.column_stack([u[:50], np.full(50, -0.3), v[:50]])
    points = np.vstack([np.column_stack([u, np.zeros(u.size), v]), beside])
    x, y, z = points.T.astype(np.float32)
    corners = np.array([[0.0, 0, side_m], [0, 0, 0], [side_m, 0, 0], [side_m, 0, side_m]])
    planes = samples.planes(
        normal=np.array([[0.0, -1.0, 0.0]]),
        offset=np.zeros(1),
        corners=corners[None],
        n_points=np.array([u.size]),
        names=("wall",),
    )
    labels = np.append(np.zeros(u.size, dtype=np.int16), np.full(50, -1, dtype=np.int16))
    cloud = PointCloud(origin=np.zeros(3), x=x, y=y, z=z, up=UP)
    return SimpleNamespace(planes=planes, labels=labels), cloud


@pytest.mark.parametrize("step_m", [0.005, 0.01, 0.02])
def test_the_step_of_a_square_grid_is_its_spacing(step_m: float) -> None:
    truth, cloud = scanned(step_m)
    step = deliverables.measured_step(truth, cloud, 0)
    assert step[0] == pytest.approx(step_m, rel=1e-6)
    assert step[1] == pytest.approx(step_m, rel=1e-6)


def photo(name: str, *, width: int = 640, height: int = 480, grey: int = 90) -> Photo:
    return Photo(
        name=name,
        encoded=encode_png(np.full((height, width, 3), grey, dtype=np.uint8)),
        width=width,
        height=height,
    )


@pytest.mark.usefixtures("charts")
def test_photos_are_reported_by_their_shots(tmp_path: Path) -> None:
    context = StepContext(rng=np.random.default_rng(1), cores=1, scratch=tmp_path)
    shots: Any = tuple(
        SimpleNamespace(taken=SimpleNamespace(gsd_m=gsd_m, obliquity_deg=obliquity))
        for gsd_m, obliquity in ((0.002, 5.0), (0.004, 30.0))
    )
    deliverables.report_photos(Photos(photos=(photo("a"), photo("b"))), shots, context)
    assert {metric.name: metric.value for metric in context.metrics} == {
        "n_photos": 2.0,
        "photo_megapixels": pytest.approx(2 * 0.3072),
        "photo_gsd_mm": pytest.approx(3.0),
        "photo_obliquity_max_deg": 30.0,
    }
    assert [figure.name for figure in context.figures] == ["photos"]
    silent = StepContext(rng=np.random.default_rng(1), cores=1, scratch=tmp_path)
    deliverables.report_photos(Photos(photos=()), (), silent)
    assert (silent.metrics, silent.figures) == ([], [])


# --- the cloud and the truth in the world ---

# Turned by a quarter about the vertical, and z up or y up.
WORLDS = {
    "turned": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "y up": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}
SHIFT_M = np.array([500.0, -300.0, 20.0])


def delivered(world: str) -> deliverables.Delivery:
    """Two walls of 2 m x 1 m, a panel on the first that is no plane, and nine scanned points."""
    draft = SceneDraft()
    paint = Paint(kind=TextureKind.PLAIN, rgb=(90.0, 90.0, 90.0), reflectance=0.5)
    extent = (-1.0, 1.0, -0.5, 0.5)
    for name, omega_deg in (("north", 90.0), ("east", 0.0)):
        side = wall_side(draft, omega_deg=omega_deg, phi_deg=0.0, distance_m=2.0)
        plane = side.true_plane(name, extent)
        side.place(extent, 0.0, paint, SurfaceRole.WALL, plane=plane)
        if name == "north":
            side.place((-0.1, 0.1, -0.1, 0.1), 0.05, paint, SurfaceRole.RELIEF)
    room = Room(scene=draft.finished(spectral_gap=0.0), planes=tuple(draft.planes))
    # On the north wall, its panel, the east wall, and one that was spoilt; 3 mm off in turns.
    rectangle = np.array([0, 0, 1, 2, 2, 2, 2, SPOILT, 1], dtype=np.int32)
    off = np.where(np.arange(9) % 2, 0.003, -0.003)
    points = np.zeros((9, 3))
    points[rectangle != 2] = [0.3, 2.0, 0.1]
    points[rectangle == 2] = [2.0, 0.4, -0.2]
    points[:, 1] += np.where(rectangle == 2, 0.0, off)
    points[:, 0] += np.where(rectangle == 2, off, 0.0)
    x, y, z = points.T.astype(np.float32)
    at = np.arange(9)
    scan = Scan(
        points=Scanned(
            x=x,
            y=y,
            z=z,
            intensity=np.linspace(0.0, 1.0, 9, dtype=np.float32),
            rgb=np.tile(at[:, None].astype(np.uint8), 3),
            rectangle=rectangle,
        ),
        scan=(at % 2).astype(np.uint16),
        row=at.astype(np.uint32),
        column=(at + 5).astype(np.uint32),
        stations=np.array([[0.0, 0.0, 0.0], [0.5, -0.5, 0.2]]),
    )
    return deliverables.Delivery(
        room=room, scan=scan, world_from_room=WORLDS[world], shift_world_m=SHIFT_M
    )


@pytest.mark.parametrize("world", WORLDS)
def test_true_planes_come_by_their_points_with_rectangles_along_their_walls(world: str) -> None:
    delivery = delivered(world)
    cloud = deliverables.cloud_of(delivery)
    turn = WORLDS[world]
    in_room = np.column_stack([getattr(delivery.scan.points, axis) for axis in "xyz"])
    np.testing.assert_array_equal(np.column_stack([cloud.x, cloud.y, cloud.z]), in_room @ turn.T)
    np.testing.assert_allclose(cloud.stations, delivery.scan.stations @ turn.T + SHIFT_M)
    np.testing.assert_array_equal(cloud.up, turn @ UP)
    for name in ("scan", "row", "column"):
        np.testing.assert_array_equal(getattr(cloud, name), getattr(delivery.scan, name))
    truth = deliverables.truth_of(delivery, cloud, (), {"seed": 3})
    # The east wall has four points, the north wall two; panel and spoilt points are of no plane.
    assert truth.planes.names == ("east", "north")
    assert truth.planes.n_points.tolist() == [4, 2]
    assert truth.labels.tolist() == [1, 1, -1, 0, 0, 0, 0, -1, -1]
    assert truth.scene.plane_index.tolist() == [1, -1, 0]
    assert truth.n_spoilt == 1
    np.testing.assert_allclose(truth.planes.rms_m, 0.003, rtol=1e-3)
    for k, (normal, across) in enumerate(
        (((-1.0, 0, 0), (0, -1.0, 0)), ((0, -1.0, 0), (1.0, 0, 0)))
    ):
        np.testing.assert_allclose(truth.planes.normal[k], turn @ normal, atol=1e-12)
        foot = 2.0 * -np.array(normal)
        # From the top left for who looks at it, counter-clockwise.
        corners = [
            foot + a * np.array(across) + b * UP
            for a, b in ((-1.0, 0.5), (-1.0, -0.5), (1.0, -0.5), (1.0, 0.5))
        ]
        np.testing.assert_allclose(
            truth.planes.corners[k], np.array(corners) @ turn.T + SHIFT_M, atol=1e-9
        )
        on_plane = truth.planes.corners[k] @ truth.planes.normal[k]
        np.testing.assert_allclose(on_plane, truth.planes.offset[k], atol=1e-9)
    assert truth.planes.covariance.shape == (2, 4, 4)
    assert (truth.cameras, truth.photos) == (None, ())
    assert truth.details == {"parameters": {"seed": 3}, "n_points": 9}
    np.testing.assert_array_equal(truth.scene.origin, SHIFT_M)
    np.testing.assert_allclose(truth.stations, cloud.stations)
    assert (truth.lowest_elevation_deg, truth.highest_elevation_deg) == (-62.0, 62.0)
