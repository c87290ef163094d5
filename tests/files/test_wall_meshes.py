"""Walls as triangles: where their nodes lie, which triangles are left out, how many there are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.files import gltf as module
from orthoflow.files.geotiff import GridPlace, write_raster
from orthoflow.files.gltf import WallMesh, relief_mesh
from orthoflow.geometry import WallFrame
from tests import samples

GSD_M = 0.01
SHAPE = (40, 60)


def frame(rows: int = SHAPE[0], columns: int = SHAPE[1]) -> WallFrame:
    return samples.facing_east(GSD_M, columns, rows, (1.0, 2.0, 30.0))


def slope() -> NDArray[np.float32]:
    """Depths that grow by 0.1 m to the right and 0.04 m downwards, by the middles of cells."""
    rows, columns = np.indices(SHAPE)
    return (0.1 * (columns + 0.5) / SHAPE[1] + 0.04 * (rows + 0.5) / SHAPE[0]).astype(np.float32)


def relief(folder: Path, depths_m: NDArray[np.float32], of: WallFrame | None = None) -> WallMesh:
    write_raster(folder / "depth.tif", depths_m, place=GridPlace(gsd_m=GSD_M), tags={})
    return relief_mesh(of or frame(*depths_m.shape), folder / "depth.tif")


def area_m2(mesh: WallMesh) -> float:
    """Area as the viewer sees it; triangles that turn their back count less than nothing."""
    first, second, third = (mesh.vertices[mesh.triangles[:, k], :2].astype(float) for k in range(3))
    one, other = second - first, third - first
    return float(0.5 * (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).sum())


def test_a_slope_is_where_the_depths_are(tmp_path: Path) -> None:
    mesh = relief(tmp_path, slope())
    assert len(mesh.vertices) == SHAPE[0] * SHAPE[1]
    assert area_m2(mesh) == pytest.approx(0.4 * 0.6)
    np.testing.assert_allclose(mesh.vertices[:, :2], mesh.places * [0.6, -0.4], atol=1e-6)
    # Outer nodes stand for cells half a cell further in.
    expected = 0.1 * mesh.places[:, 0] + 0.04 * mesh.places[:, 1]
    inner = ((mesh.places > 0.0) & (mesh.places < 1.0)).all(axis=1)
    np.testing.assert_allclose(mesh.vertices[inner, 2], expected[inner], atol=1e-6)
    np.testing.assert_allclose(mesh.vertices[:, 2], expected, atol=2e-3)


def test_where_no_depth_is_known_there_is_a_hole(tmp_path: Path) -> None:
    depths_m = slope()
    depths_m[10:20, 30:45] = np.nan
    mesh = relief(tmp_path, depths_m)
    # From the middles of the last known cells on either side, two corners of it halved.
    assert area_m2(mesh) == pytest.approx(0.4 * 0.6 - 0.11 * 0.16 + 0.01**2)
    assert np.isfinite(mesh.vertices).all()
    assert np.unique(mesh.triangles).tolist() == list(range(len(mesh.vertices)))
    assert len(mesh.vertices) == SHAPE[0] * SHAPE[1] - 150


def test_nodes_of_a_large_wall_are_means_of_cells(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LONGEST_NODES", 15)
    mesh = relief(tmp_path, slope())
    assert len(mesh.vertices) == 10 * 15
    first = mesh.vertices[:, 2].reshape(10, 15)[0, 0]
    assert first == pytest.approx(slope()[:4, :4].mean(), abs=1e-6)
    assert area_m2(mesh) == pytest.approx(0.4 * 0.6)
