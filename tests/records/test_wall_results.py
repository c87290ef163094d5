"""What a drawing says of a wall: how exact it is, what was done to colours, which cell is meant."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_provenance.document import Metric, PublishedFile, RecordedCell

from orthoflow.diagnostics import Diagnostic, DiagnosticSpec
from orthoflow.errors import ArgumentError, RecordError
from orthoflow.files.publishing import publish_orthoimages, publish_walls
from orthoflow.files.wall_descriptions import described
from orthoflow.products import (
    CheckPoints,
    Finding,
    Inspection,
    Orthoimage,
    Orthoimages,
    OrthoMask,
    Product,
    Walls,
)
from orthoflow.records import walls as module
from orthoflow.records.walls import WALLS_FILE, add_errors, write_walls_json
from tests import samples
from tests.report_runs import cell, given, run_of


def inspection(*findings: tuple[str, float, int]) -> Inspection:
    return Inspection(
        wall=np.zeros(0, dtype=np.int32),
        points_world=np.zeros((0, 3)),
        displacement_m=np.zeros((0, 2)),
        kind=np.zeros(0, dtype=np.uint8),
        kinds=("point",),
        findings=tuple(
            Finding(name=name, value=value, unit="mm", wall=wall) for name, value, wall in findings
        ),
    )


def test_an_inspection_says_how_exact_a_wall_is_by_findings_on_it() -> None:
    own = inspection(
        ("rmse_x_mm", 1.25, 3), ("rmse_y_mm", 2.0, 3), ("n_found", 6.0, 3),
        ("rms_3d_mm", 3.0, 3), ("max_3d_mm", 9.0, 3),
        ("rmse_x_mm", 7.0, 4), ("rmse_y_mm", 7.0, 4),
        ("rmse_x_mm", 8.0, -1), ("rmse_y_mm", 8.0, -1),
    )  # fmt: skip
    every = inspection(("patch_rmse_u_mm", 1.0, -1), ("patch_rmse_v_mm", 2.0, -1))
    first = inspection(("rmse_u_mm", 4.0, 0), ("rmse_v_mm", 5.0, 0))
    half = inspection(("rmse_x_mm", 1.0, 3), ("n_points", 5.0, 3))
    found = {"check": own, "truth": every, "half": half, "first": first}
    assert [said.text() for said in module.accuracy_phrases(found, 3)] == [
        "measured: RMSE horizontal 1.2 mm, vertical 2.0 mm (check points: 6)",
        "measured in 3D: RMS 3.0 mm, largest 9.0 mm",
    ]
    # What was found of all walls together says nothing of one.
    (first_said,) = module.accuracy_phrases(found, 0)
    assert first_said.text("de") == "gemessen: RMSE horizontal 4,0 mm, vertikal 5,0 mm"


def checkpoints(count: int) -> CheckPoints:
    return CheckPoints(
        names=tuple(f"P{k}" for k in range(count)),
        points_world=np.zeros((count, 3)),
        classes=("",) * count,
        wall=np.full(count, -1, dtype=np.int32),
        pixels_wall=np.full((count, 2), np.nan),
    )


def looking(**more: object) -> RecordedCell:
    points = given("survey.points", "c", "checkpoints")
    return cell("check", inputs={"points": points}, outputs={}, **more)


@pytest.mark.parametrize(
    ("count", "check", "said", "drawn"),
    [
        (3, looking(status="failed", error_message="none was found: P0 (57 m left of wall 0)"),
         "although 3 check points were given: none was found: P0 (57 m left of wall 0)",
         "Kontrollpunkte: 3, keiner verwendbar (siehe Bericht)"),
        (1, cell("check"), "although 1 check point was given: no step used them",
         "Kontrollpunkte: 1, von keinem Schritt verwendet"),
    ],
    ids=["none counted", "not looked for"],
)  # fmt: skip
def test_given_check_points_are_not_asked_for_again(
    count: int, check: RecordedCell, said: str, drawn: str
) -> None:
    points = {"points": given("", "c", "checkpoints")}
    # Those of the simulated room were given by nobody.
    room = cell("room", method="simulate.room", outputs=points)
    survey = cell("survey", method="read.checkpoints", outputs=points)
    products: dict[tuple[str, str], Product] = {("survey", "points"): checkpoints(count)}
    found = module.uncounted_points(run_of(room, survey, check, products=products))
    assert found is not None
    assert (found.sentence, found.phrase.text("de")) == (
        said,
        f"Genauigkeit nicht geprüft; {drawn}",
    )
    for others in ((), (survey, looking())):
        assert module.uncounted_points(run_of(room, *others, products=products)) is None


@pytest.mark.parametrize(
    ("params", "metrics", "said"),
    [
        ({}, (), "colours from mosaic.seams"),
        ({"gains": "none"}, (), "original colours of the photos or the scan"),
        ({"gains": "local"}, (), "original colours: the photos agree, or there is only one"),
        (
            {"gains": "local"},
            (Metric(name="gain_max", value=1.5, unit="1"),),
            "colours balanced between photos",
        ),
    ],
)
def test_what_was_done_to_colours_is_said(
    params: dict[str, Any], metrics: tuple[Metric, ...], said: str
) -> None:
    behind = {"layers": given("ortho.layers", "l", "layers")}
    mosaic = cell("mosaic", method="mosaic.seams", inputs=behind, params=params, metrics=metrics)
    ortho = cell("ortho", inputs={"photos": given("shots.photos", "p", "photos")})
    assert module.colours_phrase(run_of(ortho, mosaic), "mosaic").text() == said
    for least, more in ((0, ""), (10, ", without points darker than 10 of 255")):
        cloud = {"cloud": given("cloud.cloud", "c", "cloud")}
        ortho = cell("ortho", inputs=cloud, params={"skip_below_grey": least})
        found = module.colours_phrase(run_of(ortho, mosaic), "mosaic")
        assert found.text() == f"colours as scanned{more}"


def test_the_last_orthoimages_are_meant_or_else_the_last_walls() -> None:
    def giving(address: str, type_name: str) -> RecordedCell:
        return cell(address, outputs={"out": given("", "0", type_name)})

    a, d, e = giving("a", "walls"), giving("d", "walls"), giving("e", "cloud")
    plane = cell("plane", status="failed", error_message="no plane")
    run = run_of(a, giving("b", "orthoimages"), giving("c", "orthoimages"), d, e)
    assert module.pictured_cell(run, None) == "c"
    assert module.pictured_cell(run, "a") == "a"
    assert module.pictured_cell(run_of(a, d), None) == "d"
    with pytest.raises(ArgumentError, match=r"r1 has no orthoimages and no walls.*plane.*no plane"):
        module.pictured_cell(run_of(e, plane), None)
    with pytest.raises(ArgumentError, match=r"e has no orthoimages or walls; .*: none"):
        module.pictured_cell(run_of(e), "e")
    with pytest.raises(ArgumentError, match="steps of this run that have them: b, c, a, d"):
        module.pictured_cell(run, "e")


PUBLISHED = (
    "products/mosaic/wall_2_ortho.tif",
    "products/mosaic/images_wall_10_depth.tif",
    "products/mosaic/wall_2_ortho.json",
    "products/mosaic/wall_x_ortho.tif",
    "products/mosaic/wall_3_preview.tif",
    "products/other/wall_4_ortho.tif",
    "products/mosaic/wall_5_intensity.tif",
)


def test_an_orthoimage_that_is_gone_is_asked_for(tmp_path: Path) -> None:
    files = tuple(PublishedFile(path=path, size_bytes=0, sha256="") for path in PUBLISHED)
    run = replace(run_of(cell("mosaic"), published=files), path=tmp_path / "run.h5")
    module.require_orthoimages(run, "mosaic", 10)
    for wall in (None, 2):
        with pytest.raises(RecordError, match=r"wall_2_ortho.tif is missing from .* copy it back"):
            module.require_orthoimages(run, "mosaic", wall)
    (tmp_path / "products/mosaic").mkdir(parents=True)
    (tmp_path / PUBLISHED[0]).touch()
    module.require_orthoimages(run, "mosaic", None)


# walls.json: which orthoimages to deliver, by what is published of them ---------------------------


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
