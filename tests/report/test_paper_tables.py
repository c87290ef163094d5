"""Tables and citations as a paper takes them."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest
from orthoflow_plugins.hooks import orthoflow_methods

from orthoflow.report.paper_tables import bibtex, paper_files
from tests.report_runs import compared_run


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return paper_files(compared_run(tmp_path_factory.mktemp("run")))


def test_a_tidy_table_has_a_row_per_value_with_unit_and_better_side(files: dict[str, str]) -> None:
    rows = list(csv.DictReader(io.StringIO(files["results.csv"])))
    [fine] = [row for row in rows if (row["plane"], row["metric"]) == ("fine", "rms_mm")]
    assert (fine["step"], fine["unit"], fine["better"]) == ("plane", "mm", "lower")
    assert (float(fine["value"]), int(fine["n_repeats"])) == (pytest.approx(1.1), 3)
    assert float(fine["standard_deviation"]) == pytest.approx(0.1)


def test_latex_and_markdown_have_the_same_numbers(files: dict[str, str]) -> None:
    assert r"1.10 $\pm$ 0.10" in files["results.tex"]
    # Names to the left, numbers to the right.
    assert r"\begin{tabular}{llrrr}" in files["results.tex"]
    assert "1.10 ± 0.10" in files["results.md"]
    body = files["results.tex"].partition(r"\midrule")[2].partition(r"\bottomrule")[0]
    assert {line.count("&") for line in body.splitlines() if line} == {4}
    # The name of the run is `toy <run>`, and a record may hold anything.
    assert "&lt;run>" in files["results.md"]
    assert "_" not in files["results.tex"].replace(r"\_", "")


def test_all_citations_of_the_methods_become_entries_with_author_and_year() -> None:
    texts = {text for spec in orthoflow_methods() for text in _citations(spec.target)}
    assert len(texts) > 10
    entries = bibtex({text: ["method"] for text in texts})
    assert entries.count("{") == entries.count("}")
    keys = [line for line in entries.splitlines() if line.startswith("@misc{")]
    # Standards and manuals have no year.
    assert len(keys) == len(set(keys)) == entries.count("  year = {") + 5
    assert entries.count("  author = {") == entries.count("  year = {")


def _citations(target: str) -> tuple[str, ...]:
    from importlib import import_module

    module, _, name = target.partition(":")
    found: tuple[str, ...] = getattr(import_module(module), name).citations
    return found


def test_one_paper_is_one_entry_and_signs_of_latex_mean_nothing() -> None:
    found = bibtex(
        {
            "A_b and C 2001, Title & more, doi:10.1/X": ["m.one: 3"],
            "A_b 2001, doi:10.1/x": ["m.two"],
            "no year at all": ["m.three"],
        }
    )
    assert found.count("@misc") == 2
    assert r"title = {Title \& more}" in found
    assert r"author = {A\_b and C}" in found
    assert "note = {m.one: 3; m.two}" in found
    assert "title = {no year at all}" in found


def test_of_a_run_without_datasets_there_is_no_table_over_them(
    files: dict[str, str], tmp_path: Path
) -> None:
    assert sorted(files) == ["citations.bib", "results.csv", "results.md", "results.tex"]
