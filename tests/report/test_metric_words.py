"""Words for metrics: all that our methods report are described, and no two names say the same."""

from __future__ import annotations

import pytest

from orthoflow.catalog import discover_catalog
from orthoflow.report.metric_words import WORDS, is_described, label_in_words, metric_words
from orthoflow.report.summaries import QUALITY
from orthoflow.workflow.methods import describe_method


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
    assert label_in_words("rmse_u_mm", "mm") == "error along u (right), RMS / mm"
    assert label_in_words("strange_mm", "mm") == "strange_mm / mm"
    assert label_in_words("n_planes", "1") == "planes found"


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
