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
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.frames import rotation_from_vector
from orthoflow.geometry.levels import sixteen_bits
from orthoflow.products import InputFiles, Layer, LayerMask, Layers, Orthoimages, OrthoMask, Photos
from orthoflow.testing import photographed as ms
from tests import ortho_scenes as scenes
from tests.box_rooms import BoxRoom
from tests.method_runs import run
from tests.raster_scenes import SURVEY, context
from tests.wide_lenses import directions_of_panorama

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


def seen_at(viewer: ViewingCamera) -> NDArray[np.float64]:
    """Return photo positions (rows, cols, 2) of the cells of the wall."""
    rows, columns = np.mgrid[: scenes.SHAPE[0], : scenes.SHAPE[1]] + 0.5
    places = np.column_stack([columns.ravel(), rows.ravel()])
    depths = scenes.depth_m().ravel().astype(np.float64)
    points = scenes.frame().world_from_wall(places, depths)
    return viewer.project(points)[:, :2].reshape(*scenes.SHAPE, 2)


def test_nearest_brings_the_exact_levels_into_the_geotiff(tmp_path: Path) -> None:
    viewer = scenes.camera(scenes.frame())
    deep = scenes.inputs(photos=deep_photos(ramp()))
    layers, _ = scenes.laid(DsmBackward, tmp_path, deep, resampling="nearest")
    images = joined(tmp_path, layers)
    publish_orthoimages(images, tmp_path, "sha256:0")
    publish_layers(Layers(layers=layers), tmp_path, "sha256:0")
    (image,) = images.images
    shown = image.mask == OrthoMask.PAINTED
    u, v = np.floor(seen_at(viewer)[shown]).astype(int).T
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


ROOM = BoxRoom(size_m=(2.4, 1.8, 1.6), middle=SURVEY, gsd_m=0.008)
CENTRE = SURVEY + np.array([0.2, -0.1, 0.75])
# Rotation from camera axes (x right, y down, z forward) to the world, for a view to the north,
# tilted and rolled.
WORLD_FROM_CAMERA = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]) @ rotation_from_vector(
    np.array([0.11, -0.16, 0.2])
)
PANORAMA = (1600, 800)
# With fewer cells, the displacement is less accurate than a fiftieth of a cell.
FEWEST_CELLS = 500
RIM = 2


def words(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(np.asarray(values)))


def panorama(folder: Path) -> tuple[Path, tuple[Path, ...]]:
    """Return a panorama of the whole sphere, and its camera as exported by Metashape."""
    photo, xml = folder / "360.png", folder / "cameras.xml"
    # Metashape uses camera axes; directions have x forward, y left, z up.
    camera_from_panorama = np.array([[0, -1.0, 0], [0, 0, -1.0], [1.0, 0, 0]])
    rays = directions_of_panorama(*PANORAMA) @ (WORLD_FROM_CAMERA @ camera_from_panorama).T
    photo.write_bytes(encode_png(ROOM.seen(CENTRE, rays)))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = WORLD_FROM_CAMERA, CENTRE
    xml.write_text(
        '<document><chunk><sensors><sensor id="0" type="spherical"><resolution width="1600" '
        'height="800"/></sensor></sensors><cameras><camera sensor_id="0" label="360.png">'
        f"<transform>{words(matrix)}</transform></camera></cameras></chunk></document>"
    )
    return photo, (xml,)


def painted(folder: Path, photo: Path, cameras: tuple[Path, ...]) -> tuple[Layer, ...]:
    given = InputFiles(name="cameras", paths=cameras)
    files = {"files": InputFiles(name="photos", paths=(photo,)), "cameras": given}
    photos = run(ReadPhotos, context(folder), files, panoramas=("360*",)).photos
    poses = run(ReadCameras, context(folder), {"files": given, "photos": photos}).cameras
    assert all(camera.status == "ok" for camera in poses.cameras)
    inputs = {"walls": ROOM.walls(), "photos": photos, "cameras": poses}
    layers: tuple[Layer, ...] = run(DsmBackward, context(folder), inputs).layers.layers
    return layers


def away_from_corners(layer: Layer) -> NDArray[np.bool_]:
    """Return a mask of painted cells, except where pixels show two walls of the room."""
    inner = np.zeros(layer.mask.shape, dtype=bool)
    inner[RIM:-RIM, RIM:-RIM] = True
    return inner & (layer.mask == LayerMask.PAINTED)


def displacement_cells(layer: Layer, wall: int) -> NDArray[np.float64]:
    """Return the displacement of a layer's colours to the right and down, in cells."""
    cells = ROOM.cell_centres(wall)
    there = away_from_corners(layer)
    right, down = (
        (ROOM.colours(wall, cells + step) - ROOM.colours(wall, cells - step))[there].ravel() / 0.2
        for step in (np.array([0.1, 0.0]), np.array([0.0, 0.1]))
    )
    wrong = (layer.rgb - ROOM.colours(wall, cells))[there].ravel()
    found, *_ = np.linalg.lstsq(np.column_stack([-right, -down]), wrong, rcond=None)
    return np.asarray(found)


def test_a_room_is_painted_where_it_is(tmp_path: Path) -> None:
    layers = painted(tmp_path, *panorama(tmp_path))
    # All surfaces except the floor.
    for wall in range(5):
        truth, mine = ROOM.colours(wall, ROOM.cell_centres(wall)), []
        for layer in (each for each in layers if each.wall == wall):
            mine.append(layer.mask == LayerMask.PAINTED)
            there = away_from_corners(layer)
            if there.sum() < FEWEST_CELLS:
                continue
            # A displacement of one cell changes colours by 13 levels (median).
            assert np.abs(displacement_cells(layer, wall)).max() < 0.02, (layer.source, wall)
            wrong = np.abs(layer.rgb - truth)[there]
            assert np.percentile(wrong, 99) < 4.0, (layer.source, wall)
        assert np.any(mine, axis=0).mean() > 0.98
