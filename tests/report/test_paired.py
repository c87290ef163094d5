"""Methods over datasets: medians, differences dataset by dataset, ranks, and what is shown."""

from __future__ import annotations

import csv
import html
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from orthoflow_provenance.document import Metric, RecordedCell
from scipy.stats import wilcoxon

from orthoflow.errors import StoreError
from orthoflow.records.runs import Run, datasets_of, parts_of
from orthoflow.records.write import NOT_YET
from orthoflow.report import write_page, write_report
from orthoflow.report.comparisons import dataset_table
from orthoflow.report.paired import (
    MeanRanks,
    MetricOverDatasets,
    Paired,
    mean_ranks,
    over_datasets,
    paired_differences,
    who_leads,
)
from orthoflow.report.paper_tables import paper_files
from tests.report_runs import (
    HeldRun,
    cell,
    environment,
    given,
    metrics,
    orthoimages_product,
    record,
    run_of,
    warned,
)

# Of one method in each room, with repeats a list; None where it failed.
_Values = Sequence[float | list[float | None] | None]


def over_parts(
    cells: Sequence[RecordedCell], resolved: Mapping[str, object], **more: object
) -> Sequence[MetricOverDatasets]:
    """Compare the methods of a run over its datasets."""
    return over_datasets(parts_of(run_of(*cells, workflow_resolved=json.dumps(resolved), **more)))


def over(
    methods: Mapping[str, _Values],
    better: str = "lower",
    *,
    unit: str = "mm",
    n_photos: Mapping[str, Sequence[int]] | None = None,
    elsewhere: Sequence[tuple[str, int]] = (),
) -> MetricOverDatasets:
    """Compare methods in rooms; the first one is the reference.

    Args:
        methods: method -> its values.
        better: good side.
        unit: of the metric.
        n_photos: method -> over how many photos its values are.
        elsewhere: method and room whose value is of another environment.
    """

    judged: dict[str, Any] = {"better": better, "headline": True, "label": "size"}
    cells = []
    for method, values in methods.items():
        for room, measured in enumerate(values):
            for repeat, value in enumerate(measured if isinstance(measured, list) else [measured]):
                counts = {"n_photos": float(n_photos[method][room])} if n_photos else {}
                sizes = {} if value is None else {"size": value, **counts}
                counted = {"counted_by": "n_photos"} if n_photos else {}
                cells.append(
                    cell(
                        f"plane@data=r{room},plane={method}{f'#{repeat}' if repeat else ''}",
                        status="failed" if measured is None else "ok",
                        metrics=tuple(
                            Metric(
                                name=name,
                                value=size,
                                unit=unit,
                                **(judged | counted if name == "size" else {}),
                            )
                            for name, size in sizes.items()
                        ),
                        environment="e2" if (method, room) in elsewhere else "e1",
                    )
                )
    n_rooms = max(map(len, methods.values()))
    resolved = {
        "datasets": {f"r{room}": {"inputs": {}, "set": {}} for room in range(n_rooms)},
        "compare": {"baseline": {"plane": next(iter(methods))}},
    }
    environments = (environment(), environment("e2", threads=4))
    (found,) = over_parts(cells, resolved, environments=environments)
    return found


def pairs(better: str, *values: tuple[float, float]) -> Paired:
    ours, theirs = zip(*values, strict=True)
    found = over({"theirs": theirs, "ours": ours}, better).methods[1].paired
    assert found is not None
    return found


@pytest.mark.parametrize(("better", "median"), [("lower", -1.0), ("higher", 1.0)])
def test_a_difference_has_the_sign_of_the_number(better: str, median: float) -> None:
    found = paired_differences(np.array([-1.0, -1.0, -4.0, 2.0, -1.5, 1.0, 0.0]), better)
    assert (found.n, found.wins, found.losses, found.median) == (7, 4, 2, median)


def test_five_differences_are_tested_and_four_are_not() -> None:
    few = paired_differences(np.array([-1.0, -2.0, -3.0, -4.0, 0.0, 0.0]), "lower")
    assert math.isnan(few.p)
    assert math.isnan(few.effect)
    values = (-1.0, -2.0, -3.0, -4.0, 2.5)
    found = paired_differences(np.array([*values, 0.0]), "lower")
    # Ranks 1, 2, 4 and 5 for, 3 against: (12 - 3) / 15.
    assert found.effect == pytest.approx(0.6)
    assert found.p == wilcoxon(values).pvalue
    every = paired_differences(np.arange(1.0, 6.0), "lower")
    assert (every.effect, every.wins) == (-1.0, 0)
    assert every.p == pytest.approx(0.0625)


def test_values_without_a_finite_difference_are_not_paired() -> None:
    # A factor of zero is infinitely far from 1.
    found = pairs("one", (2.0, 1.5), (0.0, 1.5), (1.1, 1.5))
    assert (found.n, found.wins, found.losses) == (2, 1, 1)
    assert over({"a": (0.0, 0.0), "b": (1.0, 1.0)}, "one").methods[1].paired is None


@pytest.mark.parametrize(
    ("better", "ours", "theirs"),
    [
        ("lower", 0.84536087, 0.84536104),
        ("higher", 0.84536104, 0.84536087),
        # Angles of next to nothing, in degrees; errors of both signs; factors to 1.
        ("lower", 1e-13, 4.5e-13),
        ("lower", -0.84536087, 0.84536104),
        ("one", 0.5, 2.0000001),
    ],
)
def test_what_differs_by_rounding_is_level_and_tests_nothing(
    better: str, ours: float, theirs: float
) -> None:
    found = pairs(better, *[(ours, theirs)] * 8)
    assert (found.n, found.wins, found.losses, found.median) == (8, 0, 0, 0.0)
    assert math.isnan(found.p)
    assert math.isnan(found.effect)


def test_more_than_rounding_and_every_count_is_a_difference() -> None:
    found = pairs("lower", (1.0, 1.000002), (3e7 + 1.0, 3e7), (0.0, 2e-6))
    assert (found.wins, found.losses) == (2, 1)


def test_a_method_is_summed_up_over_datasets() -> None:
    methods = {"a": (-2.0, [3.0, None], 10.0, [None]), "b": (1.0, None, [None], [None])}
    first, second = over(methods).methods
    assert (first.name, first.compared_with, second.compared_with) == ("plane=a", "", "plane=a")
    assert (first.n, first.n_failed, first.n_absent, first.n_partly) == (3, 0, 1, 1)
    assert (second.n, second.n_failed, second.n_absent, second.n_partly) == (1, 1, 2, 0)
    # Errors of both signs would make each other small.
    assert first.median == 3.0
    assert first.spread == pytest.approx(1.4826 * 1.0)
    assert first.paired is None
    assert second.paired is not None
    assert (second.paired.n, second.paired.wins) == (1, 1)
    assert over(methods, "").methods[1].paired is None


def test_of_what_is_found_or_not_the_share_of_datasets_is_stated() -> None:
    found = over({"a": (1.0, 1.0, 1.0), "b": (1.0, 0.0, 0.5)}, "higher", unit="yes/no")
    first, second = found.methods
    # Their medians would be 1 and 0.5.
    assert (first.median, second.median) == (1.0, 0.5)
    assert math.isnan(second.spread)
    assert second.paired is not None
    assert (second.paired.median, second.paired.losses) == (-0.5, 2)
    assert math.isnan(second.paired.interval[0])


def test_unequal_numbers_of_photos_and_environments_are_not_paired() -> None:
    photos = {"a": (3, 3, 3), "b": (2, 3, 3)}
    values = {"a": (2.0, 2.0, 2.0), "b": (1.0, 3.0, 1.0)}
    second = over(values, n_photos=photos, elsewhere=[("b", 2)]).methods[1]
    assert second.paired is not None
    assert (second.paired.n, second.paired.losses, second.n_apart) == (1, 1, 2)


def test_a_step_has_a_row_per_variant_on_which_it_depends() -> None:
    cells = [
        cell(f"{step}@data=r{room},plane={plane}{corner}", metrics=(size,))
        for size in [Metric(name="size", value=1.0, unit="mm", better="lower", headline=True)]
        for room in range(2)
        for plane in "ab"
        for step, corner in (("plane", ""), ("check", ",corner=x"), ("check", ",corner=y"))
    ]
    resolved = {"datasets": {f"r{room}": {} for room in range(2)}}
    found = over_parts(cells, resolved)
    assert {one.column.step: [method.name for method in one.methods] for one in found} == {
        "check": [f"plane={plane}, corner={corner}" for plane in "ab" for corner in "xy"],
    } | ({"plane": ["plane=a", "plane=b"]} if len(found) > 1 else {})


def test_methods_are_compared_at_equal_values_of_a_sweep() -> None:
    cells = [
        cell(
            f"plane@data=r{room},plane={name}-{value}",
            method=f"plane.{name}",
            params={"tolerance_m": value},
            metrics=(Metric(name="size", value=value, unit="mm", better="lower", headline=True),),
        )
        for room in range(2)
        for name in ("hough", "ransac")
        for value in (0.02, 0.1)
    ]
    resolved = {
        "datasets": {f"r{room}": {} for room in range(2)},
        "compare": {"baseline": {"plane": "hough-0.02"}},
    }
    (found,) = over_parts(cells, resolved)
    assert {one.name: one.compared_with for one in found.methods} == {
        "plane=hough-0.02": "",
        "plane=hough-0.1": "plane=hough-0.02",
        "plane=ransac-0.02": "plane=hough-0.02",
        "plane=ransac-0.1": "plane=hough-0.1",
    }
    assert found.lead == "plane=hough-0.02 (0.02 mm) is level with plane=ransac-0.02."


def leading(n_better: int, n_level: int, n_rooms: int = 12) -> MetricOverDatasets:
    """Methods of which some are better than the reference in every room, and others level."""
    rooms = np.arange(1.0, n_rooms + 1.0)
    methods = {"reference": 10.0 + rooms}
    methods |= {f"good{k}": 9.0 + 0.9 * rooms for k in range(n_better)}
    methods |= {f"level{k}": 10.0 + rooms + (-1.0) ** rooms for k in range(n_level)}
    return over({name: values.tolist() for name, values in methods.items()})


def test_what_is_shown_to_lead_is_stated_of_six_at_most() -> None:
    assert who_leads([over({"a": (1.0, 2.0), "b": (3.0, 4.0)}, "")], 2) == ""
    assert who_leads([over({"a": (1.0, 2.0)})], 2) == ""
    few = who_leads([leading(1, 0, 4)], 4)
    assert few.startswith("4 datasets are not enough to draw a conclusion: ")
    assert "at least 6 datasets for all comparisons (1)" in few
    assert who_leads([leading(0, 2)], 12).startswith(
        "No difference is significant in any of 1 metrics"
    )
    both = who_leads([leading(1, 1)], 12)
    assert "compared with plane=reference" in both
    assert "plane=good0 better in 1 of 1 metrics (size)" in both
    assert "No significant difference: plane=level0. Friedman's and Nemenyi's tests" in both
    assert both.endswith("not significantly different from it: size (plane=good0)")
    # With six rooms, p is at least 2 / 2^6, times 2 comparisons.
    few = who_leads([leading(2, 0, 6)], 6)
    assert "and 2 testable comparisons, the smallest possible p is 0.062; at least 7 data" in few
    # Comparisons that cannot be tested yet are counted, so that the number does not rise later.
    for n_rooms in (2, 6):
        same = over({name: [1.0] * n_rooms for name in "abc"})
        few = who_leads([leading(2, 0, n_rooms), *[same] * 5], n_rooms)
        assert "at least 9 datasets" in few
        assert "for all comparisons (12)" in few
    six, seven = (who_leads([leading(n, 0)], 12) for n in (6, 7))
    assert (six.count(" better in "), "more" in six) == (6, False)
    assert (seven.count(" better in "), " and 1 more. Friedman" in seven) == (6, True)


def test_p_is_corrected_for_all_comparisons_of_a_run() -> None:
    one, three = leading(1, 0), leading(1, 2)
    alone, among = (metric.methods[1].paired for metric in (one, three))
    assert alone is not None
    assert among is not None
    assert (alone.p_holm, among.p_holm) == (alone.p, pytest.approx(3 * alone.p))
    # In four rooms, no p is small enough.
    assert ["not" in leading(1, 0, n_rooms).lead for n_rooms in (12, 4)] == [False, True]


def test_methods_are_ranked_where_all_have_a_value() -> None:
    found = over({"a": [2.0] * 6, "b": [1.0] * 6, "c": [3.0, 3.0, 3.0, 3.0, 3.0, None]})
    assert found.ranks is not None
    assert (found.ranks.n, found.ranks.ranks) == (
        5,
        {"plane=b": 1.0, "plane=a": 2.0, "plane=c": 3.0},
    )
    assert over({"a": [2.0] * 6, "b": [1.0] * 6}).ranks is None
    assert over({name: [1.0] * 4 for name in "abc"}).ranks is None


def test_mean_ranks_are_those_of_a_worked_example() -> None:
    # Four methods on fourteen sets: Demsar 2006, Table 6 (AUC; more is better, so negative).
    auc = np.array(
        [
            [0.763, 0.768, 0.771, 0.798],
            [0.599, 0.591, 0.590, 0.569],
            [0.954, 0.971, 0.968, 0.967],
            [0.628, 0.661, 0.654, 0.657],
            [0.882, 0.888, 0.886, 0.898],
            [0.936, 0.931, 0.916, 0.931],
            [0.661, 0.668, 0.609, 0.685],
            [0.583, 0.583, 0.563, 0.625],
            [0.775, 0.838, 0.866, 0.875],
            [1.000, 1.000, 1.000, 1.000],
            [0.940, 0.962, 0.965, 0.962],
            [0.619, 0.666, 0.614, 0.669],
            [0.972, 0.981, 0.9751, 0.975],
            [0.957, 0.978, 0.946, 0.970],
        ]
    )
    found = mean_ranks(("C4.5", "+m", "+cf", "+m+cf"), -auc)
    assert found.n == 14
    assert found.ranks == {
        "+m+cf": pytest.approx(1.964, abs=0.01),
        "+m": pytest.approx(2.000, abs=0.01),
        "+cf": pytest.approx(2.893, abs=0.01),
        "C4.5": pytest.approx(3.143, abs=0.01),
    }
    assert found.critical_difference == pytest.approx(1.25, abs=0.01)
    assert 0.01 < found.p < 0.05
    assert found.leading == ("+m+cf", "+m", "+cf", "C4.5")


def test_differences_due_to_rounding_are_ties() -> None:
    for step in (0.0, 1e-14):
        level = mean_ranks(("a", "b", "c"), 1.0 + step * np.tile([1.0, 2.0, 3.0], (6, 1)))
        assert (level.p, level.leading) == (1.0, ("a", "b", "c"))
        assert set(level.ranks.values()) == {2.0}
    # Three of six rooms are tied: (3 * 2 + 3 * place) / 6; p is that of scipy with the ties.
    rooms = np.array([[1.0, 2.0, 3.0]] * 3 + [[4e-14, 5e-14, 6e-14]] * 3)
    half = mean_ranks(("a", "b", "c"), rooms)
    assert half.ranks == {"a": 1.5, "b": 2.0, "c": 2.5}
    assert half.p == pytest.approx(math.exp(-3.0))


def test_the_interval_of_a_median_covers_it_as_often_as_stated() -> None:
    rng = np.random.default_rng(5)
    for n, rate in ((6, 0.969), (20, 0.959)):
        drawn = rng.standard_normal((150, n))
        found = [paired_differences(row, "lower").interval for row in drawn]
        covered = np.mean([low <= 0.0 <= high for low, high in found])
        assert covered == pytest.approx(rate, abs=0.04)
    assert math.isnan(paired_differences(np.arange(5.0), "lower").interval[0])


# The report of a run on several datasets ----------------------------------------------------------


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


def rooms_run(folder: Path, rms_mm: dict[str, tuple[float, float | None]]) -> HeldRun:
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
    return rooms_run(tmp_path, RMS_MM)


def test_the_table_over_datasets_has_a_row_per_combination(tmp_path: Path) -> None:
    run = rooms_run(tmp_path, {"hall": (6.0, 1.0), "stairs": (3.0, 1.0), "attic": (4.0, None)})
    slow, quick = csv.DictReader(io.StringIO(paper_files(run)["datasets.csv"]))
    assert {row["metric"] for row in (slow, quick)} == {"rms_mm"}
    assert (slow["combination"], slow["median"], slow["pairs"]) == ("plane=slow", "4.0", "")
    wanted = ("datasets", "failed", "pairs", "wins", "losses", "median_difference", "p")
    # Unknown values, as p of two differences, are empty.
    assert [quick[name] for name in wanted] == ["2", "1", "2", "2", "0", "-3.5", ""]


def test_what_leads_over_datasets_is_stated_first(tmp_path: Path) -> None:
    run = rooms_run(tmp_path, {f"room{k}": (k + 2.0, k + 1.0 - 0.1 * k) for k in range(12)})
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


def test_no_method_leads_where_friedman_s_test_shows_no_difference() -> None:
    ranks = {"a": 1.0, "b": 2.0, "c": 3.0}
    for p, leading in (0.2, ("a", "b", "c")), (0.01, ("a",)):
        assert MeanRanks(n=6, ranks=ranks, p=p, critical_difference=0.5).leading == leading
