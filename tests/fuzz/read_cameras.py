"""Readers of what other programs say of photos, as targets of the fuzzing: cameras, ties, E57."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from random import Random
from typing import Final

import numpy as np
import pycolmap
from orthoflow_plugins.read.cameras import ReadCameras
from orthoflow_plugins.read.photos import ReadPhotos
from orthoflow_plugins.read.ties import ReadTies

from orthoflow.engine.store import digest_of
from orthoflow.files.colmap import write_colmap_model
from orthoflow.files.e57_images import count_e57_images
from orthoflow.files.images import encode_jpeg, encode_png
from orthoflow.files.publishing import publish_cameras
from orthoflow.products import Camera, Cameras, InputFiles, Intrinsics, Photo, Photos, Product
from orthoflow.sdk import Method
from orthoflow.testing.trials import Trial, run_trial
from orthoflow.workflow.draft import draft_workflow, recognised
from tests import photo_files, scan_files
from tests.files import test_metashape as agisoft
from tests.fuzz.harness import Target
from tests.fuzz.mutation import mutate_bytes, mutate_e57, mutate_json, mutate_png, mutate_text

_WIDTH, _HEIGHT = 64, 48
_PHOTOS: Final = ("a.jpg", "b.jpg")


def _photos() -> Photos:
    return Photos(
        photos=tuple(
            Photo(name=name, width=_WIDTH, height=_HEIGHT, encoded=b"") for name in _PHOTOS
        )
    )


def _read(method: type[Method], paths: Sequence[Path], **more: Product) -> object:
    files = InputFiles(name="files", paths=tuple(paths))
    trial = Trial(method=method, inputs={"files": files, **more})
    return run_trial(trial, paths[0].parent / "scratch", draws=False).digests


# Cameras ------------------------------------------------------------------------------------------

_OF_FIRST, _OF_SECOND = 'sensor_id="0"', 'sensor_id="1"'
_METASHAPE: Final = agisoft.document(
    sensors=agisoft.sensor_of(agisoft.TERMS)
    + '<sensor id="1" label="360" type="spherical"><resolution width="256" height="128"/></sensor>',
    chunk="<components><component id='0'><transform><rotation>1 0 0 0 1 0 0 0 1</rotation>"
    "<translation>4e5 5e6 100</translation><scale>1.5</scale></transform></component></components>",
    cameras=agisoft.posed("a.jpg", more=' component_id="0"')
    + f"<group>{agisoft.posed('b.jpg').replace(_OF_FIRST, _OF_SECOND)}</group>",
).replace('width="640" height="480"', 'width="64" height="48"')
_BUNDLER: Final = (
    "# Bundle file v0.3\n2 0\n60.5 -0.1 0.01\n1 0 0\n0 1 0\n0 0 1\n0.5 1.5 2.5\n" + 5 * "0 0 0\n"
)
_REALITYCAPTURE: Final = (
    "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
    "a.jpg,1.5,2.5,3.5,90,85,0.5,34.0,0.001,-0.002,-0.05,0.01,0,0,0,0\n"
    "b.jpg,2.5,2.5,3.5,-90,85,0.5,34.0,0.001,-0.002,-0.05,0.01,0,0,0,0\n"
)


def _given() -> Cameras:
    lens = Intrinsics(width=_WIDTH, height=_HEIGHT, fx=60.5, fy=61.0, cx=31.5, cy=24.0)
    first = Camera(
        photo=_PHOTOS[0],
        status="ok",
        intrinsics=lens,
        rotation_camera_from_world=np.eye(3),
        translation_camera_from_world=np.array([1.0, 2.0, 3.0]),
        sigma_wall_m=0.002,
    )
    return Cameras(cameras=(first, Camera(photo=_PHOTOS[1], status="no wall is recognised in it")))


def _camera_files(folder: Path) -> None:
    publish_cameras(_given(), folder, "sha256:0")
    write_colmap_model(folder, _given())
    pycolmap.Reconstruction(str(folder)).write_binary(str(folder))
    for suffix in ("txt", "bin"):
        (folder / f"points3D.{suffix}").unlink()
    (folder / "metashape.xml").write_text(_METASHAPE)
    (folder / "bundle.out").write_text(_BUNDLER)
    (folder / "list.txt").write_text("walls/a.jpg 0 60.5\nwalls/b.jpg\n")
    (folder / "list.csv").write_text(_REALITYCAPTURE)


# What must lie beside a file for it to be read.
_TOGETHER: Final = (
    ("cameras.txt", "images.txt", "rigs.txt", "frames.txt"),
    ("cameras.bin", "images.bin", "rigs.bin", "frames.bin"),
    ("bundle.out", "list.txt"),
)


def _read_cameras(path: Path) -> object:
    paths = [path]
    for name in next((names for names in _TOGETHER if path.name in names), ()):
        if name != path.name:
            paths.append(path.with_name(name))
            paths[-1].write_bytes(_sound()[name])
    return _read(ReadCameras, paths, photos=_photos())


@cache
def _sound() -> Mapping[str, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        _camera_files(Path(folder))
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def _mutate_cameras(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    if b"\0" in content:
        return mutate_bytes(content, rng, others)
    is_json = content.startswith(b"{") and rng.random() < 0.7
    return (mutate_json if is_json else mutate_text)(content, rng, others)


CAMERAS = Target(seeds=_camera_files, read=_read_cameras, mutate=_mutate_cameras)


# Ties ---------------------------------------------------------------------------------------------

_TIES: Final = """\
# photo, then pixels as OpenCV counts them
photo,u_px,v_px,x,y,z,sigma_px
a.jpg,10.5,20.5,1.0,2.0,3.0,0.5
b.jpg,0,47.5,-1e2,2.5,0.001,
"a.jpg",63.5,0,0,0,0,2
"""


TIES = Target(
    seeds=lambda folder: (folder / "ties.csv").write_text(_TIES),
    read=lambda path: _read(ReadTies, [path], photos=_photos()),
    mutate=mutate_text,
)


# Photos in E57 files ------------------------------------------------------------------------------

_NUMBERS: Final = {
    "imageWidth": _WIDTH,
    "imageHeight": _HEIGHT,
    "focalLength": 0.03,
    "pixelWidth": 5e-4,
    "pixelHeight": 6e-4,
    "principalPointX": 33.5,
    "principalPointY": 22.25,
}


def _e57_files(folder: Path) -> None:
    picture = photo_files.picture(_WIDTH, _HEIGHT)
    points = np.random.default_rng(1).uniform(0.0, 1.0, (5, 3))
    fields = scan_files.cartesian(points)
    pose = {"rotation": (0.8, 0.0, 0.0, 0.6), "translation": (1.0, 2.0, 3.0)}
    sphere = {
        "imageWidth": 64,
        "imageHeight": 32,
        "pixelWidth": 2.0 * np.pi / 64,
        "pixelHeight": np.pi / 32,
    }
    jpeg, png, other = (
        encode_jpeg(picture),
        encode_png(photo_files.picture(64, 32)),
        encode_png(picture),
    )
    images = [
        {"kind": "pinhole", "name": "north", "content": jpeg, "numbers": _NUMBERS, **pose},
        {"kind": "spherical", "content": png, "numbers": sphere, **pose},
        {"kind": "visualReference", "content": other},
    ]
    scan_files.write_e57(folder / "room.e57", [{"fields": fields}], images)


def _read_e57_photos(path: Path) -> object:
    """Count them, read them as photos, and their cameras."""
    count_e57_images(path)
    files = InputFiles(name="photos", paths=(path,))
    scratch = path.parent / "scratch"
    trial = Trial(method=ReadPhotos, inputs={"files": files})
    photos = run_trial(trial, scratch, draws=False).outputs["photos"]
    trial = Trial(method=ReadCameras, inputs={"files": files, "photos": photos})
    return digest_of(photos), run_trial(trial, scratch, draws=False).digests


E57_PHOTOS = Target(seeds=_e57_files, read=_read_e57_photos, mutate=mutate_e57)


# Masks --------------------------------------------------------------------------------------------


def _mask_files(folder: Path) -> None:
    ring = [[4.5, 4], [30, 4], [30, 20.25], [4.5, 20.25], [4.5, 4]]
    hole = [[10, 8], [12, 8], [12, 10], [10, 8]]
    shapes = [
        {"type": "Polygon", "coordinates": [ring, hole]},
        {"type": "MultiPolygon", "coordinates": [[ring], [hole]]},
    ]
    features = [
        {"type": "Feature", "properties": {"photo": name, "note": 1}, "geometry": shape}
        for name, shape in zip(("a.jpg", "*.jp?"), shapes, strict=True)
    ]
    content = {"type": "FeatureCollection", "features": features}
    (folder / "masks.geojson").write_text(json.dumps(content))
    used = np.full((_HEIGHT, _WIDTH), 255, np.uint8)
    used[:10] = 0
    (folder / "a_mask.png").write_bytes(encode_png(used))


def _read_mask(path: Path) -> object:
    """Read photos with it; `drawn_seams` of `mosaic` read polygons in the same way."""
    folder = path.parent / "photos"
    folder.mkdir()
    photo = photo_files.jpeg(photo_files.picture(_WIDTH, _HEIGHT))
    photo_files.write(folder, dict.fromkeys(_PHOTOS, photo))
    photos = InputFiles(name="photos", paths=tuple(folder / name for name in _PHOTOS))
    masks = InputFiles(name="masks", paths=(path,))
    trial = Trial(method=ReadPhotos, inputs={"files": photos, "masks": masks})
    return run_trial(trial, path.parent / "scratch", draws=False).digests


def _mutate_mask(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    return (mutate_json if content.startswith(b"{") else mutate_png)(content, rng, others)


MASKS = Target(seeds=_mask_files, read=_read_mask, mutate=_mutate_mask)


# Folders that a workflow is drafted for -----------------------------------------------------------


def _folder_files(folder: Path) -> None:
    _camera_files(folder)
    for name in ("images.txt", "images.bin", "bundle.out", "list.txt"):
        (folder / name).unlink()
    (folder / "ties.csv").write_text(_TIES)
    (folder / "points.csv").write_text("name,x,y,z\np1,1.0,2.0,3.0\n")
    (folder / "calibration.yaml").write_text(
        'cameras: {"*": {width: 64, height: 48, fx: 60, fy: 60, cx: 31.5, cy: 23.5}}\n'
    )
    (folder / "scan.xyz").write_text("1.5 2.5 3.5 0.5\n4.5 5.5 6.5 0.25\n")
    photo_files.write(folder, {"a.jpg": photo_files.jpeg(photo_files.picture())})


def _draft(path: Path) -> object:
    """Draft for the file, with a scan and a name from nowhere beside it."""
    path.with_name("room.xyz").write_text("1.5 2.5 3.5 0.5\n4.5 5.5 6.5 0.25\n")
    return draft_workflow(recognised([path.parent]), path.with_name("workflow.yaml"), None).text


FOLDER = Target(seeds=_folder_files, read=_draft, mutate=_mutate_cameras)

NAMES: Final = ("CAMERAS", "TIES", "E57_PHOTOS", "MASKS", "FOLDER")
