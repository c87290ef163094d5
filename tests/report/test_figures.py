"""Figures on a page, the plan of photos, the graph of a run, and rows of a comparison."""

from __future__ import annotations

import base64
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.orient.report import residual_rows
from orthoflow_provenance.document import RecordedFigure

from orthoflow.files.images import decode_image, encode_png, encode_webp
from orthoflow.products import Camera, Cameras
from orthoflow.records import RecordedEnvironment
from orthoflow.report import combinations as module
from orthoflow.report.combinations import group_environments, improved_on, ways
from orthoflow.report.figures import figure_groups, graph_file, run_graph, write_figures
from orthoflow.report.photo_plans import photo_plan
from orthoflow.report.pictures import wall_pictures
from tests.report_runs import HeldRun, cell, compared_run, environment, given, run_of

PNG, SVG, WEBP = "image/png", "image/svg+xml", "image/webp"


def figure(name: str, data: bytes, media_type: str = PNG) -> RecordedFigure:
    return RecordedFigure(name=name, caption=f"about {name}", media_type=media_type, data=data)


def test_all_figures_of_a_page_take_less_than_four_megabytes() -> None:
    # Pictures that pack badly: some 3 bytes a pixel as PNG.
    rng = np.random.default_rng(0)
    large = tuple(
        figure(f"f{k}", encode_png(rng.integers(0, 256, (700, 700, 3)).astype(np.uint8)))
        for k in range(3)
    )
    assert 2 * len(large[0].data) < 3_900_000 < 3 * len(large[0].data)
    for figures, is_whole in ((large[:2], True), (large, False)):
        (group,) = figure_groups(run_of(cell("plane@plane=fine", figures=figures)))
        shown = [base64.b64decode(one.uri.partition(",")[2]) for one in group.pictures]
        assert (shown == [one.data for one in figures]) is is_whole
        assert sum(map(len, shown)) <= 3_900_000


# --- files ---


def test_figures_are_written_as_programs_take_them(tmp_path: Path) -> None:
    picture = np.full((20, 30, 3), 77, np.uint8)
    bad = b'<svg xmlns="http://www.w3.org/2000/svg"><script>alert(1)</script></svg>'
    figures = (
        figure("photo", encode_webp(picture), WEBP),
        figure("chart", encode_png(picture)),
        figure("script", bad, SVG),
        figure("damaged", b"RIFF....WEBP", WEBP),
    )
    other = cell("other", figures=(figure("not_asked", encode_png(picture)),))
    of = run_of(cell("check", figures=figures), other)
    assert write_figures(of, tmp_path / "out", ["check"]) == 2
    found = sorted(
        path.relative_to(tmp_path / "out").as_posix()
        for path in (tmp_path / "out").rglob("*")
        if path.is_file()
    )
    assert found == ["check/chart.png", "check/photo.png", "graph.svg"]
    photo = decode_image((tmp_path / "out/check/photo.png").read_bytes())
    assert np.abs(photo.astype(int) - 77).max() <= 3
    assert (tmp_path / "out/graph.svg").read_bytes().startswith(b"<?xml")
    assert write_figures(of, tmp_path / "page", ["other"], inside="figures") == 1
    assert (tmp_path / "page/figures/other/not_asked.png").is_file()
    assert (tmp_path / "page/figures/graph.svg").is_file()


def oriented(run: HeldRun, **changes: Any) -> HeldRun:
    """The run with other orientations."""
    products = {
        place: replace(product, **changes) if isinstance(product, Cameras) else product
        for place, product in run.products.items()
    }
    return replace(run, products=products)


def run_with(folder: Path, *cameras: Camera) -> HeldRun:
    return oriented(compared_run(folder), cameras=cameras)


def ours(run: HeldRun) -> Camera:
    return next(
        product.cameras[0] for product in run.products.values() if isinstance(product, Cameras)
    )


def test_a_photo_stands_before_its_wall_and_looks_at_it(tmp_path: Path) -> None:
    run = compared_run(tmp_path)
    plan = photo_plan(run, list(wall_pictures(run)))
    assert plan is not None
    # Of two variants the baseline's.
    assert plan.cell == "orient@plane=fine"
    [photo], [wall] = plan.photos, plan.walls
    _, foot_m, look = photo
    _, _, corners = wall
    # 2 m to the south of a wall of 1.2 m from west to east.
    assert np.ptp(corners[:, 0]) == pytest.approx(1.2)
    assert corners[:, 0].min() < foot_m[0] < corners[:, 0].max()
    assert corners[:, 1].min() - foot_m[1] == pytest.approx(2.0, rel=0.02)
    np.testing.assert_allclose(look, [0.0, 1.0], atol=0.05)


def test_refused_photos_are_named_and_names_are_escaped(tmp_path: Path) -> None:
    one = ours(compared_run(tmp_path))
    odd = replace(one, photo="<b>.jpg")
    refused = Camera(photo="gone.jpg", status="too few ties")
    run = run_with(tmp_path, odd, refused)
    plan = photo_plan(run, list(wall_pictures(run)))
    assert plan is not None
    assert "1 of 2 photos" in plan.caption
    assert "Not oriented and therefore not shown: gone.jpg." in plan.caption
    # Names are outlines, and only the caption and the table have them as text.
    assert b"<b>" not in plan.file("svg")


def test_without_an_oriented_photo_there_is_no_plan(tmp_path: Path) -> None:
    run = run_with(tmp_path, Camera(photo="gone.jpg", status="too few ties"))
    assert photo_plan(run, list(wall_pictures(run))) is None


def test_each_photo_has_a_row_with_its_error_on_the_wall(tmp_path: Path) -> None:
    one = replace(ours(compared_run(tmp_path)), sigma_wall_m=0.0012)
    refused = Camera(photo="gone.jpg", status="too few <ties>")
    run = run_with(tmp_path, one, refused, replace(one, photo="untied.jpg", sigma_wall_m=None))
    check_px, control_px = np.array([[3.0, -4.0]]), np.array([[50.0, 60.0]])
    units = {"px": 1.0, "mm": 2.0}
    check = residual_rows("a.jpg", "check", check_px, units)
    control = residual_rows("a.jpg", "control", control_px, units)
    run = oriented(run, residual_table=(*check, *control))
    plan = photo_plan(run, list(wall_pictures(run)))
    assert plan is not None
    assert plan.table.rows == (
        # The mean of both axes, of check ties alone, in millimetres alone. Of 30 ties a third each
        # is control, check and rejected.
        ("a.jpg", pytest.approx(1.2), pytest.approx(2.0 * 12.5**0.5), 10, 10, "ok"),
        ("gone.jpg", None, None, None, None, "too few <ties>"),
        ("untied.jpg", None, None, 0, 0, "ok"),
    )


# The graph of a run, environments, and rows of a comparison ---------------------------------------


CLOUD = given("scan.cloud", "1", "cloud")


def test_boxes_are_below_all_that_they_depend_on() -> None:
    held = run_of(
        cell("scan", wall_s=125.0),
        cell("plane", inputs={"cloud": CLOUD}, cached_from="r0"),
        cell("failing", inputs={"cloud": CLOUD}, status="failed"),
        cell("w", inputs={"c": CLOUD, "p": given("plane.p", "2", "planes")}, status="skipped"),
    )
    graph = run_graph(held)
    assert [tuple(about.values()) for _, about in graph.nodes(data=True)] == [
        ("ok", "scan.toy, 2 min 05 s", 0, 0.0),
        ("cached", "plane.toy, 1.00 s", 1, -0.5),
        ("failed", "failed", 1, 0.5),
        ("skipped", "skipped", 2, 0.0),
    ]
    assert set(graph.edges) == {
        ("scan", "plane"),
        ("scan", "failing"),
        ("scan", "w"),
        ("plane", "w"),
    }
    assert ET.fromstring(graph_file(held)).tag == "{http://www.w3.org/2000/svg}svg"


def test_wide_levels_continue_below_and_what_was_skipped_alone_is_last() -> None:
    skipped = [cell(f"read{index}", status="skipped") for index in range(7)]
    planes = [cell(f"plane{index}", inputs={"cloud": CLOUD}) for index in range(6)]
    graph = run_graph(run_of(cell("scan"), *skipped, *planes))
    rows = [row for _, row in graph.nodes(data="row")]
    assert [rows.count(row) for row in range(5)] == [1, 5, 1, 5, 2]
    assert rows[0] == 0
    assert rows[1:8] == [3] * 5 + [4] * 2


def test_cells_of_a_step_are_one_box() -> None:
    cells = [cell(f"plane@plane=v{k}", status="failed" if k < 3 else "ok") for k in range(25)]
    (about,) = (about for _, about in run_graph(run_of(*cells)).nodes(data=True))
    assert about["state"] == "failed"
    assert about["about"] == "run 25 times, 22.0 s, 3 failed"
    for froms, state in ((("r0",), "cached"), (("r0", ""), "ok")):
        cells = [cell(f"p@p=v{k}", cached_from=froms[k % len(froms)]) for k in range(4)]
        assert run_graph(run_of(*cells)).nodes["p"]["state"] == state


FIRST = environment()


def packages(name: str, **versions: str) -> RecordedEnvironment:
    return replace(FIRST, id=name, packages={**FIRST.packages, **versions})


def first_alike(*others: RecordedEnvironment) -> list[str]:
    run = run_of(cell("a"), environments=(FIRST, *others))
    return [*group_environments([run]).first.values()]


@pytest.mark.parametrize(
    ("used", "other", "is_alike"),
    [
        ({"numpy"}, packages("e2", pytest="9"), True),
        (None, packages("e2", pytest="9"), True),
        ({"numpy"}, packages("e2", numpy="2.2"), False),
        ({"scipy"}, packages("e2", numpy="2.2"), True),
        (None, packages("e2", numpy="2.2"), False),
        ({"numpy"}, replace(FIRST, id="e2", cpu="other"), False),
    ],
    ids=["unrelated", "one has it", "used", "unused", "not known", "machine"],
)
def test_only_what_methods_use_sets_environments_apart(
    monkeypatch: pytest.MonkeyPatch,
    used: set[str] | None,
    other: RecordedEnvironment,
    is_alike: bool,
) -> None:
    monkeypatch.setattr(module, "required_distributions", lambda _: used)
    assert first_alike(other) == ["e1", "e1" if is_alike else "e2"]


def test_every_cell_stands_in_one_place(tmp_path: Path) -> None:
    run = compared_run(tmp_path)
    fine, coarse, broken = ways(run, "r1-")
    assert fine.cells == ()
    assert "check@plane=coarse" in coarse.cells
    assert coarse.name == "plane=coarse"
    assert (coarse.anchor, broken.cells) == ("r1-way-2", ("plane@plane=broken",))


def test_what_combinations_share_stands_with_the_first() -> None:
    cells = [
        cell("plane@plane=a"),
        cell("plane@plane=b"),
        *(cell(f"orient@plane={p},orient={o}") for p in "ab" for o in "xy"),
    ]
    run = run_of(*cells)
    found = {way.name: way for way in ways(run, "")}
    assert found["plane=b, orient=x"].cells == ("plane@plane=b", "orient@plane=b,orient=x")
    assert found["plane=b, orient=y"].cells == ("orient@plane=b,orient=y",)


def test_a_first_orientation_is_improved_on_by_the_second() -> None:
    cells = [
        cell("first", method="orient.pnp"),
        cell("reties", method="match.guided", inputs={"c": given("first.cameras", "1", "cameras")}),
        cell("orient", method="orient.dlt", inputs={"t": given("reties.ties", "2", "ties")}),
    ]
    run = run_of(*cells)
    assert improved_on(run, [one.address for one in cells]) == {"first"}
    assert improved_on(run, ["first", "reties"]) == frozenset()
