"""The report page: what it answers, from records made by hand."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from orthoflow_provenance.model import (
    RecordedCell,
    RecordedFigure,
    RecordedMetric,
    RecordedProduct,
    RunRecord,
)

from orthoflow.errors import StoreError
from orthoflow.records import Run
from orthoflow.report import write_report
from orthoflow.report.diagrams import run_diagram
from orthoflow.report.pictures import depth_colours
from orthoflow.report.summaries import answers, comparisons, number_with_unit, warnings

DIGEST = "sha256:" + 64 * "0"


def cell(address: str, **more: object) -> RecordedCell:
    step = address.partition("@")[0]
    wanted: dict[str, object] = {"address": address, "step": step, "method": f"{step}.toy"}
    return RecordedCell(**{**wanted, "status": "ok", **more})  # type: ignore[arg-type]


def planes_from(source: str) -> dict[str, RecordedProduct]:
    product = RecordedProduct(
        type_name="planes", encoding_version=1, digest=DIGEST, source=f"{source}.planes"
    )
    return {"planes": product}


def rms(value: float) -> tuple[RecordedMetric, ...]:
    return (RecordedMetric(name="rms_mm", value=value, unit="mm"),)


def run(tmp_path: Path, *cells: RecordedCell) -> Run:
    record = RunRecord(
        run_id="r1",
        name="toy <run>",
        created_by="orthoflow 0.1.0",
        status="ok",
        started="2026-01-02T03:04:05Z",
        ended="2026-01-02T03:05:05Z",
        seed=1,
        workflow_source="orthoflow: 1\n",
        workflow_resolved="{}",
        cells=cells,
    )
    return Run(path=tmp_path / "run.h5", record=record)


@pytest.fixture
def compared(tmp_path: Path) -> Run:
    """Two variants of one step, a step behind each, one of them failed."""
    figure = RecordedFigure(
        name="deviations", caption="how far", media_type="image/png", data=b"\x89PNG"
    )
    return run(
        tmp_path,
        cell("plane@plane=fine", metrics=rms(1.25), figures=(figure,), wall_s=3.0),
        cell("plane@plane=coarse", metrics=rms(4.0), warnings=("the grid is <coarse>",)),
        cell("wall@plane=fine", inputs=planes_from("plane@plane=fine")),
        cell(
            "wall@plane=coarse",
            status="failed",
            error_message="no plane & no wall",
            inputs=planes_from("plane@plane=coarse"),
        ),
    )


def test_the_page_needs_no_network_and_escapes_what_methods_say(
    compared: Run, tmp_path: Path
) -> None:
    write_report([compared], tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert re.findall(r"(?:src|href)=\"(?!data:|#)[^\"]*\"", page) == []
    assert "toy &lt;run&gt;" in page
    assert "no plane &amp; no wall" in page
    assert "the grid is &lt;coarse&gt;" in page
    assert "data:image/png;base64,iVBORw==" in page


def test_several_runs_share_one_page(compared: Run, tmp_path: Path) -> None:
    write_report([compared, compared], tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert page.count("<main") == 2
    anchors = re.findall(r"id=\"([^\"]*)\"", page)
    assert len(anchors) == len(set(anchors))


def test_a_report_that_cannot_be_written_ends_with_a_sentence(
    compared: Run, tmp_path: Path
) -> None:
    with pytest.raises(StoreError, match="cannot be written"):
        write_report([compared], tmp_path / "missing" / "report.html")


def test_failures_stand_before_warnings(compared: Run) -> None:
    assert warnings(compared) == (
        ("wall@plane=coarse", "failed: no plane & no wall"),
        ("plane@plane=coarse", "the grid is <coarse>"),
    )


def test_variants_stand_beside_each_other(compared: Run) -> None:
    table = next(iter(comparisons(compared)))
    assert table.cells == ("plane@plane=fine", "plane@plane=coarse")
    assert table.rows["rms_mm"] == ("1.25", "4")


def test_the_answers_are_the_quality_metrics(compared: Run) -> None:
    assert [(answer.value, answer.cell) for answer in answers(compared)] == [
        ("1.25 mm", "plane@plane=fine"),
        ("4 mm", "plane@plane=coarse"),
    ]


def test_the_answers_tell_the_final_orientation_and_the_sharper_completeness(
    tmp_path: Path,
) -> None:
    def told(**values: float) -> tuple[RecordedMetric, ...]:
        return tuple(RecordedMetric(name=n, value=v, unit="1") for n, v in values.items())

    photographed = run(
        tmp_path,
        cell("first", metrics=told(n_oriented=4, n_photos=6)),
        cell("orient", metrics=told(n_oriented=5, n_photos=6)),
        cell("check", metrics=told(completeness=0.9, completeness_seen_by_both=0.99)),
    )
    assert [(answer.value, answer.cell) for answer in answers(photographed)] == [
        ("0.99", "check"),
        ("5 of 6", "orient"),
    ]


def test_the_diagram_draws_each_cell_once_and_each_hand_over(compared: Run) -> None:
    drawing = run_diagram(compared)
    assert drawing.count("<rect") == 4
    assert drawing.count('class="arrow"') == 2


def test_depths_run_from_blue_over_white_to_red() -> None:
    colours = depth_colours(np.array([[-1.0, 0.0, 1.0, 9.0, np.nan]], np.float32), 1.0)[0]
    assert colours[0].tolist() == [33, 102, 172]
    assert colours[1].tolist() == [247, 247, 247]
    assert colours[2].tolist() == colours[3].tolist() == [178, 24, 43]
    assert colours[4].tolist() == [247, 247, 247]


@pytest.mark.parametrize(
    ("value", "unit", "printed"),
    [
        (0.0123456, "mm", "0.01235 mm"),
        (12.0, "1", "12"),
        (0.0, "px", "0 px"),
        (-3.5, "m", "-3.5 m"),
    ],
)
def test_numbers_have_four_digits_and_their_unit(value: float, unit: str, printed: str) -> None:
    assert number_with_unit(value, unit) == printed
