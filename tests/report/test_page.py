"""The report page in a browser: one start of Chromium for all checks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from orthoflow.report import write_report
from tests.browser import PROGRAM, BrowserError, Page, browser
from tests.report_runs import compared_run

pytestmark = pytest.mark.skipif(PROGRAM is None, reason="no chromium is installed")
ROWS = "[...document.querySelectorAll('#r1-comparison ~ .scroll tbody tr')]"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """The page of a comparison, open in a browser."""
    folder = tmp_path_factory.mktemp("page")
    path = folder / "report.html"
    write_report([compared_run(folder)], path)
    started = browser(folder / "profile")
    try:
        opened = started.__enter__()
    except BrowserError as error:
        pytest.skip(f"chromium does not start here: {error}")
    try:
        opened.show_as(1440)
        opened.open(path)
        yield opened
    finally:
        started.__exit__(None, None, None)


def test_the_console_stays_silent_and_nothing_is_fetched(page: Page) -> None:
    assert page.complaints == []
    assert [url for url in page.requests if not url.startswith(("data:", "file:"))] == []


def test_every_picture_shows_and_says_what_it_is(page: Page) -> None:
    shown = page.evaluate("[...document.images].map(image => image.naturalWidth)")
    assert len(shown) > 8
    assert min(shown) > 0
    assert page.evaluate("document.querySelectorAll('figure > img:not([alt])').length") == 0


def test_headings_sort_the_table_by_mouse_and_keyboard(page: Page) -> None:
    names = f"{ROWS}.map(row => row.cells[0].innerText.split(' ')[0])"
    heading = "document.querySelectorAll('#r1-comparison ~ .scroll th[data-sort]')[1]"
    assert page.evaluate(names) == ["fine", "coarse", "broken"]
    page.evaluate(f"{heading}.querySelector('button').click()")
    assert page.evaluate(f"{heading}.getAttribute('aria-sort')") == "ascending"
    assert page.evaluate(names) == ["fine", "coarse", "broken"]
    page.evaluate(f"{heading}.querySelector('button').focus()")
    page.press("Enter")
    assert page.evaluate(f"{heading}.getAttribute('aria-sort')") == "descending"
    # What has no value stays at the end.
    assert page.evaluate(names) == ["coarse", "fine", "broken"]


def test_a_failed_combination_stands_in_its_row_with_the_reason(page: Page) -> None:
    text = page.evaluate(f"{ROWS}.find(row => row.matches('.failed-row')).innerText")
    assert "no plane & no <wall>" in text


def test_the_slider_moves_by_keyboard_and_cuts_both_pictures(page: Page) -> None:
    page.evaluate("document.querySelector('[data-part=position]').focus()")
    before = float(page.evaluate("document.querySelector('[data-part=position]').value"))
    page.press("ArrowRight")
    position = float(page.evaluate("document.querySelector('[data-part=position]').value"))
    assert position > before
    cuts = page.evaluate(
        "[...document.querySelectorAll('.stage .layer')].map(layer => layer.style.clipPath)"
    )
    assert cuts == [f"inset(0px 0px 0px {position:g}%)", f"inset(0px {100 - position:g}% 0px 0px)"]


def test_the_slider_shows_what_was_chosen(page: Page) -> None:
    page.evaluate(
        "(() => { const right = document.querySelector('[data-part=right]');"
        " right.value = 2; right.dispatchEvent(new Event('change')); })()"
    )
    chosen = page.evaluate(
        "[document.querySelector('.stage .layer img').alt,"
        " document.querySelector('[data-part=right]').selectedOptions[0].text]"
    )
    assert chosen[0] == chosen[1]
    assert "intensity" in chosen[0]


def test_vectors_lie_over_the_intensity_of_their_wall(page: Page) -> None:
    grounds = page.evaluate(
        "[...document.querySelectorAll('.stack')]"
        ".map(stack => stack.querySelectorAll('img').length)"
    )
    assert grounds == [1, 1, 1, 1]


def test_the_theme_follows_the_system_until_it_is_chosen(page: Page) -> None:
    colour = "getComputedStyle(document.body).backgroundColor"
    button = "document.getElementById('theme')"
    light, dark = "rgb(255, 255, 255)", "rgb(20, 23, 26)"
    assert page.evaluate(colour) == light
    page.show_as(1440, theme="dark")
    assert page.evaluate(colour) == dark
    page.evaluate(f"{button}.click()")
    assert page.evaluate(colour) == light
    page.evaluate(f"{button}.click()")
    page.show_as(1440, theme="light")
    assert page.evaluate(colour) == dark
    page.evaluate(f"{button}.click()")
    assert page.evaluate(colour) == light


@pytest.mark.parametrize("width", [1440, 390])
def test_nothing_sticks_out_of_the_window(page: Page, width: int) -> None:
    page.show_as(width)
    # Tables and the graph scroll inside their own boxes.
    assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_the_first_screen_of_a_phone_shows_picture_and_accuracy(page: Page) -> None:
    page.show_as(390, 844)
    page.evaluate("scrollTo({top: 0, behavior: 'instant'})")
    bottoms = page.evaluate(
        "['.first img', '.answers div'].map("
        "name => document.querySelector(name).getBoundingClientRect().bottom)"
    )
    assert max(bottoms) <= 844


def test_all_that_can_be_used_has_a_name(page: Page) -> None:
    nameless = page.evaluate(
        "[...document.querySelectorAll('button, select, input, a, [role=region]')]"
        ".filter(element => !(element.innerText || element.ariaLabel || element.labels?.length))"
        ".map(element => element.outerHTML.slice(0, 80))"
    )
    assert nameless == []


def test_two_environments_on_a_page_fit_a_phone(page: Page, tmp_path: Path) -> None:
    run = compared_run(tmp_path)
    [here] = run.record.environments
    there = replace(here, id="there", cpu="another processor", git_commit="5895f5a" * 6)
    cells = tuple(replace(cell, environment="there") for cell in run.record.cells)
    other = replace(run, record=replace(run.record, environments=(there,), cells=cells))
    write_report([run, other], tmp_path / "both.html")
    page.show_as(390)
    page.open(tmp_path / "both.html")
    assert len(page.evaluate("document.querySelector('.legend').innerText").splitlines()) == 2
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert page.complaints == []
