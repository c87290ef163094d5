"""A room painted from one photo each of a fisheye and a panorama, against its exact colours."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.read.cameras import ReadCameras
from orthoflow_plugins.read.photos import ReadPhotos
from scipy.spatial.transform import Rotation

from orthoflow.files.cube_faces import FisheyeLens
from orthoflow.files.images import encode_png
from orthoflow.geometry.frames import rotation_from_vector
from orthoflow.products import InputFiles, Layer, LayerMask
from tests.box_rooms import BoxRoom
from tests.method_runs import run
from tests.raster_scenes import SURVEY, context
from tests.wide_lenses import directions_of, directions_of_panorama

ROOM = BoxRoom(size_m=(2.4, 1.8, 1.6), middle=SURVEY, gsd_m=0.008)
CENTRE = SURVEY + np.array([0.2, -0.1, 0.75])
# World from the camera, whose axes are x right, y down, z forward: looks north, tilted and rolled.
WORLD_FROM_CAMERA = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]) @ rotation_from_vector(
    np.array([0.11, -0.16, 0.2])
)
# A circle of 180 degrees, 860 pixels wide.
FISHEYE = FisheyeLens(
    width=900,
    height=900,
    fx=280.0,
    fy=281.0,
    cx=452.5,
    cy=447.0,
    radial=(-0.02, 0.004, -0.002, 0.0003),
)
PANORAMA = (1600, 800)
NORTH, EAST, WEST, CEILING = 0, 3, 1, 4
# Of fewer the displacement is not known to a fiftieth of a cell.
FEWEST_CELLS = 500
RIM = 2


def words(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(np.asarray(values)))


def fisheye(folder: Path) -> tuple[Path, tuple[Path, ...]]:
    """A photo, and its camera as COLMAP has it."""
    photo, *model = (folder / name for name in ("fish.png", "cameras.txt", "images.txt"))
    picture = ROOM.seen(CENTRE, directions_of(FISHEYE) @ WORLD_FROM_CAMERA.T)
    photo.write_bytes(encode_png(picture))
    lens = [FISHEYE.fx, FISHEYE.fy, FISHEYE.cx, FISHEYE.cy, *FISHEYE.radial]
    model[0].write_text(f"1 OPENCV_FISHEYE {FISHEYE.width} {FISHEYE.height} {words(lens)}\n")
    turn = WORLD_FROM_CAMERA.T
    pose = words([*Rotation.from_matrix(turn).as_quat(scalar_first=True), *(-turn @ CENTRE)])
    model[1].write_text(f"1 {pose} 1 fish.png\n\n")
    return photo, tuple(model)


def panorama(folder: Path) -> tuple[Path, tuple[Path, ...]]:
    """A panorama of the whole sphere, and its camera as Metashape has it."""
    photo, xml = folder / "360.png", folder / "cameras.xml"
    # Metashape's axes are those of a camera; the directions' x forwards, y left, z up.
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
    """Cells that are painted, but not where pixels show two walls of the room at once."""
    inner = np.zeros(layer.mask.shape, dtype=bool)
    inner[RIM:-RIM, RIM:-RIM] = True
    return inner & (layer.mask == LayerMask.PAINTED)


def displacement_cells(layer: Layer, wall: int) -> NDArray[np.float64]:
    """By how much the colours of a layer lie right and down of where they are, cells."""
    cells = ROOM.cell_centres(wall)
    there = away_from_corners(layer)
    right, down = (
        (ROOM.colours(wall, cells + step) - ROOM.colours(wall, cells - step))[there].ravel() / 0.2
        for step in (np.array([0.1, 0.0]), np.array([0.0, 0.1]))
    )
    wrong = (layer.rgb - ROOM.colours(wall, cells))[there].ravel()
    found, *_ = np.linalg.lstsq(np.column_stack([-right, -down]), wrong, rcond=None)
    return np.asarray(found)


@pytest.mark.parametrize(
    ("make", "share"),
    [
        # A hemisphere ahead, in which half of each side lies; or all but the floor.
        (fisheye, {NORTH: 0.98, EAST: 0.3, WEST: 0.3, CEILING: 0.3}),
        (panorama, dict.fromkeys(range(5), 0.98)),
    ],
)
def test_a_room_is_painted_where_it_is(
    tmp_path: Path,
    make: Callable[[Path], tuple[Path, tuple[Path, ...]]],
    share: dict[int, float],
) -> None:
    layers = painted(tmp_path, *make(tmp_path))
    for wall, least in share.items():
        truth, mine = ROOM.colours(wall, ROOM.cell_centres(wall)), []
        for layer in (each for each in layers if each.wall == wall):
            mine.append(layer.mask == LayerMask.PAINTED)
            there = away_from_corners(layer)
            if there.sum() < FEWEST_CELLS:
                continue
            # A cell to the side is 13 levels at the median.
            assert np.abs(displacement_cells(layer, wall)).max() < 0.02, (layer.source, wall)
            wrong = np.abs(layer.rgb - truth)[there]
            assert np.percentile(wrong, 99) < 4.0, (layer.source, wall)
        assert np.any(mine, axis=0).mean() > least
