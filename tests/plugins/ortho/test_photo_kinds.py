"""Photos of 16 bits and photos with very wide lenses, projected onto walls."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from orthoflow_plugins.mosaic.seams import MosaicSeams
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.dsm_forward import DsmForward
from orthoflow_plugins.read.cameras import ReadCameras
from orthoflow_plugins.read.photos import ReadPhotos

from orthoflow.files.images import encode_png
from orthoflow.files.publishing import publish_layers, publish_orthoimages
from orthoflow.geometry.cameras import looking_at
from orthoflow.geometry.frames import rotation_from_vector
from orthoflow.geometry.levels import sixteen_bits
from orthoflow.products import InputFiles, Layer, LayerMask, Layers, Orthoimages, OrthoMask, Photos
from orthoflow.testing import photographed as ms
from tests import ortho_scenes as scenes
from tests import samples
from tests.method_runs import run
from tests.raster_scenes import context

SIDE_PX = (1000, 800)


def ramp() -> NDArray[np.uint16]:
    """Return an image whose red rises by 60 per column and green by 80 per row; blue is odd."""
    rows, columns = np.mgrid[: SIDE_PX[1], : SIDE_PX[0]]
    deep = np.dstack([60 * columns + 7, 80 * rows + 11, np.full_like(rows, 12345)])
    return deep.astype(np.uint16)


def deep_photos(*pictures: NDArray[np.uint16] | NDArray[np.uint8]) -> Photos:
    plain = scenes.photos(*(np.zeros((*picture.shape[:2], 3), np.uint8) for picture in pictures))
    pairs = zip(plain.photos, pictures, strict=True)
    return ms.photos(*(replace(photo, encoded=encode_png(picture)) for photo, picture in pairs))


def joined(folder: Path, layers: tuple[Layer, ...], **params: object) -> Orthoimages:
    inputs = {"layers": Layers(layers=layers)}
    images: Orthoimages = run(MosaicSeams, context(folder), inputs, **params).orthoimages
    return images


def test_nearest_brings_the_exact_levels_into_the_geotiff(tmp_path: Path) -> None:
    viewer = scenes.camera(scenes.frame())
    deep = scenes.inputs(photos=deep_photos(ramp()))
    layers, _ = scenes.laid(DsmBackward, tmp_path, deep, resampling="nearest")
    images = joined(tmp_path, layers)
    publish_orthoimages(images, tmp_path, "sha256:0")
    publish_layers(Layers(layers=layers), tmp_path, "sha256:0")
    (image,) = images.images
    shown = image.mask == OrthoMask.PAINTED
    u, v = np.floor(scenes.seen_at(viewer)[shown]).astype(int).T
    for name in ("wall_0_ortho", "wall_0_layer_0_0"):
        with rasterio.open(tmp_path / f"{name}.tif") as file:
            assert file.dtypes == ("uint16",) * 3
            written = np.moveaxis(file.read(), 0, 2)
            assert (file.dataset_mask()[shown] == 255).all()
        # The cells have the photo's pixels, except where rounding decides between two.
        same = (written[shown] == ramp()[v, u]).all(axis=1)
        assert same.mean() > 0.999
        assert np.isin(written[shown][:, 0], ramp()[0, :, 0]).all()
        assert np.isin(written[shown][:, 1], ramp()[:, 0, 1]).all()
        assert len(np.unique(written[..., 1])) > 256
        assert json.loads((tmp_path / f"{name}.json").read_text())["bits"] == 16


def test_forward_paints_the_photos_own_levels(tmp_path: Path) -> None:
    deep = scenes.inputs(photos=deep_photos(ramp()))
    ((layer,), _) = scenes.laid(DsmForward, tmp_path, deep)
    assert layer.rgb.dtype == np.uint16
    assert layer.filled is not None
    own = (layer.mask == LayerMask.PAINTED) & (layer.filled == 0)
    assert np.isin(layer.rgb[own][:, 0], ramp()[0, :, 0]).all()
    filled = layer.filled > 0
    assert filled.any()
    # Filled cells have levels between those of their neighbours.
    assert (np.abs(layer.rgb[filled][:, 2].astype(int) - 12345) <= 1).all()


def test_a_block_of_both_depths_has_sixteen_bits_and_says_so(tmp_path: Path) -> None:
    viewers = [scenes.camera(scenes.frame(), aside_m=aside) for aside in (-0.7, 0.7)]
    plain = scenes.rendered(aside_m=0.7)
    both = scenes.inputs(viewers=viewers, photos=deep_photos(ramp(), plain))
    layers, ctx = scenes.laid(DsmBackward, tmp_path, both, resampling="nearest")
    one = scenes.inputs(plain, viewers=viewers[1:])
    ((alone,), _) = scenes.laid(DsmBackward, tmp_path, one, resampling="nearest")
    assert [layer.rgb.dtype for layer in layers] == [np.uint16, np.uint16]
    assert alone.rgb.dtype == np.uint8
    np.testing.assert_array_equal(layers[1].rgb, sixteen_bits(alone.rgb))
    found = [(diagnostic.code, diagnostic.values["n"]) for diagnostic in ctx.diagnostics]
    assert found == [("photos-of-mixed-depth", 1)]
    assert joined(tmp_path, layers, seams="graph-cut").images[0].rgb.dtype == np.uint16


# The camera looks past the wall to the north-east and down, so that three faces of the panorama
# meet on the wall.
PANORAMA = (1600, 800)
WORLD_FROM_CAMERA = looking_at(
    np.zeros(3), np.array([0.43, -0.36, -0.83]), samples.UP
).T @ rotation_from_vector(np.array([0.02, -0.03, 0.05]))


def panorama(folder: Path) -> tuple[Path, Path]:
    """Return a panorama of the wall and its camera as exported by Metashape."""
    photo, xml = folder / "360.png", folder / "cameras.xml"
    where, (width, height) = scenes.frame(), PANORAMA
    centre = scenes.camera(where, aside_m=0.0).centre_world
    azimuth = (width / 2 - np.arange(width) - 0.5) * (2 * np.pi / width)
    elevation = ((height / 2 - np.arange(height) - 0.5) * (np.pi / height))[:, None]
    level = np.cos(elevation)
    # In camera axes: x right, y down, z forward; the panorama has its middle in front.
    rays = np.stack(
        [-level * np.sin(azimuth), -np.sin(elevation) + 0 * azimuth, level * np.cos(azimuth)], -1
    ).reshape(-1, 3)
    seen = scenes.cast(where, np.broadcast_to(centre, rays.shape), rays @ WORLD_FROM_CAMERA.T)
    photo.write_bytes(encode_png(scenes.colours(seen).reshape(height, width, 3)))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = WORLD_FROM_CAMERA, centre
    numbers = " ".join(repr(float(value)) for value in matrix.ravel())
    xml.write_text(
        '<document><chunk><sensors><sensor id="0" type="spherical"><resolution '
        f'width="{width}" height="{height}"/></sensor></sensors><cameras><camera sensor_id="0" '
        f'label="360.png"><transform>{numbers}</transform></camera></cameras></chunk></document>'
    )
    return photo, xml


def test_the_faces_of_a_panorama_paint_a_wall_where_it_is(tmp_path: Path) -> None:
    photo, xml = panorama(tmp_path)
    given = InputFiles(name="cameras", paths=(xml,))
    files = {"files": InputFiles(name="photos", paths=(photo,)), "cameras": given}
    photos = run(ReadPhotos, context(tmp_path), files, panoramas=("360*",)).photos
    poses = run(ReadCameras, context(tmp_path), {"files": given, "photos": photos}).cameras
    assert all(camera.status == "ok" for camera in poses.cameras)
    inputs = scenes.inputs(photos=photos, cameras=poses)
    layers, _ = scenes.laid(DsmBackward, tmp_path, inputs)
    n_cells = [np.count_nonzero(layer.mask == LayerMask.PAINTED) for layer in layers]
    assert sorted(layer.source for layer in layers) == [
        "360_front.png",
        "360_right.png",
        "360_up.png",
    ]
    assert min(n_cells) > 5_000
    is_visible, _ = scenes.visible(scenes.camera(scenes.frame(), aside_m=0.0))
    painted = np.any([layer.mask == LayerMask.PAINTED for layer in layers], axis=0)
    assert painted[is_visible].mean() > 0.96
    for layer in layers:
        off = scenes.places_off(layer)[layer.mask == LayerMask.PAINTED]
        # Cells where counts begin again and those at the step have mixed colours.
        is_plain = (np.abs(off) < 2.0).all(axis=1)
        assert is_plain.mean() > 0.9
        assert np.abs(off[is_plain].mean(axis=0)).max() < 0.01, layer.source
