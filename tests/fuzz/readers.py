"""Readers of everything that comes from outside, as targets of the fuzzing, with their seeds."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from itertools import product
from pathlib import Path
from random import Random
from typing import Final

import numpy as np
import pycolmap
from orthoflow_plugins.read.cameras import ReadCameras
from orthoflow_plugins.read.checkpoints import ReadCheckpoints
from orthoflow_plugins.read.orthoimage import ReadOrthoimage
from orthoflow_plugins.read.photos import ReadPhotos
from orthoflow_plugins.read.scan import ReadScan
from orthoflow_plugins.read.ties import ReadTies

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.engine.journal import JOURNAL, Journal
from orthoflow.engine.results import (
    CellResult,
    FigureRef,
    Metric,
    ProductRef,
    result_to_json,
)
from orthoflow.engine.store import Store, list_results
from orthoflow.files.colmap import write_colmap_model
from orthoflow.files.drawings.sheet_contents import read_title_block
from orthoflow.files.e57_images import count_e57_images
from orthoflow.files.geotiff import GridPlace, write_orthoimage
from orthoflow.files.images import encode_png, encode_webp, shrunk_webp
from orthoflow.files.photo_files import damage, focal_length, icc_profile, read_exif
from orthoflow.files.publishing import publish_cameras
from orthoflow.files.sidecars import frame_json, write_json
from orthoflow.geometry import WallFrame
from orthoflow.products import (
    Camera,
    Cameras,
    CheckPoints,
    InputFiles,
    Photo,
    Photos,
    Product,
)
from orthoflow.sdk import Method
from orthoflow.testing.examples import example
from orthoflow.testing.trials import Trial, run_trial
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.draft import draft_workflow, recognised
from orthoflow.workflow.expand import expand_cells
from orthoflow.workflow.source import shipped_workflows
from orthoflow.workflow.views import resolved_json, workflow_from_resolved
from tests import photo_files, samples, scan_files
from tests.files import test_metashape as agisoft
from tests.files.test_e57_images import pinhole, spherical, written
from tests.files.test_given_cameras import HEAD as REALITYCAPTURE
from tests.files.test_given_cameras import oriented
from tests.files.test_photo_files import INNER, MAIN
from tests.files.test_vector_files import HOLE, SQUARE, feature, features
from tests.fuzz.harness import Target
from tests.fuzz.mutation import (
    mutate_bytes,
    mutate_e57,
    mutate_json,
    mutate_png,
    mutate_text,
    mutate_yaml,
)
from tests.report_runs import environment
from tests.scan_cases import CASES, Draw

N_POINTS: Final = 40
EXIF: Final = photo_files.exif_block(MAIN, INNER)


def _read_with(method: type[Method], files: InputFiles, **more: Product | InputFiles) -> object:
    trial = Trial(method=method, inputs={"files": files, **more})
    return run_trial(trial, files.paths[0].parent / "scratch", draws=False).digests


def _files(*paths: Path) -> InputFiles:
    return InputFiles(name="files", paths=paths)


# Scans --------------------------------------------------------------------------------------------


def _read_scan(path: Path) -> object:
    return _read_with(ReadScan, _files(path))


def _read_part(path: Path) -> object:
    """Read what a box and a spacing ask for, which the octree of a COPC file says."""
    params = {"box": [[0.5, 0.5, 0.5], [7.0, 3.0, 7.0]], "gsd_m": 0.2}
    trial = Trial(method=ReadScan, inputs={"files": _files(path)}, params=params)
    return run_trial(trial, path.parent / "scratch", draws=False).digests


def _spherical_files(folder: Path) -> None:
    fields = {
        "sphericalRange": np.linspace(1.0, 9.0, N_POINTS),
        "sphericalAzimuth": np.linspace(-3.0, 3.0, N_POINTS),
        "sphericalElevation": np.linspace(-1.0, 1.0, N_POINTS),
        "sphericalInvalidState": np.arange(N_POINTS) % 2,
        "rowIndex": np.arange(N_POINTS) % 8,
        "columnIndex": np.arange(N_POINTS) // 8,
    }
    pose = {"rotation": (0.8, 0.0, 0.0, 0.6), "translation": (1.0, 2.0, 3.0)}
    scan_files.write_e57(folder / "spherical.e57", [{"fields": fields, **pose}])


def _las_files(folder: Path) -> None:
    points = np.random.default_rng(1).uniform(-5.0, 5.0, (N_POINTS, 3))
    scan_files.write_las(folder / "a.las", points, withheld=np.arange(N_POINTS) % 5 == 0)


def _copc_files(folder: Path) -> None:
    rng = np.random.default_rng(2)
    levels = [
        {(0, 0, 0): rng.uniform(0.1, 7.9, (N_POINTS, 3))},
        {(0, 0, 0): rng.uniform(0.1, 3.9, (9, 3)), (1, 0, 1): rng.uniform(4.1, 7.9, (9, 3))},
    ]
    scan_files.write_copc(folder / "two.laz", levels)


def _cases(*names: str, more: Callable[[Path], None] | None = None) -> Callable[[Path], None]:
    """Writes small files of `scan_cases`, three of each, as the seeds draw them."""

    def write(folder: Path) -> None:
        for name, seed in product(names, range(3)):
            with tempfile.TemporaryDirectory() as made:
                case = CASES[name](Draw(seed, Path(made), n_points=N_POINTS))
                for k, path in enumerate(case.paths):
                    shutil.copy(path, folder / f"{name}_{seed}_{k}{path.suffix}")
        if more is not None:
            more(folder)

    return write


E57 = Target(
    seeds=_cases("e57_colour_invalid", "e57_two_scales", more=_spherical_files),
    read=_read_scan,
    mutate=mutate_e57,
)
LAS = Target(seeds=_cases("las_feet", "las_extra_intensity", more=_las_files), read=_read_scan)
COPC = Target(seeds=_copc_files, read=_read_part)
PLY = Target(
    seeds=_cases("ply_lists", "comment_units", "points_at_one_place"),
    read=_read_scan,
    mutate=mutate_text,
)
PCD = Target(seeds=_cases("pcd_names"), read=_read_scan, mutate=mutate_text)
PTX = Target(seeds=_cases("ptx_scans"), read=_read_scan, mutate=mutate_text)
TEXT = Target(
    seeds=_cases(
        "csv_named", "text_units", "text_not_a_number", "text_normals", "pts_two_scanners"
    ),
    read=_read_scan,
    mutate=mutate_text,
)
SCANS: Final = (E57, LAS, COPC, PLY, PCD, PTX, TEXT)


# Photos, and other pictures -----------------------------------------------------------------------


def _photo_files(kind: str, folder: Path) -> None:
    image, exif = photo_files.picture(), EXIF
    made = {
        "jpg": photo_files.jpeg(image, exif),
        "png": photo_files.png(image, exif),
        "tif": photo_files.tiff(image, orientation=6),
    }
    (folder / f"a.{kind}").write_bytes(made[kind])


def _read_photo(path: Path) -> object:
    encoded = path.read_bytes()
    exif = read_exif(encoded)
    values = exif.camera, focal_length(exif, 64, 48), icc_profile(encoded), damage(encoded)
    return values, _read_with(ReadPhotos, _files(path))


def _figure_files(folder: Path) -> None:
    (folder / "a.webp").write_bytes(encode_webp(photo_files.picture()))
    transparent = np.dstack([photo_files.picture(), photo_files.picture()[..., 0]])
    (folder / "b.webp").write_bytes(encode_webp(transparent))


def _read_figure(path: Path) -> object:
    return shrunk_webp(path.read_bytes(), path.name, longest_side_px=32)


JPEG = Target(seeds=partial(_photo_files, "jpg"), read=_read_photo)
PNG = Target(seeds=partial(_photo_files, "png"), read=_read_photo, mutate=mutate_png)
TIFF = Target(seeds=partial(_photo_files, "tif"), read=_read_photo)
FIGURE = Target(seeds=_figure_files, read=_read_figure)


# Orthoimages of other programs --------------------------------------------------------------------


def wall_frame() -> WallFrame:
    return samples.facing_south(0.01, 64, 48, (1.0, 2.0, 3.0))


def _write_image(path: Path) -> None:
    shown = np.ones((48, 64), dtype=np.bool_)
    write_orthoimage(
        path, photo_files.picture(), shown, place=GridPlace(gsd_m=0.01), tags={"name": "wall"}
    )


def _write_sidecar(path: Path) -> None:
    write_json(path, {"wall": 3, **frame_json(wall_frame())})


def _read_ortho(path: Path) -> object:
    """Read a raster with its sidecar, one of them damaged."""
    image, sidecar = path.with_suffix(".tif"), path.with_suffix(".json")
    if path == image:
        _write_sidecar(sidecar)
    else:
        _write_image(image)
    return _read_with(ReadOrthoimage, _files(image, sidecar))


SIDECAR = Target(
    seeds=lambda folder: _write_sidecar(folder / "wall.json"), read=_read_ortho, mutate=mutate_json
)
GEOTIFF = Target(seeds=lambda folder: _write_image(folder / "wall.tif"), read=_read_ortho)


PHOTOS: Final = Photos(
    photos=tuple(
        Photo(name=name, width=640, height=480, encoded=b"") for name in ("a.jpg", "b.jpg")
    )
)

# Cameras ------------------------------------------------------------------------------------------

_OF_FIRST, _OF_SECOND = 'sensor_id="0"', 'sensor_id="1"'
_METASHAPE: Final = agisoft.document(
    sensors=agisoft.sensor_of(agisoft.TERMS)
    + '<sensor id="1" label="360" type="spherical"><resolution width="256" height="128"/></sensor>',
    chunk="<components><component id='0'><transform><rotation>1 0 0 0 1 0 0 0 1</rotation>"
    "<translation>4e5 5e6 100</translation><scale>1.5</scale></transform></component></components>",
    cameras=agisoft.posed("a.jpg", more=' component_id="0"')
    + f"<group>{agisoft.posed('b.jpg').replace(_OF_FIRST, _OF_SECOND)}</group>",
)


def _camera_files(folder: Path) -> None:
    lost = Camera(photo="b.jpg", status="no wall is recognised in it")
    given = Cameras(cameras=(oriented("a.jpg", 5), lost))
    publish_cameras(given, folder, "sha256:0")
    write_colmap_model(folder, given)
    pycolmap.Reconstruction(str(folder)).write_binary(str(folder))
    for suffix in ("txt", "bin"):
        (folder / f"points3D.{suffix}").unlink()
    (folder / "metashape.xml").write_text(_METASHAPE)
    pose = "60 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n"
    (folder / "bundle.out").write_text(f"# Bundle file v0.3\n2 0\n{2 * pose}")
    (folder / "list.txt").write_text("walls/a.jpg 0 60.5\nwalls/b.jpg\n")
    row = "a.jpg,1.5,2.5,3.5,90,85,0.5,34.0,0.001,-0.002,-0.05,0.01,0,0,0,0\n"
    (folder / "list.csv").write_text(REALITYCAPTURE + row)


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
    return _read_with(ReadCameras, _files(*paths), photos=PHOTOS)


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


# Photos in E57 files ------------------------------------------------------------------------------


def _e57_photo_files(folder: Path) -> None:
    reference = {"kind": "visualReference", "content": encode_png(photo_files.picture())}
    written(folder, pinhole(name="north"), spherical(64, 32), reference)


def _read_e57_photos(path: Path) -> object:
    """Count them, read them as photos, and their cameras."""
    count_e57_images(path)
    trial = Trial(method=ReadPhotos, inputs={"files": _files(path)})
    photos = run_trial(trial, path.parent / "scratch", draws=False).outputs["photos"]
    return _read_with(ReadCameras, _files(path), photos=photos)


E57_PHOTOS = Target(seeds=_e57_photo_files, read=_read_e57_photos, mutate=mutate_e57)


# Masks --------------------------------------------------------------------------------------------


def _mask_files(folder: Path) -> None:
    several = feature([[SQUARE], [HOLE]], kind="MultiPolygon", photo="*.jp?")
    (folder / "masks.geojson").write_text(features(feature([SQUARE, HOLE], note=1), several))
    used = np.full((48, 64), 255, np.uint8)
    used[:10] = 0
    (folder / "a_mask.png").write_bytes(encode_png(used))


def _read_mask(path: Path) -> object:
    """Read photos with it; `drawn_seams` of `mosaic` read polygons in the same way."""
    photo = photo_files.jpeg(photo_files.picture())
    photos = photo_files.write(path.parent / "photos", {"a.jpg": photo, "b.jpg": photo})
    return _read_with(ReadPhotos, _files(*photos), masks=_files(path))


def _mutate_mask(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    return (mutate_json if content.startswith(b"{") else mutate_png)(content, rng, others)


MASKS = Target(seeds=_mask_files, read=_read_mask, mutate=_mutate_mask)


# Folders that a workflow is drafted for -----------------------------------------------------------


def _folder_files(folder: Path) -> None:
    _camera_files(folder)
    for name in ("images.txt", "images.bin", "bundle.out", "list.txt"):
        (folder / name).unlink()
    _point_files(folder)
    (folder / "calibration.yaml").write_text(_CALIBRATION)
    (folder / "scan.xyz").write_text("1.5 2.5 3.5 0.5\n4.5 5.5 6.5 0.25\n")
    _photo_files("jpg", folder)


def _draft(path: Path) -> object:
    """Draft for the file, with a scan and a name from nowhere beside it."""
    path.with_name("room.xyz").write_text("1.5 2.5 3.5 0.5\n4.5 5.5 6.5 0.25\n")
    return draft_workflow(recognised([path.parent]), path.with_name("workflow.yaml"), None).text


FOLDER = Target(seeds=_folder_files, read=_draft, mutate=_mutate_cameras)


# Calibration, check points, workflows -------------------------------------------------------------

_CALIBRATION: Final = """\
cameras:
  "IMG_00*.jpg": &wide {width: 64, height: 48, fx: 60.5, fy: 61.2, cx: 31.1, cy: 23.7,
                        distortion: [-0.08, 0.05, 0.0002, -0.0001, 0.0]}
  "b.jpg": *wide
  "fish*": {model: fisheye, width: 64, height: 48, fx: 20, fy: 20.5, cx: 31.5, cy: 23.5,
            distortion: [0.01, -0.02, 0.003, 0.0], field_of_view_deg: 170}
  "*": {width: 64, height: 48, fx: 60, fy: 60, cx: 31.5, cy: 23.5}
"""
_CHECKPOINTS: Final = """\
# made by hand
name,x,y,z,class,wall,u_px,v_px
p1,1.0,2.0,3.0,target,0,10.5,20.5
p2,-1e2,2.5,0.001,,,,
"p, 3",0,0,0,nail,3,1,2
"""
_ROOMS: Final = """\
# palace
name;scan;photos;wall.gsd_m;wall.buffer_m;plane.cell_m;wall.near
hall;hall.e57;photos/*.jpg;0.003;;0.02;[[1, 2, 3]]
"stairs";"stairs 2.e57";b.jpg;5e-3;0.01;;
attic;a.laz;photos;;;;
"""
_POINT_LINES: Final = "A;1.5;2.5;3.5\nB;-1.5;2.5;3.25\n"


_TIES: Final = """\
# photo, then pixels as OpenCV counts them
photo,u_px,v_px,x,y,z,sigma_px
a.jpg,10.5,20.5,1.0,2.0,3.0,0.5
b.jpg,0,47.5,-1e2,2.5,0.001,
"a.jpg",63.5,0,0,0,0,2
"""


def _point_files(folder: Path) -> None:
    (folder / "points.csv").write_text(_CHECKPOINTS)
    (folder / "lines.txt").write_text(_POINT_LINES)
    (folder / "ties.csv").write_text(_TIES)


_TITLE_BLOCK: Final = """\
project: Palace, western hall
drawing: 21-017
date: 2026-03-14
note: |
  Cells of 2 mm, not retouched.
"""


def _read_calibration(path: Path) -> object:
    photo = path.with_name("b.jpg")
    photo.write_bytes(photo_files.jpeg(photo_files.picture(), EXIF))
    return _read_with(ReadPhotos, _files(photo), calibration=_files(path))


def _read_points(path: Path) -> object:
    if path.name == "ties.csv":
        return _read_with(ReadTies, _files(path), photos=PHOTOS)
    return _read_with(ReadCheckpoints, _files(path))


_WORKFLOW: Final = """\
orthoflow: 1
inputs: {scan: {}, photos: {optional: true}}
steps:
  cloud: {use: read.scan, in: {files: inputs.scan}, params: {up: z}}
  shots: {use: read.photos, in: {files: inputs.photos}}
  plane: {use: plane.hough2d, in: {cloud: cloud.cloud}}
  wall: {use: raster.grid, in: {cloud: cloud.cloud, planes: plane.planes}}
"""


def _workflow_files(folder: Path) -> None:
    (folder / "small.yaml").write_text(_WORKFLOW)
    for name in ("plane-methods", "plane-benchmark"):
        (folder / f"{name}.yaml").write_bytes(shipped_workflows()[name].read_bytes())


@cache
def _catalog() -> Catalog:
    return discover_catalog()


def _read_workflow(path: Path) -> object:
    workflow = load_workflow(path, _catalog())
    return len(expand_cells(workflow, _catalog()))


def _read_rooms(path: Path) -> object:
    small = path.with_name("small.yaml")
    small.write_text(_WORKFLOW)
    workflow = load_workflow(small, _catalog(), datasets=str(path))
    return len(expand_cells(workflow, _catalog())), resolved_json(workflow)


def _resolved_files(folder: Path) -> None:
    _workflow_files(folder)
    for path in list(folder.iterdir()):
        path.with_suffix(".json").write_text(resolved_json(load_workflow(path, _catalog())))
        path.unlink()


def _read_resolved(path: Path) -> object:
    workflow = workflow_from_resolved(path.read_text(encoding="utf-8", errors="replace"), "")
    return len(expand_cells(workflow, _catalog()))


CALIBRATION = Target(
    seeds=lambda folder: (folder / "calibration.yaml").write_text(_CALIBRATION),
    read=_read_calibration,
    mutate=mutate_yaml,
)
POINTS = Target(seeds=_point_files, read=_read_points, mutate=mutate_text)
TITLE_BLOCK = Target(
    seeds=lambda folder: (folder / "block.yaml").write_text(_TITLE_BLOCK),
    read=read_title_block,
    mutate=mutate_yaml,
)
ROOMS = Target(
    seeds=lambda folder: (folder / "rooms.csv").write_text(_ROOMS),
    read=_read_rooms,
    mutate=mutate_text,
)
WORKFLOW = Target(seeds=_workflow_files, read=_read_workflow, mutate=mutate_yaml)
RESOLVED = Target(seeds=_resolved_files, read=_read_resolved, mutate=mutate_json)


# The engine's own files ---------------------------------------------------------------------------

_KEY: Final = "ab" * 32
_DIGEST: Final = "sha256:" + "cd" * 32


def _result() -> CellResult:
    digest = f"sha256:{'cd' * 32}"
    return CellResult(
        status="ok",
        method="make.range",
        key=_KEY,
        key_preimage='{"method": "make.range"}',
        seed=2**70,
        metrics=(Metric(name="n", value=4.0, unit="1"),),
        warnings=("a warning",),
        environment=environment(),
        outputs={"numbers": ProductRef(type_name="cloud", encoding_version=1, digest=digest)},
        figures=(FigureRef(name="f", caption="c", media_type="image/png", sha256="ef" * 32),),
    )


def _store_files(folder: Path) -> None:
    (folder / "result.json").write_text(result_to_json(_result()))
    note = '{"type": "checkpoints", "size_bytes": 5000, "publisher": ""}'
    (folder / "object.json").write_text(note)


def _read_stored(path: Path) -> object:
    """Read a result, or the notes beside a product, which is put again."""
    store, content = Store(path.parent / "store"), path.read_bytes()
    with store.in_use():
        if path.name == "object.json":
            ref = store.put_product(example("checkpoints"))
            folder = store.objects / ref.digest.removeprefix("sha256:")
            (folder / path.name).write_bytes(content)
            return store.product_file(ref.digest), store.put_product(example("checkpoints"))
        (store.results / f"{_KEY}.json").write_bytes(content)
        (store.folder / "digests.json").write_bytes(content)
        store.file_digests().digest(path)
        return store.result(_KEY), list_results(store), store.earlier_results("make.range")


def _product_files(folder: Path) -> None:
    store = Store(folder / "store")
    with store.in_use():
        ref = store.put_product(example("checkpoints"))
    path = store.product_file(ref.digest)
    assert path is not None
    path.rename(folder / "product.h5")
    shutil.rmtree(folder / "store")


def _read_product(path: Path) -> object:
    store = Store(path.parent / "store")
    folder = store.objects / ("cd" * 32)
    folder.mkdir(parents=True)
    path.rename(folder / "product.h5")
    product = store.get_product(_DIGEST, CheckPoints, is_checked=True)
    return store.put_product(product)


def _journal_files(folder: Path) -> None:
    with Journal(folder / "run", "toy") as journal:
        journal.write("started", address="a", key=_KEY)
        journal.write("finished", address="a", key=_KEY, status="ok", cached=False, error="")
    (folder / "run" / JOURNAL).rename(folder / JOURNAL)
    (folder / "run").rmdir()


def _read_journal(path: Path) -> object:
    folder = path.parent / "run"
    folder.mkdir()
    path.rename(folder / JOURNAL)
    with Journal(folder, "toy") as journal:
        return journal.finished_keys


STORED = Target(seeds=_store_files, read=_read_stored, mutate=mutate_json)
PRODUCT = Target(seeds=_product_files, read=_read_product)
JOURNAL_FILE = Target(seeds=_journal_files, read=_read_journal, mutate=mutate_text)

PICTURES: Final = (JPEG, PNG, TIFF, FIGURE, SIDECAR, GEOTIFF, E57_PHOTOS, MASKS)
TABLES: Final = (CAMERAS, POINTS, CALIBRATION, TITLE_BLOCK, FOLDER)
WORKFLOWS: Final = (WORKFLOW, ROOMS, RESOLVED, STORED, PRODUCT, JOURNAL_FILE)
