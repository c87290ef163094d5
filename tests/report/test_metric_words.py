"""Words for metrics: all that our methods report are described, and no two names say the same."""

from __future__ import annotations

from pathlib import Path

import pytest

import orthoflow.report.metric_words as metric_words_module
from orthoflow.catalog import discover_catalog
from orthoflow.report.combinations import combinations_of
from orthoflow.report.comparisons import comparison_columns
from orthoflow.report.metric_words import (
    WORDS,
    is_described,
    label_in_words,
    metric_words,
    words_of,
)
from orthoflow.report.rankings import Sense
from orthoflow.report.summaries import QUALITY
from orthoflow.workflow.methods import describe_method
from tests.laboratories import write_distribution
from tests.report_runs import HeldRun, cell, metrics, record


def test_every_metric_of_ours_is_described() -> None:
    catalog = discover_catalog()
    declared = {
        name
        for method, entry in catalog.methods.items()
        if entry.distribution.name == "orthoflow-tls"
        for name in describe_method(catalog, method).method.metrics
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
        ("wall_12_completeness", "share of the visible cells that is painted; wall 12"),
        ("raw_omega_deg", "direction of the first normal (omega); as voted, before the fit"),
        ("flat_rms_after_once_mm", "RMS without outliers, rule applied once; flat"),
        ("a_stranger_s", "a_stranger_s"),
        ("all_", "all_"),
    ],
)
def test_prefixes_stand_behind_the_words(name: str, words: str) -> None:
    assert metric_words(name) == words


def test_a_unit_stands_behind_once_and_not_for_shares() -> None:
    assert label_in_words("rmse_u_mm", "mm", "inspect.truth") == "error along u (right), RMS / mm"
    assert label_in_words("strange_mm", "mm", "inspect.truth") == "strange_mm / mm"
    assert label_in_words("n_planes", "1", "plane.toy") == "planes found"


def test_words_tell_names_apart() -> None:
    said: dict[str, list[str]] = {}
    for name, words in WORDS.items():
        said.setdefault(words, []).append(name)
    alike = {tuple(names) for names in said.values() if len(names) > 1}
    # The same thing in another unit, and the same thing told by another method.
    assert alike == {
        ("ghost_share", "n_ghost_cells"),
        ("n_rejected", "rejected_share"),
        ("rmse_x_mm", "rmse_x_cells"),
        ("rmse_y_mm", "rmse_y_cells"),
        ("side_rmse_mm", "side_rmse_cells"),
        ("true_planes", "n_true_planes"),
        ("megapixels", "photo_megapixels"),
        ("void_*_share", "empty*_share"),
    }


MOISTURE = """
from orthoflow.sdk import Method, MethodParams, MetricLabel, Ports


class Damp(Method):
    id = "damp.simple"
    Params = MethodParams

    class In(Ports):
        cloud: "PointCloud"

    class Out(Ports):
        planes: "Planes"

    metric_labels = {
        "n_patches": MetricLabel(words="damp patches"),
        "damp_share": MetricLabel(words="share that is damp", good="less"),
    }

    def run(self, inputs, params, ctx):
        raise NotImplementedError


from orthoflow.products import Planes, PointCloud
"""
HOOKS = """
from orthoflow.sdk.hooks import KindSpec, MethodSpec, hookimpl


@hookimpl
def orthoflow_kinds():
    ports = {"inputs": {"cloud": "cloud"}, "outputs": {"planes": "planes"}}
    return [KindSpec(name="damp", summary="-", **ports)]


@hookimpl
def orthoflow_methods():
    return [MethodSpec(id="damp.simple", target="damp_method:Damp", summary="-")]
"""


def test_a_stranger_names_metrics_and_their_good_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = {"damp_hooks.py": HOOKS, "damp_method.py": MOISTURE}
    monkeypatch.syspath_prepend(write_distribution(tmp_path, "damp", sources))
    metric_words_module._catalog.cache_clear()
    metric_words_module._declared.cache_clear()
    shares = ((0.5, "dry"), (0.1, "wet"))
    cells = [
        cell(
            f"damp@damp={name}",
            method="damp.simple",
            metrics=metrics(n_patches=3.0, damp_share=share, rms_mm=share),
        )
        for share, name in shares
    ]
    columns = comparison_columns(combinations_of(HeldRun(path=tmp_path, record=record(cells))))
    metric_words_module._catalog.cache_clear()
    metric_words_module._declared.cache_clear()
    assert [(one.label, one.sense) for one in columns] == [("share that is damp", Sense.LESS)]
    # Of a kind of a stranger's, what ours of the same name are called would be false.
    assert words_of("n_patches", "moisture.simple") == "n_patches"
    assert words_of("n_patches", "inspect.truth") == "patches compared with the truth"
