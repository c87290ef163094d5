"""Words for metrics: all that our methods report are described, and no two names say the same."""

from __future__ import annotations

from pathlib import Path

import pytest
from orthoflow_provenance.document import Metric

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.records.metrics import cell_metrics
from orthoflow.report.combinations import combinations_of
from orthoflow.report.comparisons import comparison_columns
from orthoflow.report.metric_words import (
    WORDS,
    is_described,
    label_in_words,
    metric_words,
    words_of,
)
from orthoflow.report.rankings import Sense, sense_of
from orthoflow.report.summaries import QUALITY
from orthoflow.workflow.parameters import (
    describe_method,
)
from tests.report_runs import HeldRun, cell, metrics, record


def test_every_metric_of_ours_is_described() -> None:
    catalog = discover_catalog()
    declared = {
        name
        for method, entry in catalog.methods.items()
        if entry.distribution.name == "orthoflow-tls"
        for name in (one.name for one in describe_method(catalog, method).method.metric_specs())
    }
    assert len(declared) > 200
    assert {name for name in declared if not is_described(name)} == set()


def test_cards_and_tables_say_the_same() -> None:
    assert {name: metric_words(name) for name in QUALITY} == dict(QUALITY)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("rmse_u_mm", "error along u (right), RMS"),
        ("all_rmse_u_mm", "error along u (right), RMS; all walls"),
        ("wall_12_completeness", "painted or filled, of the scanned surface; wall 12"),
        ("raw_omega_deg", "direction of the first normal (omega); as voted, before the fit"),
        ("flat_rms_after_once_mm", "RMS without outliers, rule applied once; flat"),
        ("a_stranger_s", "a_stranger_s"),
        ("all_", "all_"),
        ("within_2_sigma", "distances to the first plane within two sigmas"),
        ("void_sparse_share", "cells beside scanned ones: gaps, shadows of relief, rims"),
        ("void_other_share", "cells without a depth, by cause"),
    ],
)
def test_prefixes_stand_behind_the_words(name: str, words: str) -> None:
    assert metric_words(name) == words


def test_a_unit_stands_behind_once_and_not_for_shares() -> None:
    reported = metrics(rmse_u_mm=1.0, strange_mm=1.0, n_planes=3.0)
    rows = cell_metrics(cell("check", metrics=reported))
    assert [label_in_words(row) for row in rows[:3]] == [
        *("error along u (right), RMS / mm", "strange_mm / mm", "planes found")
    ]


def test_words_tell_names_apart() -> None:
    said: dict[str, list[str]] = {}
    for name, words in WORDS.items():
        said.setdefault(words, []).append(name)
    alike = {tuple(names) for names in said.values() if len(names) > 1}
    # The same thing in another unit, and the same thing told by another method.
    assert alike == {
        ("rmse_x_mm", "rmse_x_cells"),
        ("rmse_y_mm", "rmse_y_cells"),
        ("side_rmse_mm", "side_rmse_cells"),
        ("true_planes", "n_true_planes"),
        ("megapixels", "photo_megapixels"),
        ("void_*_share", "empty*_share"),
    }


def test_a_stranger_names_metrics_and_their_good_side(tmp_path: Path) -> None:
    shares = ((0.5, "dry"), (0.1, "wet"))
    cells = [
        cell(
            f"damp@damp={name}",
            method="damp.simple",
            metrics=(
                Metric(name="n_patches", value=3.0, unit="1", label="damp patches"),
                Metric(
                    name="damp_share",
                    value=share,
                    unit="1",
                    label="damp",
                    better="lower",
                ),
                Metric(name="rms_mm", value=share, unit="mm"),
            ),
        )
        for share, name in shares
    ]
    columns = comparison_columns(combinations_of(HeldRun(path=tmp_path, record=record(cells))))
    assert [(one.label, one.sense) for one in columns] == [("damp", Sense.LESS)]
    first = cell_metrics(cells[0])
    assert [label_in_words(row) for row in first[:3]] == ["damp patches", "damp", "rms_mm / mm"]
    assert sense_of("n_patches", first[0]) is Sense.NEITHER
    # Of a kind of a stranger's, what ours of the same name are called would be false.
    assert words_of("n_patches", "moisture.simple") == "n_patches"
    assert words_of("n_patches", "inspect.truth") == "patches compared with the truth"
    # It counts painted cells only, on all walls.
    assert words_of("completeness", "inspect.surf") == "painted or filled, of the scanned surface"
    truth = "painted, not filled, of the surface that is seen at all; wall 3"
    assert words_of("wall_3_completeness", "inspect.truth") == truth


def test_a_good_side_that_nobody_knows_is_none() -> None:
    row = cell_metrics(
        cell("damp", metrics=(Metric(name="a_mm", value=1.0, unit="mm", label="a", better="odd"),))
    )[0]
    assert sense_of("a_mm", row) is Sense.NEITHER
