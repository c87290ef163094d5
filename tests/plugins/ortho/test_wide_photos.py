"""A room painted from a panorama, compared with its exact colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.read.cameras import ReadCameras
from orthoflow_plugins.read.photos import ReadPhotos

from orthoflow.files.images import encode_png
from orthoflow.geometry.frames import rotation_from_vector
from orthoflow.products import InputFiles, Layer, LayerMask
from tests.box_rooms import BoxRoom
from tests.method_runs import run
from tests.raster_scenes import SURVEY, context
from tests.wide_lenses import directions_of_panorama

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
