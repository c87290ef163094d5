"""`read.orthoimage`: images from other programs have the positions given in their files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from orthoflow_plugins.read.orthoimage import ReadOrthoimage
from rasterio.transform import Affine

from orthoflow.errors import InputError
from orthoflow.files.publishing import publish_orthoimages
from orthoflow.files.sidecars import frame_json
from orthoflow.products import Orthoimage, Orthoimages
from tests import inspect_scenes
from tests.method_runs import Reader

CORNER_M = (0.08, -0.04)


def write(
    path: Path, values: NDArray[np.generic], transform: Affine, *, nodata: float | None = None
) -> Path:
    """Write a GeoTIFF as another program would; values (bands, rows, cols)."""
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        count=len(values),
        dtype=str(values.dtype),
        height=values.shape[1],
        width=values.shape[2],
        transform=transform,
        crs="EPSG:2180",
        nodata=nodata,
    ) as dataset:
        dataset.write(values)
    return path


def read(folder: Path, *paths: Path, wall: int = 0) -> tuple[Orthoimage, ...]:
    found = Reader(ReadOrthoimage, folder).run(tuple(sorted(paths)), {"wall": wall})
    return found.orthoimages.images  # type: ignore[no-any-return]


def foreign(folder: Path) -> list[Path]:
    """Return a part of the wall's texture with cells twice as large, and the frame of the wall."""
    means = inspect_scenes.texture().reshape(140, 2, 180, 2).mean(axis=(1, 3))[5:, 10:]
    values = np.repeat(np.rint(means).astype(np.uint8)[None], 3, axis=0)
    side = 2.0 * inspect_scenes.GSD_M
    image = write(
        folder / "theirs.tif", values, Affine(side, 0, CORNER_M[0], 0, -side, CORNER_M[1])
    )
    place = folder / "theirs.json"
    place.write_text(json.dumps(frame_json(inspect_scenes.frame())))
    return [image, place]


def test_a_foreign_image_lies_where_its_transform_says(tmp_path: Path) -> None:
    (image,) = read(tmp_path, *foreign(tmp_path))
    wall = inspect_scenes.frame()
    assert image.frame.gsd_m == pytest.approx(0.008)
    corner = wall.wall_from_world(image.frame.origin_world[None])[0]
    np.testing.assert_allclose(corner, [20.0, 10.0, 0.0], atol=1e-9)
    assert (image.mask == 1).all()


def test_our_own_files_need_no_frame_beside_them(tmp_path: Path) -> None:
    ours = inspect_scenes.displaced(0.0, 0.0)
    folder = tmp_path / "mosaic"
    folder.mkdir()
    publish_orthoimages(Orthoimages(images=(ours,)), folder, "digest")
    (image,) = read(tmp_path, folder / "wall_0_ortho.tif", folder / "wall_0_ortho_mask.tif")
    np.testing.assert_array_equal(image.rgb, ours.rgb)
    assert image.frame.has_cells_of(ours.frame)
    assert image.name == ours.name


def test_what_cannot_be_placed_says_why(tmp_path: Path) -> None:
    image, place = foreign(tmp_path)
    with pytest.raises(InputError, match=r"theirs\.tif does not contain its position"):
        read(tmp_path, image)
    with pytest.raises(InputError, match="contains no GeoTIFF"):
        read(tmp_path, place)
    place.write_text("{")
    with pytest.raises(InputError, match=r"theirs\.json: not valid JSON"):
        read(tmp_path, image, place)
    place.write_text('{"origin_world": [1, 2]}')
    with pytest.raises(InputError, match="origin_world must be three numbers"):
        read(tmp_path, image, place)
    values = np.zeros((3, 4, 5), dtype=np.uint8)
    write(image, values, Affine(0.01, 0, 0, 0, -0.02, 0))
    with pytest.raises(InputError, match="not square or not aligned"):
        read(tmp_path, image, place)
    image, place = foreign(tmp_path)
    write(image, values[:3], Affine(0.01, 0, 0, 0, 0.01, 0))
    with pytest.raises(InputError, match="its rows run up along Y"):
        read(tmp_path, image, place)


def test_two_images_of_one_wall_are_refused(tmp_path: Path) -> None:
    image, place = foreign(tmp_path)
    other, there = (path.with_stem("others") for path in (image, place))
    other.write_bytes(image.read_bytes())
    there.write_text(place.read_text())
    with pytest.raises(InputError, match="both show wall 0"):
        read(tmp_path, image, place, other, there)
    there.write_text(json.dumps(json.loads(place.read_text()) | {"wall": 2}))
    assert [found.wall for found in read(tmp_path, image, place, other, there)] == [0, 2]
