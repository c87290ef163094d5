"""What a run gives at a Python prompt and in a notebook."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from markupsafe import escape
from orthoflow_provenance.document import RecordedFigure, RecordedProduct
from orthoflow_provenance.record import write_record

import orthoflow
from orthoflow.engine.store import Store
from orthoflow.errors import ArgumentError, OrthoflowError, RecordError
from orthoflow.products import Orthoimages, PointCloud
from orthoflow.records.compare import ComparedMetric, Pair
from orthoflow.report.notebooks import Figures, OpenedRun, ShownComparison
from tests.compared_runs import compared, number
from tests.provenance_records import write_sample
from tests.report_runs import cell, compared_resolved, given, metrics, record
from tests.report_runs import orthoimages_product as images_of

PNG = b"\x89PNG\r\n\x1a\n" + bytes(200_000)


class Painted(OpenedRun):
    """A run whose orthoimages are held here instead of in a record."""

    def payload(self, address: str, port: str):  # type: ignore[no-untyped-def]
        assert port == "orthoimages"
        (image,) = images_of(0).images
        both = (replace(image, plane_index=3), replace(image, plane_index=8, name="floor 8"))
        return Orthoimages(images=both).to_payload()

    def payloads(self, places):  # type: ignore[no-untyped-def]
        return (self.payload(*place) for place in places)


def opened(folder: Path) -> OpenedRun:
    figure = RecordedFigure(name="plan", caption="a <plan>", media_type="image/png", data=PNG)
    cells = [
        cell("scan", metrics=metrics(n_points=7.0), figures=(figure,), log="long " * 10_000),
        cell("plane@plane=fine", metrics=metrics(rms_mm=1.0)),
        cell("plane@plane=fine#1", metrics=metrics(rms_mm=1.5)),
        cell("plane@plane=coarse", metrics=metrics(rms_mm=4.0)),
    ]
    made = record(cells, name="hall\x1b[2J", workflow_resolved=compared_resolved())
    write_record(folder / "run.h5", made, lambda _digest: None)
    return orthoflow.open_run(folder)


def test_a_run_fits_into_a_line_and_html_into_a_screen(tmp_path: Path) -> None:
    run = opened(tmp_path)
    assert repr(run) == f"<Run hall\\x1b[2J in {tmp_path}: 4 ok>"
    failed = cell("plane", status="failed", error_message="long " * 10_000)
    endless = OpenedRun(path=tmp_path / "run.h5", record=record([failed]))
    for one in (run.cells["scan"], run.record, run.figures["scan/plan"], endless):
        assert len(repr(one)) < 700
    html = run._repr_html_()
    assert len(html) < 5_000
    assert "points to the first plane, RMS" in html
    assert "steps: 4 ok" in html
    assert not [part for part in ("<img", "&lt;Run", "\x1b") if part in html]


def test_a_run_that_failed_names_the_step_its_reason_and_where_the_log_is(tmp_path: Path) -> None:
    # "no orthoimages of any step; steps with some: none" left its reader to search.
    reason = "no plane holds <2> points: raise tolerance_m"
    cells = [
        cell("room"),
        cell("plane@data=hall", status="failed", error_message=f"{reason}\n\x1b[2J"),
        cell("plane@data=yard", status="failed", error_message="another"),
        cell("mosaic", status="skipped", error_message="needs plane, which failed"),
    ]
    cells[1] = replace(cells[1], log="read 3 points")
    run = OpenedRun(path=tmp_path / "run.h5", record=record(cells, name="hall"))
    said = f"plane@data=hall failed (1 more failed): {reason} \\x1b[2J"
    assert repr(run) == f"<Run hall in {tmp_path}: 1 ok, 2 failed, 1 skipped; {said}>"
    way = "its log is run.cell('plane@data=hall').log"
    for call in (lambda: run.orthoimage(0), lambda: run.orthoimage(0, cell="mosaic")):
        with pytest.raises(ArgumentError) as error:
            call()
        assert str(error.value) == f"the run r1 has no orthoimages; {said}; {way}"
    assert escape(f"steps: 1 ok, 2 failed, 1 skipped; {said}; {way}") in run._repr_html_()
    # Nobody is sent to a log that is empty.
    cells[1] = replace(cells[1], log="")
    silent = OpenedRun(path=tmp_path / "run.h5", record=record(cells, name="hall"))
    assert f"{escape(said)}</p>" in silent._repr_html_()
    assert "its log is" not in silent._repr_html_()


def test_metrics_are_a_row_each_with_the_variants_beside(tmp_path: Path) -> None:
    table = opened(tmp_path).metrics()
    rms = table[table.metric == "rms_mm"]
    assert list(table.columns) == [
        "cell", "step", "method", "variant.plane", "repeat", "metric", "value", "unit",
    ]  # fmt: skip
    assert list(zip(rms["variant.plane"], rms.repeat, rms.value, rms.unit, strict=True)) == [
        ("fine", 0, 1.0, "mm"), ("fine", 1, 1.5, "mm"), ("coarse", 0, 4.0, "mm"),
    ]  # fmt: skip
    assert rms.groupby("variant.plane").value.mean().to_dict() == {"coarse": 4.0, "fine": 1.25}
    assert table[table.step == "scan"]["variant.plane"].isna().all()


def test_rows_state_which_of_several_swept_methods_they_are_of(tmp_path: Path) -> None:
    cells = [
        cell(
            f"plane@data=hall,plane={kind}-{value}",
            method=f"plane.{kind}",
            params={"tolerance_m": value},
            metrics=metrics(rms_mm=1.0),
        )
        for kind in ("hough", "region")
        for value in (2, 3)
    ]
    table = OpenedRun(path=tmp_path / "run.h5", record=record(cells)).metrics()
    rows = table[table.metric == "rms_mm"][["dataset", "plane.use", "plane.tolerance_m"]]
    assert rows.to_numpy().tolist() == [
        ["hall", f"plane.{kind}", value] for kind in ("hough", "region") for value in (2.0, 3.0)
    ]
    assert rows["plane.tolerance_m"].dtype == float
    resolved = json.dumps({"datasets": {"hall": {}, "yard": {}}})
    cells += [replace(one, address=one.address.replace("hall", "yard")) for one in cells]
    cells = [cell(one.address, metrics=one.metrics) for one in cells]
    compared = OpenedRun(path=tmp_path / "run.h5", record=record(cells, workflow_resolved=resolved))
    # Two datasets are too few for p, which is a number nevertheless.
    assert compared.statistics()[["wins", "p", "effect"]].abs().sum().tolist() == [0.0, 0.0, 0.0]


def test_figures_are_by_cell_and_name_and_shown(tmp_path: Path) -> None:
    figures = opened(tmp_path).figures
    assert list(figures) == ["scan/plan"]
    assert repr(figures) == "scan/plan: a <plan>"
    figure = figures["scan/plan"]
    labelled = Figures({"scan/\x1b[2J": replace(figure, caption="a\u202eb")})
    assert repr(labelled) == "scan/\\x1b[2J: a\\u202eb"
    assert "a &lt;plan&gt;" in figure._repr_html_()
    # All of them are pictures, too, and beyond some the rest has names.
    assert figures._repr_html_().count("<img") == 1
    many = Figures({f"scan/{index}": figures["scan/plan"] for index in range(30)})._repr_html_()
    assert (many.count("<img"), many.count("<br>scan/")) == (24, 6)
    assert 'src="data:image/png;base64,iVBORw0KGgo' in figure._repr_html_()
    figure.save(tmp_path / "plan.png")
    assert (tmp_path / "plan.png").read_bytes() == PNG


def test_an_orthoimage_is_an_array_by_its_wall_s_number(tmp_path: Path) -> None:
    made = cell("mosaic", outputs={"orthoimages": given("", "7", "orthoimages")})
    run = Painted(path=tmp_path / "run.h5", record=record([made]))
    (expected,) = images_of(0).images
    assert '<img alt="first orthoimage" src="data:image/webp;base64,' in run._repr_html_()
    image = run.orthoimage(8)
    np.testing.assert_array_equal(np.asarray(image), expected.rgb)
    np.testing.assert_array_equal(image.is_shown, np.isin(expected.mask, (1, 2)))
    assert image.frame.has_cells_of(expected.frame)
    assert repr(image).startswith("<WallImage floor 8 of mosaic: ")
    assert image._repr_html_().startswith('<figure><img src="data:image/webp;base64,')
    assert run.orthoimage().image.number == 3
    assert image.file is None
    with pytest.raises(ArgumentError, match="mosaic has no orthoimage of wall 0; walls: 3, 8"):
        run.orthoimage(0)
    with pytest.raises(ArgumentError, match="no orthoimages of first, only of mosaic"):
        run.orthoimage(cell="first")


def test_an_orthoimage_is_of_the_dataset_that_is_named(tmp_path: Path) -> None:
    made = [
        cell(f"mosaic@data={name}", outputs={"orthoimages": given("", "7", "orthoimages")})
        for name in ("calm", "noisy")
    ]
    resolved = json.dumps({"datasets": {"calm": {}, "noisy": {}}})
    run = Painted(path=tmp_path / "run.h5", record=record(made, workflow_resolved=resolved))
    assert run.orthoimage(8).cell == "mosaic@data=calm"
    assert run.orthoimage(8, data="noisy").cell == "mosaic@data=noisy"
    # Where the first of a dataset has none, it is said that another's is given.
    varied = [
        replace(one, address=f"{one.address},plane=b", assignment={**one.assignment, "plane": "b"})
        for one in made
    ]
    failed = [
        cell(f"plane@data={name},plane=a", status="failed", error_message="none")
        for name in ("calm", "noisy")
    ]
    run = Painted(path=run.path, record=record([*failed, *varied], workflow_resolved=resolved))
    with pytest.warns(
        UserWarning,
        match="the baseline has no orthoimages; showing mosaic@data=noisy,plane=b",
    ):
        assert run.orthoimage(8, data="noisy").cell == "mosaic@data=noisy,plane=b"
    with pytest.raises(ArgumentError, match=r"no dataset noise \(did you mean noisy\?\)"):
        run.orthoimage(8, data="noise")


def test_runs_are_compared_as_a_table(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    first = opened(tmp_path / "a")
    other = record([cell("scan", metrics=metrics(n_points=9.0))], run_id="r2")
    write_record(tmp_path / "b" / "run.h5", other, lambda _digest: None)
    comparison = first.compare(tmp_path / "b")
    assert repr(comparison).startswith("<RunComparison of 'r1' and 'r2': ")
    table = comparison.metric_table().set_index(["cell", "metric"])
    assert tuple(table.loc[("scan", "n_points")]) == (7.0, 9.0, 2.0, "1")
    html = comparison._repr_html_()
    assert "<td>n_points</td>" in html
    assert "rms_mm" not in html
    assert np.isnan(table.loc[("plane@plane=coarse", "rms_mm")].difference)


def shown(*rows: Pair[ComparedMetric]) -> str:
    return ShownComparison(**vars(compared(*rows, alone=("wall",))))._repr_html_()


def test_a_comparison_shows_what_moved() -> None:
    moved = Pair(cell="first", name="n_ties", left=number(1.0), right=number(1.5))
    still = Pair(cell="plane", name="n", left=number(4.0), right=number(4.0))
    near = Pair(cell="plane", name="offset_mm", left=number(1.0), right=number(1.0 + 1e-12))
    alone = Pair(cell="wall", name="rms_mm", left=number(2.0), right=None)
    html = shown(still, moved, near, alone)
    assert html.count("<tr") == 2
    assert "<td>0.5</td>" in html
    assert "plane.a: 1 -&gt; 2" in html
    assert "<p>No common metric differs" in shown(still, near, alone)
    assert "<p>The runs have no metrics in common" in shown(alone)


def test_a_comparison_shows_first_what_says_how_good_it_is() -> None:
    counts = [
        Pair(cell="first", name=f"n_{index}", left=number(1.0), right=number(2.0 + index))
        for index in range(70)
    ]
    sides = (replace(number(value), headline=True) for value in (2.0, 2.1))
    check = Pair(cell="check", name="rmse_u_mm", left=next(sides), right=next(sides))
    html = shown(*counts, check)
    assert html.index("<td>check</td>") < html.index("<td>first</td>")
    assert html.count("<tr") == 61
    assert html.endswith("<p>11 more in <code>metric_table()</code>.</p>")


def test_a_record_that_was_changed_opens_with_a_warning(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    assert orthoflow.open_run(path).verify().findings == ()
    with h5py.File(path, "r+") as file:
        file.attrs["seed"] = type(file.attrs["seed"])(b"8")
    with pytest.warns(UserWarning, match="does not match /; do not rely on this output"):
        run = orthoflow.open_run(path)
    assert run.verify().findings[0].startswith("/: its attribute 'seed' differs")


def cloud_at(x_m: float) -> PointCloud:
    zeros = np.zeros(3, np.float32)
    return PointCloud(origin=np.full(3, x_m), x=zeros, y=zeros, z=zeros, up=np.eye(3)[2])


def stored_cloud(folder: Path) -> RecordedProduct:
    """A cloud of three points in a store, as a record names it."""
    digest = Store(folder).put_product(cloud_at(0.0)).digest
    return RecordedProduct(type_name="cloud", encoding_version=1, digest=digest)


def test_products_that_a_record_only_names_come_from_the_store(tmp_path: Path) -> None:
    cells = [cell("scan", outputs={"cloud": stored_cloud(tmp_path / "store")})]
    run = OpenedRun(path=tmp_path / "run.h5", record=record(cells))
    assert len(run.product("scan", "cloud", store=tmp_path / "store")) == 3
    with pytest.raises(RecordError, match=r"only the digest of .*, as store='F"):
        run.product("scan", "cloud", store=tmp_path / "none")
    Store(tmp_path / "other").put_product(cloud_at(1.0))
    with pytest.raises(
        RecordError, match=r"other does not contain it: pass the store of the run, as store="
    ):
        run.product("scan", "cloud", store=tmp_path / "other")
    with pytest.raises(ArgumentError, match=r"^the run has no figure scan/plan; it has none$"):
        run.figures["scan/plan"]
    assert not (tmp_path / "none").exists()


def test_what_is_wrong_with_a_workflow_is_raised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for options, message in (
        ({"set": {"wall.gsd": 1}}, r"there is no parameter gsd in raster\.grid \(did you"),
        # A step alone is no list of its letters.
        ({"until": "plain"}, r"has no step plain \(did you mean plane\?\)"),
        # What is wrong with a mapping of datasets is placed in what its author wrote.
        (
            {"datasets": {"hall": {"set": {"plane.tolerance": 1}}}},
            r"^datasets=: hall\.set\.plane\.tolerance: there is no ",
        ),
        (
            {"datasets": {"hall": {"scan": ["a.e57", Path("b.e57")]}}},
            r"^input scan@hall: there is no file a\.e57 in the w",
        ),
    ):
        with pytest.raises(OrthoflowError, match=message):
            orthoflow.run("direct.yaml", **options)  # type: ignore[arg-type]
    assert {"run", "open_run"} <= set(dir(orthoflow))
    assert not (tmp_path / "runs").exists()


def test_a_cell_is_found_by_its_step_and_what_varies(tmp_path: Path) -> None:
    address = "plane@data={},plane={}".format
    cells = [
        cell("scan"),
        *(
            cell(address(data, plane) + again)
            for data in ("hall", "yard")
            for plane in ("fine", "coarse", "swept-a-2")
            for again in ("", "#1")
        ),
        cell("merge@data=yard", outputs={"cloud": stored_cloud(tmp_path / "store")}),
    ]
    run = OpenedRun(path=tmp_path / "run.h5", record=record(cells))
    assert run.cell("plane", data="yard", plane="fine").address == address("yard", "fine")
    assert run.cell(address("yard", "fine"), data="yard").address == address("yard", "fine")
    # What a step does not depend on chooses nothing among its cells.
    assert run.cell("scan", data="yard").address == "scan"
    assert run.cell("merge", data="yard", plane="fine").address == "merge@data=yard"
    again = run.cell("plane", data="yard", plane="fine", repeat=1)
    assert again.address == f"{address('yard', 'fine')}#1"
    # Of a sweep, the name before the value.
    assert run.cell("plane", data="yard", plane="swept").address == address("yard", "swept-a-2")
    with pytest.raises(
        ArgumentError,
        match=r"3 cells of 'plane', data=hall: choose plane= \(coarse, fine, swept-a-2",
    ):
        run.cell("plane", data="hall")
    with pytest.raises(
        ArgumentError, match=r"no cells of 'plane', data=attic: choose data= \(hall, yard\)"
    ):
        run.cell("plane", data="attic")
    with pytest.raises(ArgumentError, match="no cells of 'plane', room=hall: choose data="):
        run.cell("plane", room="hall")
    assert len(run.product("merge", "cloud", data="yard", store=tmp_path / "store")) == 3
