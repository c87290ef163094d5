"""What is exported opens in programs of others; where one is not installed, its test says so."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest
from click.testing import CliRunner

from orthoflow.cli.program import program
from tests.drawing_runs import SIZE_M, WALL, write_drawing_run
from tests.optional import skip

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
    """The drawing run, exported to `geojson`."""
    folder = tmp_path_factory.mktemp("elsewhere")
    run = write_drawing_run(folder / "run")
    words = ["export", str(run), "--to", "geojson", "-o", str(folder / "geojson")]
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
