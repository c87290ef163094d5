"""What is exported opens in programs of others; where one is not installed, its test says so."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pdfplumber
import pytest
from click.testing import CliRunner
from PIL import Image

from orthoflow.cli.program import program
from tests.drawing_runs import SIZE_M, WALL, box_openings, write_drawing_run
from tests.optional import need_programs, skip

# QGIS comes with the system's Python, which need not be the one of the tests.
PYTHONS = ("/usr/bin/python3", "python3")
IN_QGIS = """
import json, sys
from qgis.core import QgsApplication, QgsRasterLayer, QgsVectorLayer
app = QgsApplication([], False)
app.initQgis()
raster = QgsRasterLayer(sys.argv[1], "ortho")
box = raster.extent()
said = {"raster": [raster.isValid(), raster.width(), raster.height(), raster.bandCount()],
        "extent": [box.xMinimum(), box.yMinimum(), box.xMaximum(), box.yMaximum()]}
for path in sys.argv[2:]:
    layer = QgsVectorLayer(path, "vectors", "ogr")
    kinds = {}
    for sub in layer.dataProvider().subLayers() or [""]:
        name = sub.split("!!::!!")
        source = path if len(name) < 4 else f"{path}|layername={name[1]}|geometrytype={name[3]}"
        for feature in QgsVectorLayer(source, "part", "ogr").getFeatures():
            kind = feature["kind"]
            kinds[kind] = kinds.get(kind, 0) + 1
    said[path.rsplit("/", 1)[-1]] = [layer.isValid(), kinds]
print(json.dumps(said))
"""


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drawing run, exported to `dxf` and `geojson`."""
    folder = tmp_path_factory.mktemp("elsewhere")
    run = write_drawing_run(folder / "run")
    for target in ("dxf", "geojson"):
        words = ["export", str(run), "--to", target, "-o", str(folder / target)]
        done = CliRunner().invoke(program, words)
        assert done.exit_code == 0, done.output
    return folder


def environment(folder: Path) -> dict[str, str]:
    runtime = folder / "xdg"
    runtime.mkdir(mode=0o700, exist_ok=True)
    return {
        **os.environ,
        "QT_QPA_PLATFORM": "offscreen",
        "XDG_RUNTIME_DIR": str(runtime),
        "HOME": str(folder),
    }


def has_qgis(python: str) -> bool:
    words = [python, "-c", "import qgis.core"]
    return subprocess.run(words, capture_output=True, check=False).returncode == 0


def test_qgis_opens_orthoimage_and_vectors_in_the_same_coordinates(exported: Path) -> None:
    found = [python for python in PYTHONS if has_qgis(python)]
    if not found:
        skip("program", "QGIS (Debian: python3-qgis)")
    ortho = exported / "run" / "products" / "mosaic" / f"wall_{WALL}_ortho.tif"
    vectors = [exported / "geojson" / name for name in (f"wall_{WALL}.geojson", "room.geojson")]
    done = subprocess.run(
        [found[0], "-c", IN_QGIS, str(ortho), *map(str, vectors)],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env=environment(exported),
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])
    assert said["raster"][:3] == [True, 380, 230]
    wide, high = SIZE_M[0] - 0.2, SIZE_M[2] - 0.2
    # Y is the height: the room begins at 100 m, the picture 10 cm above.
    assert said["extent"] == pytest.approx([0.0, 100.1, wide, 100.1 + high], abs=1e-9)
    kinds = {"frame": 1, "rectangle": 1, "edge": 4, "check point": 2, "opening": 1}
    assert said[f"wall_{WALL}.geojson"] == [True, kinds]
    is_valid, kinds = said["room.geojson"]
    assert is_valid
    assert (kinds["edge"], kinds["corner"], kinds["opening"]) == (12, 8, 1)


def test_librecad_draws_the_wall_with_its_picture_and_openings(exported: Path) -> None:
    librecad, pdftoppm = need_programs("librecad", "pdftoppm")
    folder = exported / "dxf"
    name = f"wall_{WALL}"
    for words in (
        [librecad, "dxf2pdf", "-a", f"{name}.dxf"],
        [pdftoppm, "-scale-to", "1000", "-png", "-singlefile", f"{name}.pdf", name],
    ):
        done = subprocess.run(
            words,
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            timeout=600,
            env=environment(exported),
        )
        assert done.returncode == 0, done.stderr
    with pdfplumber.open(folder / f"{name}.pdf") as pdf:
        paper_mm = [side * 25.4 / 72.0 for side in (pdf.pages[0].width, pdf.pages[0].height)]
    assert paper_mm == pytest.approx([420.0, 297.0], abs=0.5)
    picture = np.asarray(Image.open(folder / f"{name}.png").convert("RGB")).astype(int)
    # The layer of openings is cyan.
    is_cyan = (picture[..., 0] < 90) & (picture[..., 1:] > 200).all(axis=2)
    rows, columns = np.nonzero(is_cyan)
    high, wide = np.ptp(rows), np.ptp(columns)
    (opening,) = box_openings().openings
    assert wide / high == pytest.approx(opening.width_m / opening.height_m, abs=0.02)
    # In it, red grows to the right and green downwards, as in the orthoimage.
    inside = picture[rows.min() + 80 : rows.max() - 5, columns.min() + 5 : columns.max() - 5]
    # Medians, since text and residuals lie over it.
    assert (np.diff(np.median(inside[:, ::40, 0], axis=0)) > 0).all()
    assert (np.diff(np.median(inside[::40, :, 1], axis=1)) > 0).all()
