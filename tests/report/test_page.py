"""The report page in a browser: one start of Chromium for all checks."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import axe_core_python
import pytest
from orthoflow_provenance.document import Metric, RecordedCell, RecordedFigure

from orthoflow.diagnostics import PLAIN_WARNING
from orthoflow.files.survey_points import read_measured_ties, read_survey_points
from orthoflow.report import write_report
from tests.browser import Page
from tests.report_runs import HeldRun, compared_run

# Few combinations stand beside each other where their row would be cut.
AS_ROWS = (
    "if (document.querySelector('[data-chooser] .turned'))"
    " document.querySelector('.chooser button').click()"
)
VIEWER = "document.getElementById('viewer')"
ROWS = "[...document.querySelectorAll('[data-chooser] tbody tr')]"


# All but the first screen is folded.
UNFOLD = "document.querySelectorAll('details.part').forEach(one => one.open = true)"


@pytest.fixture(scope="module")
def page(new_page: Callable[[], Page], tmp_path_factory: pytest.TempPathFactory) -> Page:
    """The page of a comparison, open in a browser."""
    folder = tmp_path_factory.mktemp("page")
    path = folder / "report.html"
    write_report([compared_run(folder)], path)
    opened = new_page()
    opened.show_as(1440)
    opened.open(path)
    opened.evaluate(UNFOLD)
    return opened


def test_the_page_is_whole_and_fetches_nothing(page: Page) -> None:
    assert page.complaints == []
    assert [url for url in page.requests if not url.startswith(("data:", "file:"))] == []
    shown = page.evaluate("[...document.images].map(image => image.naturalWidth)")
    assert len(shown) > 8
    assert min(shown) > 0
    page.evaluate(AS_ROWS)
    failed = page.evaluate(f"{ROWS}.find(row => row.matches('.failed-row')).innerText")
    assert "no plane & no <wall>" in failed
    text = page.evaluate("document.querySelector('main').innerText")
    summary = text[: text.index("At a glance")]
    assert summary.count("no plane & no <wall>") == 1
    assert "the values are those of the baseline, plane=fine, with which the others" in summary
    nameless = page.evaluate(
        "[...document.querySelectorAll('button, select, input, a, [role=region]')]"
        ".filter(element => !(element.textContent || element.ariaLabel || element.labels?.length))"
        ".map(element => element.outerHTML.slice(0, 80))"
    )
    assert nameless == []


def test_headings_sort_the_table_by_mouse_and_keyboard(page: Page) -> None:
    names = f"{ROWS}.map(row => row.cells[0].innerText.split(' ')[0])"
    heading = "document.querySelectorAll('[data-chooser] th[data-sort]')[1]"
    page.evaluate(AS_ROWS)
    assert page.evaluate(names) == ["fine", "coarse", "broken"]
    page.evaluate(f"{heading}.querySelector('button').click()")
    assert page.evaluate(f"{heading}.getAttribute('aria-sort')") == "ascending"
    assert page.evaluate(names) == ["fine", "coarse", "broken"]
    page.evaluate(f"{heading}.querySelector('button').focus()")
    page.press("Enter")
    assert page.evaluate(f"{heading}.getAttribute('aria-sort')") == "descending"
    # What has no value stays at the end.
    assert page.evaluate(names) == ["coarse", "fine", "broken"]


def test_the_bar_of_the_scale_is_as_long_as_it_says_below_narrow_pictures_too(page: Page) -> None:
    measured = page.evaluate(
        "[...document.querySelectorAll('figure[data-width-m]')].flatMap(figure => [1, 0.1]"
        ".map(part => { const image = figure.querySelector('img'), was = image.style.cssText;"
        " const bar = figure.querySelector('.legend .ink');"
        " image.style.width = part * image.clientWidth + 'px';"
        " const [shown, long] = [image, bar].map(one => one.getBoundingClientRect().width);"
        " image.style.cssText = was;"
        " return [long / shown * figure.dataset.widthM, bar.closest('svg').ariaLabel]; }))"
    )
    assert len(measured) > 8
    for length_m, label in measured:
        number, unit = label.removeprefix("scale: the bar is ").split()
        said_m = float(number) * {"m": 1.0, "cm": 0.01}[unit]
        assert length_m == pytest.approx(said_m, rel=0.01), label


FIGURE = "document.querySelector('.first figure')"
POINTER = (
    f"(kind, x, y) => {{ const image = {FIGURE}.querySelector('img');"
    " const box = image.getBoundingClientRect();"
    " image.dispatchEvent(new PointerEvent(kind, { bubbles: true,"
    " clientX: box.left + image.clientLeft + x * image.clientWidth,"
    " clientY: box.top + image.clientTop + y * image.clientHeight })); }"
)


def test_the_world_under_the_cursor_of_an_orthoimage_is_told(page: Page) -> None:
    page.evaluate(f"({POINTER})('pointermove', 0.25, 0.5)")
    output = page.evaluate(f"{FIGURE}.querySelector('.readout').innerText")
    # 120 x 80 cells of 0.01 m from (4e5, 5e6, 3), u along x, v down, n along -y.
    u, v = (float(text) for text in re.findall(r"[uv] ([0-9.]+) px", output))
    assert (u, v) == pytest.approx((30.0, 40.0), abs=0.6)
    x, y, z = (float(text) for text in re.findall(r"[xyz] (-?[0-9.]+)", output))
    depth = re.findall(r"depth (-?[0-9.]+) m", output)
    assert x == pytest.approx(4.0e5 + 0.01 * u, abs=2e-3)
    assert z == pytest.approx(3.0 - 0.01 * v, abs=2e-3)
    assert y == pytest.approx(5.0e6 - (float(depth[0]) if depth else 0.0), abs=2e-3)


def test_clicks_are_saved_as_check_points_and_as_ties(page: Page, tmp_path: Path) -> None:
    page.evaluate(
        "(() => { window.saved = []; URL.createObjectURL = blob => {"
        " blob.text().then(text => window.saved.push(text)); return '#'; };"
        " HTMLAnchorElement.prototype.click = function () { window.file = this.download; }; })()"
    )
    panel = "document.querySelector('.points')"
    assert page.evaluate(f"{panel}.querySelector('[data-part=ties]').disabled") is True
    for x in (0.25, 0.75, 0.5):
        page.evaluate(f"({POINTER})('click', {x}, 0.5)")
    page.evaluate(f"{panel}.querySelectorAll('[aria-label=\"remove point 2\"]')[0].click()")
    page.evaluate(f"{panel}.querySelector('[data-part=checkpoints]').click()")
    assert page.evaluate("window.file") == "checkpoints.csv"
    saved = page.evaluate("new Promise(done => setTimeout(() => done(window.saved.pop()), 50))")
    (tmp_path / "checkpoints.csv").write_text(saved)
    points = read_survey_points(tmp_path / "checkpoints.csv")
    assert [(point.name, point.wall) for point in points] == [("P1", 0), ("P3", 0)]
    header, first, second = csv.reader(saved.splitlines())
    assert header == ["name", "x", "y", "z", "wall", "shown_x", "shown_y", "shown_z"]
    assert (first[0], second[0]) == ("P1", "P3")
    # 120 cells of 0.01 m along x, from 4e5: clicked at a quarter and in the middle.
    assert [point.shown_m[0] for point in points if point.shown_m] == pytest.approx(
        [4.0e5 + 0.30, 4.0e5 + 0.60], abs=6e-3
    )
    # Whoever surveyed them replaces x, y, z.
    assert first[1:4] == first[5:8]
    assert second[1:4] == second[5:8]
    page.evaluate(f"{panel}.querySelector('[data-part=ties]').click()")
    output = f"{panel}.querySelector('[data-part=message]').innerText"
    assert page.evaluate(output).startswith("0 ties; 2 points without a photo")
    page.evaluate(
        f"(() => {{ const row = {panel}.querySelector('[data-part=list] > div');"
        " const [, photo, u, v] = row.querySelectorAll('input');"
        " photo.value = 'a, b.jpg'; u.value = '12.5'; v.value = '7'; })()"
    )
    page.evaluate(f"{panel}.querySelector('[data-part=ties]').click()")
    saved = page.evaluate("new Promise(done => setTimeout(() => done(window.saved.pop()), 50))")
    header, tie = csv.reader(saved.splitlines())
    assert header == ["photo", "u_px", "v_px", "x", "y", "z"]
    assert tie == ["a, b.jpg", "12.5", "7", *first[1:4]]
    (tmp_path / "ties.csv").write_text(saved)
    (read,) = read_measured_ties(tmp_path / "ties.csv")
    assert (read.photo, read.pixel) == ("a, b.jpg", (12.5, 7.0))
    assert read.position == points[0].position
    assert page.evaluate(output) == "1 ties; 1 points without a photo or pixel position are omitted"
    assert page.complaints == []


def test_the_theme_follows_the_system_until_it_is_chosen(page: Page) -> None:
    seen = []
    for theme, is_pressed in (("light", 0), ("dark", 0), ("dark", 1), ("dark", 1), ("light", 0)):
        page.show_as(1440, theme=theme)
        if is_pressed:
            page.evaluate("document.getElementById('theme').click()")
        seen.append(page.evaluate("getComputedStyle(document.body).backgroundColor"))
    light, dark = "rgb(255, 255, 255)", "rgb(20, 23, 26)"
    assert seen == [light, dark, light, dark, dark]
    page.evaluate("document.getElementById('theme').click()")


def test_nothing_sticks_out_of_a_phone(page: Page) -> None:
    width = 390
    page.show_as(width)
    whole = "document.documentElement.scrollWidth"
    # The page is laid out again when the browser reports the new width, within two seconds.
    page.evaluate(
        "new Promise(done => { let looks = 100; const look = () =>"
        f" --looks && {whole} > {width} ? setTimeout(look, 20) : done(); look(); }})"
    )
    # Tables and the graph scroll inside their own boxes.
    assert page.evaluate(whole) <= width


def test_points_are_read_and_collected_in_the_enlarged_view(page: Page) -> None:
    rows = "document.querySelectorAll('.points [data-part=list] > div')"
    before = page.evaluate(f"{rows}.length")
    page.evaluate("document.querySelector('.first .enlarge').click()")
    # In large cells, the middle of the picture stays in the middle of the stage.
    for _ in range(3):
        page.evaluate(f"{VIEWER}.querySelector('[data-part=in]').click()")
    image = f"{VIEWER}.querySelector('.viewer-stage img').getBoundingClientRect()"
    left, top, width, height = page.evaluate(
        f"(() => {{ const box = {image}; return [box.left, box.top, box.width, box.height]; }})()"
    )
    # The middle of cell (57, 43) of 120 x 80.
    at = {"x": left + width * 57.5 / 120, "y": top + height * 43.5 / 80}
    page.tab.mouse.move(**at)
    readout = page.evaluate(f"{VIEWER}.querySelector('[data-part=readout]').innerText")
    assert readout.startswith("u 57.5 px, v 43.5 px")
    assert page.evaluate(f"{rows}.length") == before
    page.tab.mouse.down()
    page.tab.mouse.up()
    assert page.evaluate(f"{rows}.length") == before + 1
    assert f"wall 0, {readout}" in page.evaluate(f"[...{rows}].pop().innerText")
    marked = f"[...{VIEWER}.querySelectorAll('.marks > span')].pop().getBoundingClientRect()"
    assert page.evaluate(f"{marked}.left") == pytest.approx(at["x"], abs=1.5)
    assert page.evaluate(f"{marked}.top") == pytest.approx(at["y"], abs=1.5)
    # A drag moves the picture and collects nothing.
    page.tab.mouse.down()
    for _ in range(2):
        at["x"] += 20.0
        page.tab.mouse.move(**at)
    page.tab.mouse.up()
    assert page.evaluate(f"{image}.left") > left + 10.0
    assert page.evaluate(f"{rows}.length") == before + 1
    caption = page.evaluate(f"{VIEWER}.querySelector('[data-part=caption]').innerText")
    assert "." in caption
    assert not re.search(r"[a-z]\.products/", caption)
    # What the picture is, and how it is read, are two sentences.
    assert ". Lines of the building" in caption
    page.evaluate(f"{VIEWER}.querySelector('[data-part=close]').click()")


def test_rows_are_filtered_columns_chosen_and_the_table_turned(page: Page) -> None:
    bar = "document.querySelector('.chooser')"
    page.evaluate(AS_ROWS)
    page.evaluate(
        f"(() => {{ const filter = {bar}.querySelector('input[type=search]');"
        " filter.value = 'coarse'; filter.dispatchEvent(new Event('input')); })()"
    )
    shown = page.evaluate(f"{ROWS}.filter(row => !row.hidden).map(row => row.cells[0].innerText)")
    assert shown == ["coarse"]
    page.evaluate(f"{bar}.querySelector('.names input').click()")
    assert page.evaluate("document.querySelector('[data-chooser] [data-name=rms_mm]').hidden")
    page.evaluate(f"{bar}.querySelector('button').click()")
    heads = page.evaluate(
        "[...document.querySelectorAll('.turned thead th')].map(e => e.innerText)"
    )
    assert heads == ["what", "coarse"]
    names = page.evaluate(
        "[...document.querySelectorAll('.turned tbody th')].map(e => e.innerText)"
    )
    assert any("error along u, RMS / mm" in name for name in names)
    assert not any("points to the first plane" in name for name in names)


def test_axe_finds_nothing_that_keeps_people_out(page: Page) -> None:
    axe = Path(axe_core_python.__file__).with_name("axe.min.js").read_text(encoding="utf-8")
    page.show_as(390, theme="dark")
    page.open(Path(page.evaluate("location.pathname")))
    page.evaluate(f"{axe}; document.querySelectorAll('details').forEach(one => one.open = true)")
    # What lies behind the figure that is opened then is as it was.
    for look, place in (
        ("0", "document"),
        ("document.querySelector('.enlarge').click()", "'dialog[open]'"),
    ):
        page.evaluate(look)
        found = page.evaluate(
            f"axe.run({place}).then(result => result.violations.map("
            "rule => [rule.id, ...rule.nodes.map(node => node.html.slice(0, 120))]))"
        )
        assert found == []


def test_on_paper_results_are_unfolded(page: Page) -> None:
    page.show_as(1440)
    page.open(Path(page.evaluate("location.pathname")))
    page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    assert page.evaluate("document.querySelectorAll('details.paper:not([open])').length") == 0
    wide = page.evaluate(
        "[...document.querySelectorAll('.on-paper table')].map(t => t.rows[0].cells.length)"
    )
    assert 0 < max(wide) <= 6
    page.evaluate("window.dispatchEvent(new Event('afterprint'))")
    assert page.evaluate("document.querySelectorAll('.on-paper, details.paper[open]').length") == 0
    page.evaluate(UNFOLD)


SCRIPT = "document.title = 'injected'; console.error('injected')"
INJECTED = (
    f"<script>{SCRIPT}</script>",
    f'<img src="data:," onerror="{SCRIPT}">',
    f'"><script>{SCRIPT}</script>',
    "</style></script><svg onload=\"document.title = 'injected'\">",
)
HOSTILE_SVG = f"""<svg xmlns="http://www.w3.org/2000/svg" width="40" height="30" onload="{SCRIPT}">
<script>{SCRIPT}</script><style>rect {{ fill: green }}</style><rect width="40" height="30"/>
<foreignObject width="9" height="9"><img xmlns="http://www.w3.org/1999/xhtml" src="x"
onerror="{SCRIPT}"/></foreignObject></svg>"""


def hostile(run: HeldRun) -> HeldRun:
    """The run with scripts in whatever a stranger may write."""
    text = "".join(INJECTED)

    def spoilt(cell: RecordedCell) -> RecordedCell:
        figures = tuple(
            replace(figure, name=text, caption=text, media_type=f"image/png{text}")
            for figure in cell.figures
        )
        drawn = RecordedFigure(
            name="drawn", caption=text, media_type="image/svg+xml", data=HOSTILE_SVG.encode()
        )
        metrics = tuple(replace(metric, unit=text) for metric in cell.metrics)
        return replace(
            cell,
            metrics=(*metrics, Metric(name=text, value=1.0, unit=text)) if metrics else (),
            figures=(*figures[:1], drawn) if figures else (),
            diagnostics=(
                replace(PLAIN_WARNING.of("", {"text": "x"}), text=text),
                replace(PLAIN_WARNING.of("", {"text": "x"}), text="turned \u202eround"),
            ),
            citations=(f"{text} doi:10.1/{text}",),
            log=text,
            params={text: text},
            method=text,
        )

    cells = tuple(map(spoilt, run.record.cells))
    record = replace(
        run.record, cells=cells, name=text, run_id=text, workflow_source=text, overrides=(text,)
    )
    return replace(run, record=record)


def test_what_strangers_write_is_no_script_and_the_page_still_works(
    page: Page, tmp_path: Path
) -> None:
    write_report([hostile(compared_run(tmp_path))], tmp_path / "hostile.html")
    page.complaints.clear()
    page.show_as(1440)
    page.open(tmp_path / "hostile.html")
    # Time for the scripts that shall not run: handlers of images come after they have loaded.
    page.evaluate("new Promise(done => setTimeout(done, 200))")
    assert page.evaluate("document.title").startswith("<script>")
    assert page.complaints == []
    # The page's own two, and blocks of data, which nobody runs.
    kinds = page.evaluate("[...document.scripts].map(script => script.type)")
    assert sorted(kinds) == ["", "", "application/json", "application/json"]
    assert page.evaluate("document.querySelectorAll('[onerror], [onload]').length") == 0
    assert "turned \\u202eround" in page.evaluate("document.body.innerText")
    # The picture with a script in it is shown as a picture.
    drawn = "[...document.images].filter(image => image.src.startsWith('data:image/svg'))"
    assert 40 in page.evaluate(f"{drawn}.map(image => image.naturalWidth)")
    page.evaluate(UNFOLD)
    page.evaluate("document.querySelector('th[data-sort] button').click()")
    assert page.evaluate("document.querySelectorAll('[aria-sort=ascending]').length") == 1
    assert page.complaints == []


def test_the_policy_of_the_page_stops_what_would_get_onto_it(page: Page, tmp_path: Path) -> None:
    write_report([compared_run(tmp_path)], tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    # As if an escape had been forgotten.
    (tmp_path / "leaky.html").write_text(
        text.replace("</main>", f"{''.join(INJECTED[:2])}<p style='color: red'>red</p></main>")
    )
    page.complaints.clear()
    page.open(tmp_path / "leaky.html")
    assert page.evaluate("document.title") != "injected"
    assert page.evaluate("getComputedStyle(document.querySelector('main > p')).color") != (
        "rgb(255, 0, 0)"
    )
    assert len(page.complaints) >= 3
    assert all("Content Security Policy" in complaint for complaint in page.complaints)
