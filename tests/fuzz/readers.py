"""Readers of everything that comes from outside, as targets of the fuzzing, with their seeds."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.read.checkpoints import ReadCheckpoints
from orthoflow_plugins.read.orthoimage import ReadOrthoimage
from orthoflow_plugins.read.photos import ReadPhotos
from orthoflow_plugins.read.scan import ReadScan

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
from orthoflow.files.drawings.sheet_contents import read_title_block
from orthoflow.files.geotiff import GridPlace, write_orthoimage
from orthoflow.files.images import encode_webp, shrunk_webp
from orthoflow.files.photo_files import damage, focal_length, icc_profile, read_exif
from orthoflow.files.sidecars import frame_json, write_json
from orthoflow.geometry import WallFrame
from orthoflow.products import CheckPoints, InputFiles
from orthoflow.sdk import Method
from orthoflow.testing.trials import Trial, run_trial
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.expand import expand_cells
from orthoflow.workflow.source import shipped_workflows
from orthoflow.workflow.views import resolved_json, workflow_from_resolved
from tests import photo_files, samples, scan_files
from tests.fuzz.harness import Target
from tests.fuzz.mutation import (
    mutate_e57,
    mutate_json,
    mutate_png,
    mutate_text,
    mutate_yaml,
)
from tests.report_runs import environment
from tests.scan_cases import CASES, Draw

_N: Final = 40


def _read_with(method: type[Method], files: InputFiles, **more: InputFiles) -> object:
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


def _points() -> NDArray[np.float64]:
    return np.random.default_rng(1).uniform(-5.0, 5.0, (_N, 3)).round(4)


def _rgb() -> NDArray[np.int64]:
    return np.random.default_rng(2).integers(0, 256, (_N, 3))


def _intensity() -> NDArray[np.int64]:
    return np.random.default_rng(3).integers(0, 65536, _N)


def _e57_files(folder: Path) -> None:
    red, green, blue = _rgb().T
    colours = {"colorRed": red, "colorGreen": green, "colorBlue": blue}
    grid = {"rowIndex": np.arange(_N) % 8, "columnIndex": np.arange(_N) // 8}
    whole = {
        "fields": scan_files.cartesian(_points(), intensity=_intensity(), **colours, **grid),
        "rotation": (0.8, 0.0, 0.0, 0.6),
        "translation": (1.0, 2.0, 3.0),
        "intensity_limits": (0.0, 65535.0),
        "rgb_limit": 255,
    }
    spherical = {
        "sphericalRange": np.linspace(1.0, 9.0, _N),
        "sphericalAzimuth": np.linspace(-3.0, 3.0, _N),
        "sphericalElevation": np.linspace(-1.0, 1.0, _N),
        "sphericalInvalidState": np.arange(_N) % 2,
    }
    scan_files.write_e57(folder / "two.e57", [whole, {"fields": scan_files.cartesian(_points())}])
    scan_files.write_e57(folder / "spherical.e57", [{"fields": spherical}])


def _las_files(folder: Path) -> None:
    for name in ("plain.las", "packed.laz"):
        scan_files.write_las(folder / name, _points(), intensity=_intensity(), rgb=_rgb())
    scan_files.write_las(folder / "bare.las", _points(), withheld=np.arange(_N) % 5 == 0)


def _copc_files(folder: Path) -> None:
    rng = np.random.default_rng(2)
    levels = [
        {(0, 0, 0): rng.uniform(0.1, 7.9, (_N, 3))},
        {(0, 0, 0): rng.uniform(0.1, 3.9, (_N, 3)), (1, 0, 1): rng.uniform(4.1, 7.9, (_N, 3))},
    ]
    scan_files.write_copc(folder / "two.laz", levels)
    (folder / "two.las").unlink()


def _cases(*names: str) -> Callable[[Path], None]:
    """Writes small files of `scan_cases`, four of each, as the seeds draw them."""

    def write(folder: Path) -> None:
        for name, seed in product(names, range(4)):
            with tempfile.TemporaryDirectory() as made:
                case = CASES[name](Draw(seed, Path(made), n_points=_N))
                for k, path in enumerate(case.paths):
                    shutil.copy(path, folder / f"{name}_{seed}_{k}{path.suffix}")

    return write


_TEXTS: Final = ("csv_named", "text_units", "text_not_a_number", "text_normals", "pts_two_scanners")
E57 = Target(seeds=_e57_files, read=_read_scan, mutate=mutate_e57)
LAS = Target(seeds=_las_files, read=_read_scan)
COPC = Target(seeds=_copc_files, read=_read_part)
PLY = Target(
    seeds=_cases("ply_lists", "comment_units", "points_at_one_place"),
    read=_read_scan,
    mutate=mutate_text,
)
PCD = Target(seeds=_cases("pcd_names"), read=_read_scan, mutate=mutate_text)
PTX = Target(seeds=_cases("ptx_scans"), read=_read_scan, mutate=mutate_text)
TEXT = Target(seeds=_cases(*_TEXTS), read=_read_scan, mutate=mutate_text)


# Photos, and other pictures -----------------------------------------------------------------------


def _exif() -> bytes:
    main = {photo_files.MAKE: "Maker", photo_files.MODEL: "Model", photo_files.ORIENTATION: 6}
    inner = {
        photo_files.FOCAL: (240, 10),
        photo_files.FOCAL_35MM: 36,
        photo_files.WIDTH: 64,
        photo_files.HEIGHT: 48,
        photo_files.RESOLUTION_X: (4000, 10),
        photo_files.RESOLUTION_UNIT: 3,
    }
    return photo_files.exif_block({**main}, {**inner})


def _photo_files(folder: Path, *kinds: str) -> None:
    image, exif = photo_files.picture(), _exif()
    made = {
        "jpg": photo_files.jpeg(image, exif),
        "png": photo_files.png(image, exif),
        "tif": photo_files.tiff(image, orientation=6),
    }
    photo_files.write(folder, {f"a.{kind}": made[kind] for kind in kinds})


def _read_photo(path: Path) -> object:
    return _read_with(ReadPhotos, _files(path))


def _read_exif(path: Path) -> object:
    encoded = path.read_bytes()
    exif = read_exif(encoded)
    return exif.camera, focal_length(exif, 64, 48), icc_profile(encoded), damage(encoded)


def _figure_files(folder: Path) -> None:
    (folder / "a.webp").write_bytes(encode_webp(photo_files.picture()))
    transparent = np.dstack([photo_files.picture(), photo_files.picture()[..., 0]])
    (folder / "b.webp").write_bytes(encode_webp(transparent))


def _read_figure(path: Path) -> object:
    return shrunk_webp(path.read_bytes(), path.name, longest_side_px=32)


JPEG = Target(seeds=lambda folder: _photo_files(folder, "jpg"), read=_read_photo)
PNG = Target(seeds=lambda folder: _photo_files(folder, "png"), read=_read_photo, mutate=mutate_png)
TIFF = Target(seeds=lambda folder: _photo_files(folder, "tif"), read=_read_photo)
EXIF = Target(seeds=lambda folder: _photo_files(folder, "jpg", "png", "tif"), read=_read_exif)
FIGURE = Target(seeds=_figure_files, read=_read_figure)


# Orthoimages of other programs --------------------------------------------------------------------


def _frame() -> WallFrame:
    return samples.facing_south(0.01, 64, 48, (1.0, 2.0, 3.0))


def _write_image(path: Path) -> None:
    shown = np.ones((48, 64), dtype=np.bool_)
    write_orthoimage(
        path, photo_files.picture(), shown, place=GridPlace(gsd_m=0.01), tags={"name": "wall"}
    )


@cache
def _image() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "wall.tif"
        _write_image(path)
        return path.read_bytes()


def _read_sidecar(path: Path) -> object:
    image = path.with_suffix(".tif")
    image.write_bytes(_image())
    return _read_with(ReadOrthoimage, _files(image, path))


def _read_geotiff(path: Path) -> object:
    sidecar = path.with_suffix(".json")
    write_json(sidecar, {"wall": 3, **frame_json(_frame())})
    return _read_with(ReadOrthoimage, _files(path, sidecar))


SIDECAR = Target(
    seeds=lambda folder: write_json(folder / "wall.json", {"wall": 3, **frame_json(_frame())}),
    read=_read_sidecar,
    mutate=mutate_json,
)
GEOTIFF = Target(seeds=lambda folder: _write_image(folder / "wall.tif"), read=_read_geotiff)


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


def _checkpoint_files(folder: Path) -> None:
    (folder / "points.csv").write_text(_CHECKPOINTS)
    (folder / "lines.txt").write_text(_POINT_LINES)


_TITLE_BLOCK: Final = """\
project: Palace, western hall
drawing: 21-017
date: 2026-03-14
note: |
  Cells of 2 mm, not retouched.
"""


def _read_calibration(path: Path) -> object:
    photo = path.with_name("b.jpg")
    photo.write_bytes(photo_files.jpeg(photo_files.picture(), _exif()))
    return _read_with(ReadPhotos, _files(photo), calibration=_files(path))


def _read_checkpoints(path: Path) -> object:
    return _read_with(ReadCheckpoints, _files(path))


def _workflow_files(folder: Path) -> None:
    for name in ("photos-on-scan", "plane-methods", "plane-benchmark"):
        (folder / f"{name}.yaml").write_bytes(shipped_workflows()[name].read_bytes())


@cache
def _catalog() -> Catalog:
    return discover_catalog()


def _read_workflow(path: Path) -> object:
    workflow = load_workflow(path, _catalog())
    return len(expand_cells(workflow, _catalog()))


def _read_rooms(path: Path) -> object:
    workflow = load_workflow("photos-on-scan", _catalog(), datasets=str(path))
    return len(expand_cells(workflow, _catalog())), resolved_json(workflow)


def _resolved_files(folder: Path) -> None:
    for name in ("photos-on-scan", "plane-methods", "plane-benchmark"):
        workflow = load_workflow(shipped_workflows()[name], _catalog())
        (folder / f"{name}.json").write_text(resolved_json(workflow))


def _read_resolved(path: Path) -> object:
    workflow = workflow_from_resolved(path.read_text(encoding="utf-8", errors="replace"), "")
    return len(expand_cells(workflow, _catalog()))


CALIBRATION = Target(
    seeds=lambda folder: (folder / "calibration.yaml").write_text(_CALIBRATION),
    read=_read_calibration,
    mutate=mutate_yaml,
)
CHECKPOINTS = Target(seeds=_checkpoint_files, read=_read_checkpoints, mutate=mutate_text)
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
    return CellResult(
        status="ok",
        method="make.range",
        key=_KEY,
        key_preimage='{"method": "make.range"}',
        seed=2**70,
        metrics=(Metric(name="n", value=4.0, unit="1"),),
        warnings=("a warning",),
        environment=environment(),
        outputs={
            "numbers": ProductRef(type_name="checkpoints", encoding_version=1, digest=_DIGEST)
        },
        figures=(FigureRef(name="f", caption="c", media_type="image/png", sha256="ef" * 32),),
    )


def _read_result(path: Path) -> object:
    store = Store(path.parent / "store")
    with store.in_use():
        (store.results / f"{_KEY}.json").write_bytes(path.read_bytes())
        (store.folder / "digests.json").write_bytes(path.read_bytes())
        store.file_digests().digest(path)
        return store.result(_KEY), list_results(store), store.earlier_results("make.range")


def _read_object(path: Path) -> object:
    """Read the notes beside a product, then put the product again."""
    store = Store(path.parent / "store")
    product = _product()
    with store.in_use():
        ref = store.put_product(product)
        folder = store.objects / ref.digest.removeprefix("sha256:")
        (folder / "object.json").write_bytes(path.read_bytes())
        return store.product_file(ref.digest), store.put_product(product)


def _product() -> CheckPoints:
    return CheckPoints(
        names=("a", "b"),
        points_world=np.arange(6.0).reshape(2, 3),
        classes=("", "nail"),
        wall=np.array([-1, 2], dtype=np.int32),
        pixels_wall=np.array([[np.nan, np.nan], [1.5, 2.5]]),
    )


def _product_files(folder: Path) -> None:
    store = Store(folder / "store")
    with store.in_use():
        ref = store.put_product(_product())
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


RESULT = Target(
    seeds=lambda folder: (folder / "result.json").write_text(result_to_json(_result())),
    read=_read_result,
    mutate=mutate_json,
)
OBJECT = Target(
    seeds=lambda folder: (folder / "object.json").write_text(
        '{"type": "checkpoints", "size_bytes": 5000, "publisher": ""}'
    ),
    read=_read_object,
    mutate=mutate_json,
)
PRODUCT = Target(seeds=_product_files, read=_read_product)
JOURNAL_FILE = Target(seeds=_journal_files, read=_read_journal, mutate=mutate_text)

NAMES: Final = tuple(name for name, value in globals().items() if isinstance(value, Target))
