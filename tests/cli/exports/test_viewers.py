"""Exports to look at: the model of a run in relief, and runs that have no depths."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner, Result

from orthoflow.cli.program import program
from tests.drawing_runs import WALL, write_drawing_run


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_drawing_run(tmp_path / "run")


def export(run: Path, *more: str) -> Result:
    words = ["export", str(run), "--to", "gltf", "-o", str(run.parent / "model"), *more]
    return CliRunner().invoke(program, words)


@pytest.mark.parametrize("more", [(), ("--relief",)])
def test_a_model_has_the_depths_of_the_wall_only_on_request(run: Path, more: tuple[str]) -> None:
    done = export(run, *more)
    assert done.exit_code == 0, done.output
    (mesh,) = trimesh.load(run.parent / "model" / "room.glb").geometry.values()
    span_m = np.ptp(mesh.vertices[:, 2])
    assert len(mesh.faces) > 2 if more else len(mesh.faces) == 2
    assert span_m == pytest.approx(0.04 if more else 0.0)


def test_a_run_without_depths_says_so(run: Path) -> None:
    shutil.rmtree(run / "products" / "wall")
    done = export(run, "--relief")
    assert done.exit_code == 2
    assert f"--relief: the run has no depth raster of wall {WALL}" in " ".join(done.output.split())
    assert not (run.parent / "model").exists()
