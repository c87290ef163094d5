"""The report of a run on several datasets: a row each, and methods compared over all of them."""

from __future__ import annotations

import csv
import html
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from orthoflow_provenance.document import RecordedCell

from orthoflow.errors import StoreError
from orthoflow.records.runs import Run, datasets_of, parts_of
from orthoflow.records.write import NOT_YET
from orthoflow.report import write_page, write_report
from orthoflow.report.comparisons import dataset_table
from orthoflow.report.paired import over_datasets, who_leads
from orthoflow.report.paper_tables import paper_files
from tests.report_runs import (
    HeldRun,
    cell,
    given,
    metrics,
    orthoimages_product,
    record,
    warned,
)

# RMS of two detectors in seven rooms; None where it failed.
RMS_MM: dict[str, tuple[float, float | None]] = {
    "hall": (2.0, 1.0),
    "stairs": (3.0, 1.5),
    "attic": (4.0, None),
    "cellar": (2.0, 2.5),
    "tower": (9.0, 1.0),
    "porch": (5.0, 5.0),
    "court": (6.0, 5.9),
}


def room(name: str, rms_mm: tuple[float, float | None]) -> list[RecordedCell]:
    slow, quick = rms_mm
    return [
        cell(f"scan@data={name}", **warned(f"{name} is dark", code="dark", subject=name)),
        cell(
            f"plane@data={name},plane=slow",
            metrics=metrics(rms_mm=slow, n_oriented=5.0, n_photos=6.0),
        ),
        cell(f"plane@data={name},plane=quick", metrics=metrics(rms_mm=quick))
        if quick is not None
        else cell(f"plane@data={name},plane=quick", status="failed", error_message="no <plane>"),
    ]


def run_of(folder: Path, rms_mm: dict[str, tuple[float, float | None]]) -> HeldRun:
    """A run of two detectors in some rooms, with an orthoimage of the first one."""
    first = next(iter(rms_mm))
    image = f"mosaic@data={first},plane=slow"
    cells = [
        cell("shared", metrics=metrics(rms_mm=77.0)),
        *(one for name, values in rms_mm.items() for one in room(name, values)),
        cell(image, outputs={"orthoimages": given("", "a", "orthoimages")}),
    ]
    resolved = {
        "datasets": {name: {"inputs": {}, "set": {}} for name in rms_mm},
        "compare": {"baseline": {"plane": "slow"}, "metrics": ["plane.rms_mm"]},
    }
    recorded = record(cells, workflow_resolved=json.dumps(resolved), status="failed")
    products = {(image, "orthoimages"): orthoimages_product(0)}
    return HeldRun(path=folder / "run.h5", record=recorded, products=products)


@pytest.fixture
def rooms(tmp_path: Path) -> HeldRun:
    return run_of(tmp_path, RMS_MM)


def test_the_table_over_datasets_has_a_row_per_combination(tmp_path: Path) -> None:
    run = run_of(tmp_path, {"hall": (6.0, 1.0), "stairs": (3.0, 1.0), "attic": (4.0, None)})
    slow, quick = csv.DictReader(io.StringIO(paper_files(run)["datasets.csv"]))
    assert {row["metric"] for row in (slow, quick)} == {"rms_mm"}
    assert (slow["combination"], slow["median"], slow["pairs"]) == ("plane=slow", "4.0", "")
    wanted = ("datasets", "failed", "pairs", "wins", "losses", "median_difference", "p")
    # Unknown values, as p of two differences, are empty.
    assert [quick[name] for name in wanted] == ["2", "1", "2", "2", "0", "-3.5", ""]


def test_what_leads_over_datasets_is_stated_first(tmp_path: Path) -> None:
    run = run_of(tmp_path, {f"room{k}": (k + 2.0, k + 1.0 - 0.1 * k) for k in range(12)})
    leads = who_leads(over_datasets(parts_of(run)), 12)
    assert leads.startswith("Significant over the datasets, compared with plane=slow")
    write_report([run], tmp_path / "report.html")
    first_screen = (tmp_path / "report.html").read_text().partition("<h2")[0]
    assert leads in html.unescape(first_screen)


def test_a_dataset_that_the_run_was_broken_off_before_is_not_complete(
    rooms: HeldRun, tmp_path: Path
) -> None:
    cells = tuple(
        replace(one, status="skipped", error_type=NOT_YET)
        if one.assignment.get("data") == "court" and one.step == "plane"
        else one
        for one in rooms.record.cells
    )
    broken_off = replace(rooms, record=replace(rooms.record, cells=cells))
    table = dataset_table(parts_of(broken_off), {})
    assert sum(not (row.failed or row.missing) for row in table.rows) == 5
    assert table.rows[-1].missing == ("plane@data=court,plane=slow", "plane@data=court,plane=quick")
    write_report([broken_off], tmp_path / "report.html", go_on="orthoflow run x")
    page = (tmp_path / "report.html").read_text()
    assert "interrupted before plane@data=court,plane=slow (and 1 more)" in page


def test_a_part_of_a_run_is_its_dataset_and_what_all_share(rooms: Run) -> None:
    part = parts_of(rooms)["cellar"]
    planes = [f"plane@data=cellar,plane={name}" for name in ("slow", "quick")]
    assert list(part.cells) == ["shared", "scan@data=cellar", *planes]
    assert (part.record.status, parts_of(rooms)["attic"].record.status) == ("ok", "failed")
    assert datasets_of(part) == ("cellar",)
    # A step called data makes no datasets.
    plain = replace(rooms, record=replace(rooms.record, workflow_resolved="{}"))
    assert (datasets_of(plain), parts_of(plain)) == ((), {})


def test_the_page_leads_to_a_page_of_each_dataset(rooms: HeldRun, tmp_path: Path) -> None:
    write_page(rooms, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    links = re.findall(r'href="(pages/[^"]*)"', page)
    assert links == [f"pages/{name}.html" for name in RMS_MM]
    assert "6 of 7 datasets are complete" in page
    assert "no &lt;plane&gt;" in page
    for name in RMS_MM:
        own = (tmp_path / "pages" / f"{name}.html").read_text()
        assert f"toy &lt;run&gt;: {name}</h1>" in own
        assert 'href="../report.html"' in own
        others = set(RMS_MM) - {name}
        assert not [other for other in others if f"data={other}" in own]


def test_pages_are_not_written_through_a_link(rooms: Run, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "pages").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(StoreError, match="'pages' is a link"):
        write_page(rooms, tmp_path / "report.html")
    assert list((tmp_path / "elsewhere").iterdir()) == []
