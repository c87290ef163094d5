"""The plugins in `examples/`: installed, each keeps the rules and stands beside our own methods."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.cli import program
from orthoflow.testing import conformance_cases
from orthoflow.workflow.views import workflow_schema
from tests.author_environments import ROOT, install, new_environment, succeed
from tests.road.conftest import metrics_of

EXAMPLES = ROOT / "examples"


@pytest.fixture
def cracks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The plugin with a kind of its own, installed."""
    site = tmp_path / "site"
    shutil.copytree(EXAMPLES / "orthoflow-cracks" / "orthoflow_cracks", site / "orthoflow_cracks")
    install(site, "orthoflow-cracks", monkeypatch)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def orthoflow(*arguments: str) -> str:
    result = CliRunner().invoke(program, arguments)
    assert result.exit_code == 0, result.output
    return result.output


def test_a_kind_and_a_product_of_a_plugin_go_through_a_comparison_like_ours(cracks: Path) -> None:
    shutil.copy(EXAMPLES / "orthoflow-cracks" / "compare.yaml", cracks)
    orthoflow("run", "compare.yaml", "-o", "run", "--executor", "inline")
    shown = json.loads(orthoflow("show", "run", "--json"))
    assert {cell["address"]: cell["status"] for cell in shown["cells"]} == {
        "wall": "ok",
        "crack@crack=faint": "ok",
        "crack@crack=plain": "ok",
    }
    published = cracks / "run" / "products" / "crack@crack=plain" / "cracks.geojson"
    features = json.loads(published.read_text())["features"]
    assert len(features) == 3
    assert {feature["geometry"]["type"] for feature in features} == {"LineString"}
    assert "crack.n_cracks" in (cracks / "run" / "report.html").read_text()
    orthoflow("verify", "run")
    orthoflow("run", "compare.yaml", "-o", "again", "--executor", "inline")
    compared = json.loads(orthoflow("compare", "run", "again", "--json"))
    assert "crack@crack=plain" in json.dumps(compared)


@pytest.mark.usefixtures("cracks")
def test_the_schema_has_a_plugins_parameters() -> None:
    schema = workflow_schema(discover_catalog())
    params = schema["$defs"]["crack.dark-lines"]["properties"]
    assert params["width_max_m"]["description"] == "Wider dark strips are no cracks."
    assert params["width_max_m"]["default"] == 0.02


def test_a_method_of_a_plugins_own_kind_keeps_the_rules(cracks: Path) -> None:
    assert discover_catalog().kinds["crack"].state == "fine"
    problems = [case.problem() for case in conformance_cases("simulate.cracked-wall")]
    assert [problem for problem in problems if problem] == []


@pytest.mark.long
@pytest.mark.parametrize("name", ["orthoflow-pyransac3d", "orthoflow-poselib", "orthoflow-cracks"])
def test_an_example_installs_and_passes_its_tests(name: str, tmp_path: Path) -> None:
    python = new_environment(tmp_path / "venv")
    folder = tmp_path / name
    shutil.copytree(EXAMPLES / name, folder)
    succeed(folder, python, "-m", "pip", "install", "-q", ".")
    succeed(folder, python, "-m", "pytest", "-q")


@pytest.mark.long
def test_the_examples_stand_beside_our_own_methods(tmp_path: Path) -> None:
    python = new_environment(tmp_path / "venv")
    for name in ("orthoflow-pyransac3d", "orthoflow-poselib"):
        shutil.copytree(EXAMPLES / name, tmp_path / name)
        succeed(tmp_path, python, "-m", "pip", "install", "-q", f"./{name}")
    shutil.copy(EXAMPLES / "beside-ours.yaml", tmp_path)
    succeed(tmp_path, python, "-m", "orthoflow", "run", "beside-ours.yaml", "-o", "run")
    shown = json.loads(succeed(tmp_path, python, "-m", "orthoflow", "show", "run", "--json"))
    assert {cell["status"] for cell in shown["cells"]} == {"ok"}
    metrics = metrics_of(tmp_path / "run")
    for variant in ("plane=ransac,orient=pnp", "plane=ransac,orient=poselib"):
        assert metrics[f"check@{variant}", "plane_angle_deg"] < 0.01
        assert metrics[f"check@{variant}", "n_oriented"] == 6
        assert metrics[f"check@{variant}", "n_misoriented"] == 0
        assert metrics[f"check@{variant}", "pose_wall_rms_mm"] < 1.5  # a quarter of a cell
    assert metrics["check@plane=pyransac3d,orient=pnp", "plane_angle_deg"] < 0.05
