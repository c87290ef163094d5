"""From a TIFF of 16 bits to the published GeoTIFF with the command line, no level lost."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray

from orthoflow.files.publishing import publish_cameras
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.testing import photographed as ms
from tests import samples
from tests.road.conftest import Shell

WORKFLOW = """
orthoflow: 1
name: deep
inputs:
  scan: {files: scan.xyz}
  photos: {files: photos}
  cameras: {files: cameras.json}
steps:
  cloud: {use: read.scan, in: {files: inputs.scan}, params: {view_from: [0.6, -2.0, 0.4]}}
  shots: {use: read.photos, in: {files: inputs.photos}}
  plane:
    use: plane.given
    in: {cloud: cloud.cloud}
    params: {points: [[0, 0, 0], [1, 0, 0], [0, 0, 1]]}
  wall: {use: raster.grid, in: {cloud: cloud.cloud, planes: plane.planes}, params: {gsd_m: 0.004}}
  poses: {use: read.cameras, in: {files: inputs.cameras, photos: shots.photos}}
  ortho:
    use: ortho.dsm-backward
    in: {walls: wall.walls, photos: shots.photos, cameras: poses.cameras}
    params: {resampling: nearest, visibility: none}
  mosaic: {use: mosaic.seams, in: {layers: ortho.layers}}
"""


def ramp(viewer: ViewingCamera) -> NDArray[np.uint16]:
    """Red tells the column, green the row, blue both in its lowest bits."""
    rows, columns = np.mgrid[: viewer.height, : viewer.width]
    return np.dstack([90 * columns + 5, 110 * rows + 3, columns + rows]).astype(np.uint16)


def straight_camera() -> ViewingCamera:
    """A camera 2 m before the middle of a wall of 1.2 x 0.8 m in y = 0, pixels of 2 mm."""
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return samples.camera(
        rotation,
        np.array([0.6, -2.0, 0.4]),
        width=640,
        height=480,
        fx=1000.0,
        fy=1000.0,
        cx=320.3,
        cy=240.2,
    )


@pytest.fixture
def site(tmp_path: Path, store: Path) -> Shell:
    """A folder with a scan of a plane wall, a photo of 16 bits and its pose."""
    viewer, rng = straight_camera(), np.random.default_rng(1)
    x, z = (
        grid.ravel() for grid in np.meshgrid(np.arange(0, 1.2, 0.003), np.arange(0, 0.8, 0.003))
    )
    noise = rng.normal(0.0, 2e-4, x.size)
    np.savetxt(tmp_path / "scan.xyz", np.column_stack([x, noise, z]), fmt="%.5f")
    (tmp_path / "photos").mkdir()
    deep = ramp(viewer)[..., ::-1]
    assert cv2.imwrite(str(tmp_path / "photos" / "a.tif"), np.ascontiguousarray(deep))
    publish_cameras(ms.cameras(ms.oriented(viewer, name="a.tif")), tmp_path, "sha256:0")
    (tmp_path / "deep.yaml").write_text(WORKFLOW)
    return Shell(tmp_path, store)


def test_sixteen_bits_come_from_tiff_to_geotiff(site: Shell) -> None:
    site("run", "deep.yaml", "-o", "run", "--executor", "inline", timeout_s=900)
    folder = site.folder / "run" / "products" / "mosaic"
    about = json.loads((folder / "wall_0_ortho.json").read_text())
    assert about["bits"] == 16
    with rasterio.open(folder / "wall_0_ortho.tif") as file:
        assert file.dtypes == ("uint16",) * 3
        colours, shown = np.moveaxis(file.read(), 0, 2), file.dataset_mask() > 0
    assert shown.mean() > 0.95
    # Which pixel of the photo each cell must have taken.
    rows, columns = np.nonzero(shown)
    corner, u, v = (np.array(about[key]) for key in ("origin_world", "u_world", "v_world"))
    places = corner + about["gsd_m"] * (np.outer(columns + 0.5, u) + np.outer(rows + 0.5, v))
    seen = np.floor(straight_camera().project(places)[:, :2]).astype(int)
    taken = ramp(straight_camera())[seen[:, 1], seen[:, 0]]
    # The wall is rough by a fifth of a millimetre: a cell at the rim of a pixel may take the next.
    assert (colours[shown] == taken).all(axis=1).mean() > 0.9
    assert (np.abs(colours[shown].astype(int) - taken) <= [90, 110, 2]).all()
    assert np.isin(colours[shown][:, 0], ramp(straight_camera())[0, :, 0]).all()
    assert len(np.unique(colours[shown][:, 0])) > 256
