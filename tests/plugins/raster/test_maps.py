"""Rasters of horizontal planes as maps: conditions, positions and refusals."""

from __future__ import annotations

import select
import socket
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.raster.frames import mapped

from orthoflow.errors import MethodError
from orthoflow.files.geotiff import read_raster
from orthoflow.files.publishing import publish_walls
from orthoflow.files.sidecars import frame_json, frame_of_raster
from orthoflow.geometry.frames import WallFrame, frame_over, rotation_from_vector
from orthoflow.products import Planes
from tests import raster_scenes as scenes
from tests import samples
from tests.scenes import SURVEY_SHIFT_M

GSD = 0.1
UP = np.array([0.0, 0.0, 1.0])


def level(tilt_rad: float = 0.0, *, down: bool = False, up: np.ndarray = UP) -> Planes:
    """Return a plane 4.03 m wide and 3.01 m deep at survey coordinates."""
    corners = np.array([[0, 3.01, 0], [0, 0, 0], [4.03, 0, 0], [4.03, 3.01, 0]])
    turn = rotation_from_vector(np.array([tilt_rad, 0.0, 0.0]))
    corners = corners @ turn.T + SURVEY_SHIFT_M
    normal = turn @ UP
    if down:
        normal, corners = -normal, corners[[3, 2, 1, 0]]
    return samples.planes(
        normal=normal[None],
        offset=np.array([normal @ corners[0]]),
        corners=corners[None],
        rms_m=np.array([0.001]),
        up=up,
        names=("floor 1",),
        viewpoint="given",
    )


def placed(planes: Planes, folder: Path, crs: str = "site") -> tuple[WallFrame, list[str]]:
    ctx = scenes.context(folder)
    frames = {0: frame_over(planes.corners[0], planes.normal[0], gsd_m=GSD)}
    found = mapped(frames, planes, crs, reach_m=1.0, ctx=ctx)
    return found[0], list(ctx.warnings)


def test_whole_cells_reach_beyond_the_rectangle_alike_on_all_sides(tmp_path: Path) -> None:
    planes = level()
    frame, warnings = placed(planes, tmp_path)
    assert (frame.map_crs, warnings) == ("site", [])
    off_m = frame.corners_world() - planes.corners[0]
    # 4.03 m are 41 cells, 3.01 m are 31 cells.
    np.testing.assert_allclose(np.abs(off_m), np.tile([0.035, 0.045, 0.0], (4, 1)), atol=1e-9)


def test_only_level_planes_seen_from_above_are_maps(tmp_path: Path) -> None:
    assert placed(level(0.01), tmp_path)[0].map_crs == "site"
    frame, warnings = placed(level(0.1), tmp_path)
    assert frame.map_crs is None
    assert "floor 1 is tilted by 5.7 deg" in warnings[0]
    assert "applies to no raster" in warnings[1]
    # A ceiling is not a map either.
    frame, warnings = placed(level(down=True), tmp_path)
    assert frame.map_crs is None
    assert "none of the planes is horizontal and seen from above" in warnings[0]


@pytest.mark.parametrize(
    ("crs", "up", "said"),
    [
        ("EPSG:4326", UP, "EPSG:4326 is not a coordinate system in metres"),
        ("EPSG:2225", UP, "EPSG:2225 is not a coordinate system in metres"),  # US survey feet
        ("EPSG:9999", UP, "there is no coordinate system EPSG:9999"),
        ("/etc/passwd", UP, "there is no coordinate system /etc/passwd"),
        ("site", -UP, "needs a cloud with x east, y north and z up"),
    ],
)
def test_maps_must_be_in_metres(tmp_path: Path, crs: str, up: np.ndarray, said: str) -> None:
    with pytest.raises(MethodError, match=said):
        placed(level(up=up), tmp_path, crs)


def test_no_url_is_opened_for_a_crs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # GDAL also accepts URLs, and untrusted workflows and records may contain any.
    monkeypatch.setenv("GDAL_HTTP_TIMEOUT", "1")
    with socket.create_server(("127.0.0.1", 0)) as server:
        crs = f"http://127.0.0.1:{server.getsockname()[1]}/crs"
        with pytest.raises(MethodError, match="there is no coordinate system http://127"):
            placed(level(), tmp_path, crs)
        assert select.select([server], [], [], 0.0)[0] == []


def test_a_map_reads_back_to_where_it_lies(tmp_path: Path) -> None:
    frame, _ = placed(level(), tmp_path, "EPSG:2100")
    cloud = scenes.cloud_of(
        np.random.default_rng(1).uniform([0, 0, -0.01], [4.03, 3.01, 0.01], (20_000, 3))
        + SURVEY_SHIFT_M
    )
    walls, _ = scenes.rastered(cloud, level(), tmp_path, gsd_m=GSD, crs="EPSG:2100")
    publish_walls(walls, tmp_path, "digest")
    raster = read_raster(tmp_path / "wall_0_depth.tif")
    assert 'AUTHORITY["EPSG","2100"]' in raster.crs_wkt
    assert raster.place.corner_m == pytest.approx(tuple(frame.origin_world[:2]), abs=1e-9)
    again = frame_of_raster(
        frame_json(walls.walls[0].frame), raster=raster.place, shape=raster.values.shape, name="map"
    )
    assert again.has_cells_of(frame)
    assert again.map_crs == "EPSG:2100"
