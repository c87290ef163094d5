"""The report: what it answers, from records made by hand."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from orthoflow_provenance.document import Metric, PublishedFile, RecordedCell

from orthoflow.records.runs import Run
from orthoflow.records.write import NOT_YET
from orthoflow.report import write_figures, write_page, write_report
from orthoflow.report.combinations import combinations_of
from orthoflow.report.comparisons import comparison_columns, comparison_table
from orthoflow.report.figures import figure_groups
from orthoflow.report.rankings import Mark, Value
from orthoflow.report.rendering import cited
from orthoflow.report.summaries import answers, citations, limits, results
from orthoflow.workflow.expand import NOT_ASKED_FOR
from tests.report_runs import (
    HeldRun,
    cell,
    compared_run,
    given,
    metrics,
    run_of,
    warned,
)


@pytest.fixture
def compared(tmp_path: Path) -> HeldRun:
    """Three variants of one step, one of them failed."""
    return compared_run(tmp_path)


def test_the_page_needs_no_network_and_escapes_what_methods_say(
    compared: Run, tmp_path: Path
) -> None:
    write_report([compared], tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert re.findall(r"src=\"(?!data:)[^\"]*\"", page) == []
    # A citation's link is followed by those who want to, never by the page.
    assert re.findall(r"href=\"(?!data:|#)([^\"]*)\"", page) == [
        "https://doi.org/10.3390/rs71215869"
    ]
    assert "toy &lt;run&gt;" in page
    assert "no plane &amp; no &lt;wall&gt;" in page
    assert "the grid is &lt;coarse&gt;" in page


@pytest.mark.parametrize(
    ("text", "doi"),
    [
        ("Hough (doi:10.3390/rs71215869).", "10.3390/rs71215869"),
        ("Borrmann, doi:10.1007/3DRes.02(2011)3 (pole)", "10.1007/3DRes.02(2011)3"),
        ("SIFT, doi:10.1023/B:VISI.0000029664.99615.94", "10.1023/B:VISI.0000029664.99615.94"),
        ("Crate (see doi:10.1/a(b)).", "10.1/a(b)"),
    ],
)
def test_a_citation_links_its_whole_doi(text: str, doi: str) -> None:
    page = str(cited(text))
    assert f'">doi:{doi}</a>' in page
    assert re.sub(r"<[^>]*>", "", page) == text


def test_figures_lie_beside_the_page_as_png_and_svg(compared: Run, tmp_path: Path) -> None:
    write_page(compared, tmp_path / "report.html")
    files = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("figures/**/*.*")}
    assert files == {
        "figures/graph.svg",
        "figures/check@plane=fine/error_map.png",
        "figures/check@plane=fine/chart.png",
    }
    # Only a page beside them leads to them.
    assert 'href="figures/' in (tmp_path / "report.html").read_text()
    write_report([compared], tmp_path / "other.html")
    assert 'href="figures/' not in (tmp_path / "other.html").read_text()
    assert write_figures(compared, tmp_path / "all", compared.cells) == 4
    assert len(list((tmp_path / "all").glob("check@plane=coarse/*.png"))) == 2
    for path in tmp_path.rglob("figures/**/*.png"):
        assert path.read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "figures" / "graph.svg").read_bytes().startswith(b"<?xml")


def test_what_was_skipped_asks_for_no_citation() -> None:
    cells = [
        cell("plane", citations=("Planes, 2015",)),
        cell("wall", citations=("Planes, 2015 (4, Table 2)", "Walls, 2016")),
        cell("photo", status="skipped", citations=("Photos, 2017",)),
    ]
    planes = ("plane.toy", "wall.toy: 4, Table 2")
    assert citations(run_of(*cells)) == {"Planes, 2015": planes, "Walls, 2016": ("wall.toy",)}


def test_a_picture_that_cannot_be_decoded_costs_its_place_not_the_page(
    compared: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = compared.cells["check@plane=fine"]
    spoilt = tuple(
        replace(figure, data=figure.data[:100]) if figure.name == "error_map" else figure
        for figure in cell.figures
    )
    monkeypatch.setitem(compared.cells, cell.address, replace(cell, figures=spoilt))  # type: ignore[arg-type]
    assert write_figures(compared, tmp_path, [cell.address]) == 1
    assert not list((tmp_path / cell.address).glob("error_map*"))
    monkeypatch.setattr("orthoflow.report.figures.MAX_FIGURE_BYTES", 100)
    monkeypatch.setattr("orthoflow.report.figures.SMALL_BYTES", 0)
    (group,) = [group for group in figure_groups(compared) if group.cell == cell.address]
    assert [picture.caption for picture in group.pictures] == [
        "how far (the picture is damaged)",
        "a chart",
    ]


def rastered(omega_deg: float, area_m2: float, place: str) -> RecordedCell:
    """A raster of a wall, upright but for its last millidegrees."""
    measured = metrics(omega_deg=omega_deg, phi_deg=0.001, area_m2=area_m2)
    return cell(f"wall@{place}", method="raster.grid", metrics=measured)


@pytest.mark.parametrize(
    ("walls", "said"),
    [
        # The same wall with another rim, also across north.
        ([(359.0, 16.0), (1.0, 18.0)], ""),
        (
            [(359.0, 16.0), (180.0, 16.0)],
            "shows 16 m2 at omega 180, phi 0 deg, most others 16 m2 at omega 359, phi 0 deg",
        ),
        # The odd one is named, wherever it stands.
        (
            [(10.0, 1.2), (10.0, 16.0), (10.0, 16.5)],
            "plane=0 shows 1.2 m2 at omega 10, phi 0 deg, most others 16 m2 at omega 10, phi 0 deg",
        ),
    ],
)
def test_combinations_that_show_different_walls_are_a_limit(
    walls: list[tuple[float, float]], said: str
) -> None:
    cells = [rastered(*wall, f"plane={index}") for index, wall in enumerate(walls)]
    found = limits(run_of(*cells))
    if not said:
        assert found == ()
        return
    assert found[0].text.startswith("the first wall is not the same in all combinations, so ")
    assert said in found[0].text
    assert found[0].cells == tuple(one.address for one in cells)


def test_a_first_orientation_limits_nothing_once_a_later_one_has_ended(tmp_path: Path) -> None:
    first = cell("first", method="orient.pnp", **warned("photo a: few ties"))
    reties = cell("reties", method="match.guided", inputs={"c": given("first.cameras", "1", "c")})
    orient = cell(
        "orient",
        method="orient.pnp",
        inputs={"t": given("reties.ties", "2", "t")},
        **warned("photo b: few ties"),
    )
    assert [limit.cells for limit in limits(run_of(first, reties, orient))] == [("orient",)]
    silent = run_of(first, reties, replace(orient, **warned()))
    write_report([silent], tmp_path / "report.html")
    assert "No unresolved warnings." in (tmp_path / "report.html").read_text()
    failed = replace(orient, status="failed", error_message="no disk", **warned())
    limiting = [limit.cells for limit in limits(run_of(first, reties, failed))]
    assert limiting == [("orient",), ("first",)]


def test_errors_come_first_and_five_limits_are_on_the_first_screen(tmp_path: Path) -> None:
    codes = ("unlit", "hidden", "far", "dark", "small", "worst")
    *others, last = (warned(code, code=code, subject="wall 0")["diagnostics"][0] for code in codes)
    # Of a plane that has no orthoimage, unlike wall 0.
    worst = replace(last, severity="error", subject="wall 7")
    image = PublishedFile(path="products/x/wall_0_ortho.tif", size_bytes=2, sha256="0" * 64)
    run = run_of(cell("wall", diagnostics=(*others, worst)), published=(image,))
    assert ["worst" in limit.text for limit in limits(run)] == [True] + [False] * 5
    write_report([run], tmp_path / "report.html")
    _, _, screen = (tmp_path / "report.html").read_text().partition("Limitations of the result")
    assert [part.count("<li>") for part in screen.split("</ul>")[:2]] == [5, 1]


def test_what_nobody_asked_for_is_not_called_unreached(tmp_path: Path) -> None:
    whole_run = run_of(
        cell("wall"),
        cell("paint", status="failed", error_message="no disk"),
        cell("check", status="skipped", error_message="needs paint, which failed"),
        cell("theirs", status="skipped", error_type=NOT_ASKED_FOR),
        cell("match", status="skipped", error_type=NOT_ASKED_FOR),
        overrides=("--until check",),
    )
    assert results(whole_run) == {
        "ok": ("wall",),
        "failed": ("paint",),
        "skipped": ("check",),
        "not asked for": ("theirs", "match"),
    }
    write_report([whole_run], tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "<li>Not reached: check</li>" in page
    assert "<li>Not selected: theirs, match</li>" in page
    assert "Only a part of the workflow was run: <code>--until check</code>." in page


def test_a_third_party_method_declares_its_headlines() -> None:
    (plane,) = metrics(rms_mm=1.6)
    dent = replace(plane, name="dent_share", value=0.25, unit="1", label="share of dents")
    other = Metric(name="n_dents", value=7.0, unit="1", label="dents")
    cells = [
        cell("plane", method="plane.toy", metrics=(plane,)),
        cell("dent", method="dent.simple", metrics=(dent, other)),
    ]
    assert [(one.what, one.value, one.cell) for one in answers(run_of(*cells))] == [
        ("share of dents", "0.25", "dent"),
        ("points to the first plane, RMS", "1.6 mm", "plane"),
    ]
    columns = comparison_columns(combinations_of(run_of(*cells)))
    assert [one.metric for one in columns if one.headline] == ["dent_share", "rms_mm"]


def test_what_a_cell_published_is_linked_in_its_place(tmp_path: Path) -> None:
    folder = tmp_path / "products" / "shade"
    folder.mkdir(parents=True)
    for name in ("shades 1.json", "metrics.csv", "stray.txt"):
        (folder / name).write_text("{}")
    published = tuple(
        PublishedFile(path=f"products/shade/{name}", size_bytes=2, sha256="0" * 64)
        for name in ("shades 1.json", "metrics.csv", "gone.json")
    )
    made = run_of(cell("shade"), cell("plain"), published=published)
    write_page(replace(made, path=tmp_path / "run.h5"), tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert re.findall(r'href="(products/[^"]*)"', page) == ["products/shade/shades%201.json"]
    assert "0 metrics, 1 file</span>" in page


def test_costs_are_summed_over_the_steps_of_a_combination() -> None:
    cells = [
        cell("plane@plane=hough", cpu_s=0.75, peak_rss_mib=1234.6),
        cell("wall@plane=hough", cpu_s=0.75, peak_rss_mib=99.0),
        cell("plane@plane=ransac", cpu_s=0.996, peak_rss_mib=50.0),
        cell("wall@plane=ransac", status="failed", error_message="no wall"),
        cell("plane@plane=region", cpu_s=0.996, peak_rss_mib=50.0),
        cell("wall@plane=region", cpu_s=0.0),
    ]
    table = comparison_table([run_of(*cells)])
    assert table is not None
    found = [tuple(cost.text for cost in one.values[-2:]) for one in table.rows]
    assert found == [("1.5", "1235"), ("", ""), ("1.00", "50")]
    # The next run may take another time, whichever is shorter now.
    assert {cost.mark for one in table.rows for cost in one.values[-2:]} == {Mark.NONE}


@pytest.mark.parametrize(
    ("values", "text", "note"),
    [
        ((2.0,), "2", ""),
        ((1.5, 2.5), "2.00 ± 0.71", "mean and standard deviation of 2 repeats"),
        ((2.0, None, None), "2 (1 of 3 repeats)", ""),
        (
            (-1.5, 2.5),
            "2.00 ± 0.71",
            "mean and standard deviation of absolute errors in 2 repeats",
        ),
        ((None,), "", ""),
    ],
)
def test_a_value_states_what_it_is_the_mean_of(
    values: tuple[float | None, ...], text: str, note: str
) -> None:
    repeats = [
        cell(
            f"plane@plane=one{f'#{index}' if index else ''}",
            metrics=() if value is None else metrics(rms_mm=value),
        )
        for index, value in enumerate(values)
    ]
    table = comparison_table(
        [run_of(*repeats, cell("plane@plane=two", metrics=metrics(rms_mm=3.0)))]
    )
    assert table is not None
    value = table.rows[0].values[0]
    assert (value.text, value.note) == (text, note)


def test_what_a_run_was_broken_off_before_has_no_time_and_is_not_counted(
    compared: HeldRun, tmp_path: Path
) -> None:
    # Of `coarse` only the step before is there, as where the room was built and no plane sought.
    cells = [
        replace(one, status="skipped", error_type=NOT_YET, metrics=(), outputs={}, figures=())
        if one.assignment and one.address != "plane@plane=coarse"
        else one
        for one in compared.record.cells
        if one.assignment.get("plane") != "broken"
    ]
    broken_off = replace(compared, record=replace(compared.record, cells=tuple(cells)))
    table = comparison_table([broken_off])
    assert table is not None
    fine, coarse = table.rows
    assert ([cost.text for cost in fine.values[-2:]], fine.shortfall) == (["", ""], "not computed")
    assert coarse.missing[0] == "wall@plane=coarse"
    assert all(row.shortfall for row in table.rows)
    assert [one.shortfall for one in table.glance] == ["not computed"] * 2
    write_report([broken_off], tmp_path / "report.html", go_on="orthoflow run x")
    page = (tmp_path / "report.html").read_text()
    assert "None of the 2 combinations was completed" in page
    assert "not computed: wall@plane=coarse and 3 more" in page
    assert "found no plane" not in page


def test_runs_of_one_workflow_are_told_apart_by_their_options() -> None:
    cells = cell("plane", metrics=metrics(rms_mm=1.0))
    runs = [
        run_of(cells, run_id=f"r{walls}", overrides=("--set all=0", f"--set wall.n={walls}"))
        for walls in (1, 4)
    ]
    table = comparison_table(runs)
    assert table is not None
    assert [row.run for row in table.rows] == [
        f"toy <run> --set wall.n={walls}, {Path.cwd().name}, r{walls}" for walls in (1, 4)
    ]


def test_a_glance_states_which_lead_and_names_three_at_most(compared: Run) -> None:
    table = comparison_table([compared])
    assert table is not None
    first, _, last = table.glance
    assert (first.name, first.is_baseline) == ("plane=fine", True)
    # The other one was run once only, which is enough for exact methods.
    assert table.best_in(first).startswith("plane: points to the first plane")
    n_exact = table.n_ranked
    cells = [replace(one, determinism="seeded") for one in compared.record.cells]
    seeded = comparison_table([run_of(*cells, workflow_resolved=compared.record.workflow_resolved)])
    assert seeded is not None
    assert (n_exact, seeded.n_ranked, seeded.best_in(seeded.glance[0])) == (3, 0, "")
    assert (last.name, last.shortfall, last.count(Mark.BEST)) == ("plane=broken", "failed", 0)
    for n_best in (3, 4):
        values = tuple(
            Value(mark=Mark.BEST if index < n_best else Mark.NONE)
            for index in range(len(table.columns))
        )
        leader = replace(first, values=values)
        assert leader.count(Mark.BEST) == n_best
        assert table.best_in(leader).endswith(" and 1 more") is (n_best == 4)
