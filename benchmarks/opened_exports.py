"""Open every exported file of a run with other programs, and keep pictures of them.

    python -m benchmarks.opened_exports RUN FOLDER --store STORE --scale 50

RUN is exported in every format, clouds in every colouring, and each file is opened with another
program: pdfplumber and poppler, ezdxf and LibreCAD, laspy, open3d, pye57, trimesh and the Khronos
validator (`npm install gltf-validator` in the folder where this is started), Pillow, QGIS, prov,
pystac, rasterio, pycolmap, roc-validator, Chromium. The output has a line with the findings for
each file, and lists programs that are not installed. The exit code is 1 if a file is rejected or
contradicts the record. Pictures are in FOLDER/pictures.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import ezdxf
import laspy
import numpy as np
import pdfplumber
import prov.model
import pye57
import pystac
import rasterio
import trimesh
from click.testing import CliRunner
from laspy.copc import CopcReader
from orthoflow_plugins.plane.comparators import load_open3d
from PIL import Image
from pystac.validation import RegisteredValidator

from orthoflow.cli.program import program
from tests.browser import IS_HERE, Page, started

MM: Final = 25.4 / 72.0
COLOURS: Final = ("photos", "rgb", "intensity", "plane", "deviation")
VALIDATE: Final = """
const fs = require("fs"), validator = require("gltf-validator");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])))
  .then(said => console.log(JSON.stringify(said.issues)));
"""
VALIDATE_CRATE: Final = Path(__file__).parents[1] / "tests" / "crate_validation.py"
PROFILE: Final = "provenance-run-crate-0.5"
IN_QGIS: Final = """
import json, sys
from qgis.core import QgsApplication, QgsRasterLayer, QgsVectorLayer
app = QgsApplication([], False)
app.initQgis()
for path in sys.argv[1:]:
    if path.endswith(".tif"):
        layer = QgsRasterLayer(path, "raster")
        said = [layer.isValid(), layer.width(), layer.height(), layer.extent().toString(3)]
    else:
        layer, kinds = QgsVectorLayer(path, "vectors", "ogr"), {}
        for sub in layer.dataProvider().subLayers() or [""]:
            part = sub.split("!!::!!")
            source = path if len(part) < 4 else f"{path}|geometrytype={part[3]}"
            for feature in QgsVectorLayer(source, "part", "ogr").getFeatures():
                names = feature.fields().names()
                kind = feature["kind"] if "kind" in names else "photo " + str(feature["photo"])
                kinds[kind] = kinds.get(kind, 0) + 1
        said = [layer.isValid(), kinds]
    print(json.dumps([path, said]))
"""


class Walk:
    """A run, the folder of its exports, and the faults found so far."""

    def __init__(self, chosen: argparse.Namespace) -> None:
        self.run, self.folder, self.store = chosen.run, chosen.folder.resolve(), chosen.store
        self.scale: int = chosen.scale
        self.pictures = self.folder / "pictures"
        self.pictures.mkdir(parents=True, exist_ok=True)
        self.n_wrong = 0
        self.environment = os.environ | {"QT_QPA_PLATFORM": "offscreen"}

    def say(self, file: Path | str, text: str, *, is_right: bool = True) -> None:
        """Print a finding."""
        self.n_wrong += not is_right
        name = file.relative_to(self.folder) if isinstance(file, Path) else file
        print(f"{'      ' if is_right else 'WRONG '}{name}: {text}", flush=True)

    def export(self, target: str, *more: str, name: str = "") -> Path | None:
        """Export as a user would; print a message and return None if the run lacks such content."""
        folder = self.folder / (name or target)
        shutil.rmtree(folder, ignore_errors=True)
        words = ["export", str(self.run), "--to", target, "-o", str(folder), *more]
        done = CliRunner().invoke(program, [*words, "--store", str(self.store)])
        last = done.output.strip().splitlines()[-1].replace(f"{folder}: ", "")
        refused = done.exit_code == 2 and "has nothing for it" in last + done.output
        refused = refused or (done.exit_code == 2 and "has oriented no photos" in done.output)
        self.say(name or target, last, is_right=done.exit_code == 0 or refused)
        return folder if done.exit_code == 0 else None

    def started(self, words: list[str], folder: Path) -> subprocess.CompletedProcess[str] | None:
        """Run a program; print a message and return None if it is not installed."""
        if shutil.which(words[0]) is None:
            self.say(words[0], "not installed")
            return None
        return subprocess.run(
            words,
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            timeout=1800,
            env=self.environment,
        )

    def drawn(self, pdf: Path, name: str) -> None:
        """Return an image of a PDF, drawn by poppler."""
        picture = self.pictures / name
        words = ["pdftoppm", "-scale-to", "1600", "-png", "-singlefile", str(pdf), str(picture)]
        done = self.started(words, self.folder)
        if done is not None:
            said = done.stderr.strip() or f"picture {picture.name}.png"
            self.say(pdf, f"poppler: {said}", is_right=not done.returncode and not done.stderr)

    def frames(self) -> Iterator[tuple[int, float, float]]:
        """Return the number, width and height (metres) of each wall with an orthoimage."""
        for path in sorted((self.run / "products").glob("*/wall_*_ortho.json")):
            content = json.loads(path.read_text())
            yield (
                content["wall"],
                content["gsd_m"] * content["width"],
                content["gsd_m"] * content["height"],
            )


def walk_sheets(walk: Walk) -> None:
    """Check scale and text with pdfplumber, images with poppler."""
    more = ("--scale", str(walk.scale), "--paper", "A1", "--grid", "1", "--beside", "depth")
    folder = walk.export("sheet", *more)
    if folder is None:
        return
    metre_mm = 1e3 / walk.scale
    sizes = {number: (wide, high) for number, wide, high in walk.frames()}
    for path in sorted(folder.glob("*.pdf")):
        with pdfplumber.open(path) as pdf:
            (page,) = pdf.pages
            text = " ".join(page.extract_text().split())
            bar = [box["width"] * MM for box in page.rects if abs(box["height"] * MM - 2) < 1e-3]
            shown = [(p["width"] * MM, p["height"] * MM) for p in page.images]
            paper = f"{page.width * MM:.1f} x {page.height * MM:.1f} mm"
        if "_index" in path.stem:
            walk.say(path, f"pdfplumber: {paper}", is_right=text.count("sheet") > 0)
        else:
            size = sizes[int(path.stem.split("_")[1])]
            wanted = [extent * metre_mm for extent in size]
            is_whole = "sheet 1 of 1" in text
            fits = all(
                abs(got - due) < 0.01
                for pair in shown
                for got, due in zip(pair, wanted, strict=True)
            )
            # Segments of the scale bar are whole metres or a round fraction of a metre.
            parts = [width / metre_mm for width in bar]
            is_round = all(abs(part * 1000 - round(part * 1000)) < 0.5 for part in parts)
            walk.say(
                path,
                f"pdfplumber: {paper}, bar segments of {sorted({round(b, 2) for b in bar})} mm, "
                f"pictures {[tuple(round(v, 2) for v in pair) for pair in shown]} mm",
                is_right=bool(bar)
                and is_round
                and (fits or not is_whole)
                and f"1:{walk.scale}" in text,
            )
        walk.drawn(path, path.stem)


def walk_cad(walk: Walk) -> None:
    """Audit with ezdxf, draw with LibreCAD."""
    folder = walk.export("dxf")
    if folder is None:
        return
    for path in sorted(folder.glob("*.dxf")):
        document = ezdxf.readfile(path)
        audit = document.audit()
        counts: dict[str, int] = {}
        for entity in document.modelspace():
            counts[entity.dxf.layer] = counts.get(entity.dxf.layer, 0) + 1
        n_wrong = len(audit.errors) + len(audit.fixes)
        walk.say(path, f"ezdxf: {n_wrong} errors, {counts}", is_right=n_wrong == 0)
        done = walk.started(["librecad", "dxf2pdf", "-a", path.name], folder)
        if done is not None:
            pdf = path.with_suffix(".pdf")
            walk.say(pdf, f"LibreCAD: {done.returncode}", is_right=pdf.is_file())
            walk.drawn(pdf, f"cad_{path.stem}")


def laz_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and colours, read by laspy."""
    read = laspy.read(path)
    colours = np.stack([read.red, read.green, read.blue], axis=1)
    return np.asarray(read.xyz), (np.asarray(colours) >> 8).astype(np.uint8)


def ply_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and colours, read by open3d."""
    read = load_open3d("looking at clouds").io.read_point_cloud(str(path))
    return np.asarray(read.points), np.rint(255 * np.asarray(read.colors)).astype(np.uint8)


def e57_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and colours of all scans, read by pye57."""
    file = pye57.E57(str(path))
    scans = [
        file.read_scan(k, colors=True, ignore_missing_fields=True) for k in range(file.scan_count)
    ]
    xyz = [np.stack([scan[f"cartesian{axis}"] for axis in "XYZ"], axis=1) for scan in scans]
    rgb = [
        np.stack([scan[f"color{name}"] for name in ("Red", "Green", "Blue")], 1) for scan in scans
    ]
    return np.concatenate(xyz), np.concatenate(rgb)


def copc_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and colours, read by laspy through the octree."""
    with CopcReader.open(path) as file:
        read = file.query()
    colours = np.stack([read.red, read.green, read.blue], axis=1)
    return np.stack([read.x, read.y, read.z], axis=1), (colours >> 8).astype(np.uint8)


READERS: Final[dict[str, tuple[str, str, Callable[[Path], tuple[np.ndarray, np.ndarray]]]]] = {
    "laz": ("cloud.laz", "laspy", laz_points),
    "copc": ("cloud.copc.laz", "laspy, by its octree", copc_points),
    "ply": ("cloud.ply", "open3d", ply_points),
    "e57": ("cloud.e57", "pye57", e57_points),
}


def walk_clouds(walk: Walk) -> None:
    """Check that points and colours agree in four formats and all colourings; draw each file."""
    for colour in COLOURS:
        seen: list[tuple[np.ndarray, ...]] = []
        for target, (name, reader, read) in READERS.items():
            folder = walk.export(target, "--colour", colour, name=f"{target}_{colour}")
            if folder is None:
                break
            xyz, rgb = read(folder / name)
            content = json.loads((folder / "cloud.json").read_text())
            facts = (xyz.min(0), xyz.max(0), rgb.astype(float).mean(0), rgb.astype(float).std(0))
            seen.append(facts)
            is_same = len(xyz) == content["points"] and all(
                np.abs(mine - first).max() < limit
                for mine, first, limit in zip(facts, seen[0], (1e-3, 1e-3, 0.6, 0.6), strict=True)
            )
            span = " x ".join(f"{side:.2f}" for side in facts[1] - facts[0])
            walk.say(
                folder / name,
                f"{reader}: {len(xyz)} points, {span} m, mean colour {np.rint(facts[2])}",
                is_right=is_same,
            )
            if target == "laz":
                draw_points(
                    xyz, rgb, np.array(content["up"]), walk.pictures / f"cloud_{colour}.png"
                )


def draw_points(xyz: np.ndarray, rgb: np.ndarray, up: np.ndarray, path: Path) -> None:
    """Draw the points, seen along the horizontal axis of smallest extent, the nearest on top."""
    flat = xyz - xyz.mean(0)
    flat = flat - np.outer(flat @ up, up)
    across, along = np.linalg.eigh(np.cov(flat[:: max(1, len(flat) // 100_000)].T))[1].T[1:]
    places = np.stack([(xyz - xyz.min(0)) @ along, -(xyz - xyz.min(0)) @ up], axis=1)
    places -= places.min(0)
    columns, rows = (places * (1199 / places.max())).astype(int).T
    picture = np.full((rows.max() + 1, columns.max() + 1, 3), 255, np.uint8)
    order = np.argsort(xyz @ across)
    picture[rows[order], columns[order]] = rgb[order]
    Image.fromarray(picture).save(path)


def walk_viewers(walk: Walk) -> None:
    """Check the model with trimesh and the Khronos validator, the pages with Chromium."""
    for name, more in (("gltf", ()), ("gltf_relief", ("--relief",))):
        folder = walk.export("gltf", *more, name=name)
        if folder is None:
            continue
        path = folder / "room.glb"
        scene = trimesh.load(path)
        walk.say(path, f"trimesh: {len(scene.geometry)} meshes, {np.round(scene.extents, 2)} m")
        done = walk.started(["node", "-e", VALIDATE, str(path.resolve())], Path.cwd())
        if done is not None and done.returncode == 0:
            issues = json.loads(done.stdout)
            is_right = issues["numErrors"] == issues["numWarnings"] == 0
            said = {name: value for name, value in issues.items() if name != "messages"}
            walk.say(path, f"gltf-validator: {said}", is_right=is_right)
        elif done is not None:
            walk.say("gltf-validator", "not installed")
        photographed(walk, folder / "room.html", name)
    folder = walk.export("tiles")
    if folder is not None:
        sizes = [Image.open(tile).size for tile in folder.rglob("*.webp")]
        is_right = bool(sizes) and max(max(size) for size in sizes) <= 512
        walk.say(folder, f"Pillow: {len(sizes)} tiles, at most {max(sizes)}", is_right=is_right)
        photographed(walk, folder / "index.html", "tiles")


def photographed(walk: Walk, path: Path, name: str) -> None:
    """Return a screenshot by Chromium, and check that there are no errors and further requests."""
    if not IS_HERE:
        walk.say("chromium", "not installed")
        return
    with started() as browser:
        page = Page(browser)
        page.show_as(1200)
        page.open(path.resolve())
        time.sleep(5.0)
        (walk.pictures / f"{name}.png").write_bytes(page.screenshot())
        asked = [address for address in page.requests if not address.startswith(("file:", "data:"))]
        # On a machine without a graphics card, Chromium renders in software and reports this.
        said = [line for line in page.complaints if "WebGL" not in line] + asked
    walk.say(path, f"Chromium: {said or 'no complaint'}", is_right=not said)


def walk_vectors(walk: Walk) -> None:
    """Check GeoJSON, orthoimages and layers with QGIS."""
    folder = walk.export("geojson")
    layers = walk.export("layers")
    files = sorted((walk.run / "products").glob("*/wall_*_ortho.tif"))
    files += [] if folder is None else sorted(folder.glob("*.geojson"))
    files += [] if layers is None else sorted(layers.glob("*.tif"))[:2]
    for python in ("/usr/bin/python3", "python3"):
        words = [python, "-c", IN_QGIS, *map(str, (file.resolve() for file in files))]
        done = walk.started(words, walk.folder)
        if done is not None and "No module named 'qgis'" not in done.stderr:
            for line in done.stdout.splitlines():
                path, said = json.loads(line)
                walk.say(Path(path).name, f"QGIS: {said}", is_right=said[0] and bool(said[1]))
            if done.stdout.count("\n") < len(files):
                walk.say("QGIS", done.stderr[-500:], is_right=False)
            return
    walk.say("QGIS", "not installed")


def walk_records(walk: Walk) -> None:
    """Check PROV with prov, the catalogue with pystac, tables with csv, figures with Pillow."""
    if folder := walk.export("prov"):
        document = prov.model.ProvDocument.deserialize(str(folder / "prov.json"))
        n_records = len(list(document.get_records()))
        walk.say(folder / "prov.json", f"prov: {n_records} records", is_right=n_records > 0)
    if folder := walk.export("stac"):
        core = RegisteredValidator.get_validator()
        collection = pystac.Collection.from_file(str(folder / "collection.json"))
        content = json.loads((folder / "collection.json").read_text())
        core.validate_core(content, pystac.STACObjectType.COLLECTION, "1.1.0")
        items = list(collection.get_items())
        for item in items:
            content = json.loads(Path(item.self_href).read_text())
            core.validate_core(content, pystac.STACObjectType.ITEM, "1.1.0")
            with rasterio.open(item.assets["image"].get_absolute_href()) as raster:
                is_right = item.properties["proj:shape"] == list(raster.shape)
            walk.say(Path(item.self_href), "pystac and rasterio: valid", is_right=is_right)
        walk.say(folder / "collection.json", f"pystac: valid, {len(items)} items")
    if folder := walk.export("csv"):
        for path in sorted(folder.glob("*.csv")):
            with path.open(newline="") as stream:
                rows = list(csv.reader(stream))
            is_right = len({len(row) for row in rows}) == 1
            walk.say(path, f"csv: {len(rows)} x {len(rows[0])}", is_right=is_right)
    if folder := walk.export("figures"):
        for path in folder.rglob("*.png"):
            Image.open(path).load()
        n_files = sum(1 for path in folder.rglob("*") if path.is_file())
        walk.say(folder, f"Pillow: {len(list(folder.rglob('*.png')))} of {n_files} files are PNG")
    if folder := walk.export("ro-crate", "--license", "CC-BY-4.0"):
        words = [sys.executable, str(VALIDATE_CRATE), str(folder.resolve()), PROFILE]
        done = walk.started(words, walk.folder)
        said = "" if done is None else (done.stdout + done.stderr[-500:]).strip()
        walk.say(folder, f"roc-validator: {said}", is_right=said.endswith("[]"))
    if folder := walk.export("colmap"):
        import pycolmap

        walk.say(folder, f"pycolmap: {pycolmap.Reconstruction(str(folder)).summary()}")


PARTS: Final = {
    "sheets": walk_sheets,
    "cad": walk_cad,
    "clouds": walk_clouds,
    "viewers": walk_viewers,
    "vectors": walk_vectors,
    "records": walk_records,
}


def main() -> None:
    """Check all exports, or the given parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--store", type=Path, default=Path(".orthoflow"))
    parser.add_argument("--scale", type=int, default=50)
    parser.add_argument("--only", action="append", choices=PARTS)
    walk = Walk(chosen := parser.parse_args())
    for name in chosen.only or PARTS:
        PARTS[name](walk)
    print(f"{walk.n_wrong} wrong")
    sys.exit(bool(walk.n_wrong))


if __name__ == "__main__":
    main()
