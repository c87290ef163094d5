"""Detectors, orientations and orthoimages in all combinations, in one run with a failing method."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from orthoflow.records.open import open_run
from orthoflow.records.runs import Run
from orthoflow.records.verify import verify_run
from tests.browser import Page
from tests.road.conftest import ROOT, Shell

pytestmark = pytest.mark.long
WORKFLOW = ROOT / "benchmarks" / "full_comparison.yaml"
PLANES = ("hough2d", "hough3d", "ransac", "region")
ORIENTATIONS = ("pnp", "dlt", "bundle")
# Of all combinations; the summary before it counts what each is best in.
TABLE = (
    "[...document.querySelectorAll('table')]"
    ".find(table => table.caption?.innerText.startsWith('comparison of'))"
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, store: Path) -> Run:
    shell = Shell(tmp_path_factory.mktemp("full-comparison"), store)
    ended = shell("run", WORKFLOW, "-o", "run", timeout_s=1800)
    assert ended.code == 1, ended.said
    return open_run(shell.folder / "run")


def test_what_variants_share_runs_once(run: Run) -> None:
    done = Counter(cell.step for cell in run.cells.values() if cell.status == "ok")
    assert done == {
        "room": 1,
        **dict.fromkeys(("plane", "wall", "ties", "first", "reties"), len(PLANES)),
        "orient": len(PLANES) * len(ORIENTATIONS),
        # The direct orthoimage takes no photos: once per detector.
        **dict.fromkeys(("ortho", "mosaic", "check"), len(PLANES) * (len(ORIENTATIONS) + 1)),
    }


def test_a_failed_method_leaves_its_cells_failed_and_nothing_else(run: Run) -> None:
    failed = [cell for cell in run.cells.values() if cell.status == "failed"]
    assert [cell.address for cell in failed] == ["plane@plane=hopeless"]
    assert failed[0].error_message
    skipped = [cell for cell in run.cells.values() if cell.status == "skipped"]
    assert skipped
    assert {cell.assignment["plane"] for cell in skipped} == {"hopeless"}
    assert verify_run(run.path).findings == ()


@pytest.mark.parametrize("plane", PLANES)
def test_every_combination_has_its_accuracy(run: Run, plane: str) -> None:
    found = {row.cell: row.value for row in run.metric_rows() if row.metric == "rmse_u_mm"}
    for orient in ORIENTATIONS:
        # Measured: 0.27 (bundle) to 0.53 mm (dlt), and 0.60 mm directly, on cells of 6 mm.
        assert found[f"check@plane={plane},orient={orient},ortho=backward"] < 1.0
    assert found[f"check@plane={plane},ortho=direct"] < 1.2


@pytest.fixture(scope="module")
def page(new_page: Callable[[], Page], run: Run) -> Page:
    """The report of the run in a browser."""
    opened = new_page()
    opened.show_as(1440)
    opened.open(run.folder / "report.html")
    return opened


def test_the_whole_page_can_be_sent_by_mail(run: Run) -> None:
    assert (run.folder / "report.html").stat().st_size <= 25e6
    assert sum(path.stat().st_size for path in (run.folder / "figures").rglob("*.*")) <= 50e6


def test_the_whole_page_is_silent_and_shows_every_picture(page: Page) -> None:
    assert page.complaints == []
    assert [url for url in page.requests if not url.startswith(("data:", "file:"))] == []
    widths = page.evaluate("[...document.images].map(image => image.naturalWidth)")
    assert len(widths) > 100
    assert min(widths) > 0


def test_the_whole_table_sorts_and_keeps_the_failed_combinations(page: Page) -> None:
    rows = f"[...{TABLE}.tBodies[0].rows]"
    assert page.evaluate(f"{rows}.length") == len(PLANES) * (len(ORIENTATIONS) + 1) + len(
        page.evaluate(f"{rows}.filter(row => row.matches('.failed-row')).map(row => row.innerText)")
    )
    index = page.evaluate(
        f"[...{TABLE}.tHead.rows[0].cells].findIndex(cell => cell.innerText.includes('rmse_u'))"
    )
    values = f"{rows}.map(row => row.cells[{index}].dataset.value).filter(text => text)"
    page.evaluate(f"{TABLE}.tHead.rows[0].cells[{index}].querySelector('button').click()")
    ascending = [float(text) for text in page.evaluate(values)]
    assert ascending == sorted(ascending)
    assert len(set(ascending)) > 8
    assert page.evaluate(f"{rows}.at(-1).matches('.failed-row')")


def test_the_whole_page_has_slider_and_theme(page: Page) -> None:
    names = page.evaluate(
        "[...document.querySelector('[data-part=left]').options].map(option => option.text)"
    )
    # Every orthoimage of the wall, and its intensity.
    assert len(names) >= len(PLANES) * (len(ORIENTATIONS) + 1)
    assert any("intensity" in name for name in names)
    page.evaluate("document.querySelector('[data-part=position]').focus()")
    page.press("ArrowRight")
    position = float(page.evaluate("document.querySelector('[data-part=position]').value"))
    cuts = page.evaluate(
        "[...document.querySelectorAll('.stage .layer')].map(layer => layer.style.clipPath)"
    )
    assert cuts == [f"inset(0px 0px 0px {position:g}%)", f"inset(0px {100 - position:g}% 0px 0px)"]
    colour = "getComputedStyle(document.body).backgroundColor"
    page.show_as(1440, theme="dark")
    dark = page.evaluate(colour)
    page.evaluate("document.getElementById('theme').click()")
    assert page.evaluate(colour) != dark


@pytest.mark.parametrize("width", [1440, 390])
def test_the_whole_page_fits_its_window(page: Page, width: int) -> None:
    page.show_as(width)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
