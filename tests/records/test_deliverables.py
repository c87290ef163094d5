"""`walls.json`: which orthoimages to deliver, by what is published of them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from orthoflow.diagnostics import Diagnostic, DiagnosticSpec
from orthoflow.files.publishing import publish_orthoimages, publish_walls
from orthoflow.files.wall_descriptions import described
from orthoflow.products import Orthoimage, Orthoimages, OrthoMask, Walls
from orthoflow.records.walls import WALLS_FILE, add_errors, write_walls_json
from tests import samples

FRAME = samples.facing_south(0.1, 20, 10)


def image(number: int, painted: float, error_m: float | None, *, name: str = "wall") -> Orthoimage:
    mask = np.full(FRAME.shape, OrthoMask.NONE, np.uint8)
    mask.ravel()[: round(painted * mask.size)] = OrthoMask.PAINTED
    errors = None if error_m is None else np.full(FRAME.shape, error_m, np.float32)
    return replace(
        samples.orthoimage(
            FRAME,
            name=f"{name} {number}",
            rgb=np.zeros((*FRAME.shape, 3), np.uint8),
            mask=mask,
            source=np.zeros(FRAME.shape, np.int16),
            plane_index=number,
        ),
        error_m=errors,
        n_check_points=0 if error_m is None or np.isnan(error_m) else 8,
    )


def written(
    folder: Path,
    *images: Orthoimage,
    included: tuple[int, ...] = (),
    diagnostics: tuple[Diagnostic, ...] = (),
) -> Any:
    """What `walls.json` says of the images of a run whose first wall shows some planes."""
    for step in ("wall", "mosaic", "theirs"):
        (folder / step).mkdir()
    wall = samples.wall(FRAME, plane_index=images[0].number)
    walls = Walls(
        walls=(wall,),
        up=np.array([0.0, 0.0, 1.0]),
        intensity_source="none",
        buffer_front_m=0.1,
        buffer_behind_m=0.1,
        included=(included,),
    )
    publish_walls(walls, folder / "wall", "sha256:0")
    publish_orthoimages(Orthoimages(images=images), folder / "mosaic", "sha256:1")
    # Orthoimages of another program are no product of this run.
    publish_orthoimages(Orthoimages(images=(image(9, 1.0, None),)), folder / "theirs", "sha256:2")
    cells: Any = [
        SimpleNamespace(
            address=step,
            status="ok",
            method=f"{step}.toy",
            diagnostics=diagnostics if step == "wall" else (),
            inputs={"a": SimpleNamespace(source="wall.a", digest="0")} if step != "theirs" else {},
            outputs={
                "a": SimpleNamespace(
                    type_name="walls" if step == "wall" else "orthoimages", digest=step
                )
            },
        )
        for step in ("wall", "mosaic", "theirs")
    ]
    add_errors(folder / "mosaic", "mosaic", cells)
    write_walls_json(folder, cells)
    return json.loads((folder / WALLS_FILE).read_text())["walls"]


def test_walls_are_ranked_with_what_speaks_for_and_against_them(tmp_path: Path) -> None:
    found = written(
        tmp_path,
        image(0, 0.7, 0.0021),
        image(1, 1.0, 0.004),
        image(3, 0.2, 0.002, name="floor"),
        image(4, 0.9, float("nan")),
        included=(2,),
    )
    assert [(wall["number"], wall["kind"], wall["recommended"]) for wall in found] == [
        (1, "wall", True),
        (0, "wall", True),
        (4, "wall", False),
        (3, "floor", False),
        (2, "wall", False),
    ]
    by_number = {wall["number"]: wall for wall in found}
    assert by_number[0]["reason"] == "70% covered, expected error 2.1 mm"
    assert by_number[0]["expected_mm_median"] == pytest.approx(2.1)
    assert by_number[0]["orthoimage"] == "mosaic/wall_0_ortho.tif"
    assert (tmp_path / by_number[0]["orthoimage"]).exists()
    assert "accuracy not checked" in by_number[4]["reason"]
    assert by_number[3]["painted_share"] == 0.2
    assert by_number[2]["reason"] == "already included in wall 0"
    assert by_number[2]["orthoimage"] is None
    assert by_number[0]["near"] == pytest.approx(np.mean(FRAME.corners_world(), axis=0), abs=0.01)


def test_an_error_of_the_run_speaks_against_every_wall(tmp_path: Path) -> None:
    spec = DiagnosticSpec(code="down", severity="error", text="all is down", remedy="turn it")
    own = replace(spec, code="own", text="{subject} is down")
    found = written(
        tmp_path, image(0, 0.7, 0.0021), diagnostics=(own.of("wall 0", {}), spec.of("", {}))
    )
    assert [(wall["recommended"], wall["reason"]) for wall in found] == [
        (False, "all is down: turn it")
    ]
    sheet = described(
        tmp_path / "mosaic/wall_0_ortho.tif",
        json.loads((tmp_path / "mosaic/wall_0_ortho.json").read_text()),
    ).objection
    assert sheet is not None
    assert sheet.text("de").endswith("eines Fehlers im Lauf: all is down: turn it")
