"""Tables and citations of a run as a paper takes them: CSV, LaTeX, Markdown and BibTeX."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from orthoflow.records.runs import MetricRow, Run, parts_of
from orthoflow.report.combinations import Combination, Measured, combinations_of
from orthoflow.report.comparisons import comparison_columns
from orthoflow.report.numbers import number, number_with_spread
from orthoflow.report.paired import MetricOverDatasets, over_datasets
from orthoflow.report.summaries import citations
from orthoflow.report.tables import Table, escaped_latex
from orthoflow.untrusted_text import Value, csv_text, shown
from orthoflow.workflow.model import DATA

# More stand below each other.
_FEW_COMBINATIONS: Final = 4
# `Hoehle and Hoehle 2009, title, doi:10.1016/...`: of which only authors and year are certain.
_CITATION: Final = re.compile(
    r"(?P<authors>[^\d]+?),? (?P<year>(?:19|20)\d\d)\b[,:]?\s*(?P<rest>.*)"
)
_DOI: Final = re.compile(r",?\s*doi:\s*(\S+?)[.,;]?(?=\s|$)")
_URL: Final = re.compile(r",?\s*(https?://\S+)")


def paper_files(run: Run) -> dict[str, str]:
    """Return the files of a run for a paper, by name.

    `results` has a row per combination and dataset with the metrics that the comparison asks for,
    or else the headlines; `datasets` what holds over all datasets, where there are several; the
    CSV files have every digit, a row per value.
    """
    files = {"results.csv": csv_text([*_tidy(run)])}
    tables = [_results(run)]
    if over := over_datasets(parts_of(run)):
        tables.append(_over(over))
    for table in tables:
        files[f"{table.name}.tex"] = table.latex()
        files[f"{table.name}.md"] = table.markdown()
    files["citations.bib"] = bibtex(citations(run))
    return files


def _tidy(run: Run) -> Iterator[Sequence[Value]]:
    """Return a header, then a row per combination and metric, with unit and better side."""
    combinations, columns = _compared(run)
    factors = _factors(combinations)
    yield (
        *(factor if factor != DATA else "dataset" for factor in factors),
        *("step", "metric", "label", "unit", "better", "value", "standard_deviation", "n_repeats"),
    )
    for one in combinations:
        for column in columns:
            if measured := one.measured(column.step, column.metric):
                spread = None if math.isnan(measured.spread) else measured.spread
                yield (
                    *(one.assignment.get(factor, "") for factor in factors),
                    *(column.step, column.metric, column.titled, column.unit),
                    *(column.better, measured.value, spread, measured.n_repeats),
                )


def _results(run: Run) -> Table:
    """The comparison: metrics as rows where combinations are few, combinations as rows else."""
    combinations, columns = _compared(run)
    factors = _factors(combinations)
    found = [
        [one.measured(column.step, column.metric) for column in columns] for one in combinations
    ]
    repeated = any(value is not None and value.n_repeats > 1 for row in found for value in row)
    spread = ", mean and standard deviation of the repeats" if repeated else ""
    caption = f"Results of {run.record.name} (run {run.record.run_id}){spread}."
    texts = [[_value(value) for value in row] for row in found]
    if len(combinations) <= _FEW_COMBINATIONS:
        names = [one.name or "value" for one in combinations]
        return Table(
            name="results",
            caption=caption,
            head=("metric", "better", *names),
            rows=tuple(
                (f"{column.step}: {column.titled}", column.better or "--", *values)
                for column, *values in zip(columns, *texts, strict=True)
            ),
            numeric=frozenset(range(2, 2 + len(combinations))),
        )
    return Table(
        name="results",
        caption=caption,
        head=(
            *("dataset" if factor == DATA else factor for factor in factors),
            *(_heading(column) for column in columns),
        ),
        rows=tuple(
            (*(one.assignment.get(factor, "--") for factor in factors), *values)
            for one, values in zip(combinations, texts, strict=True)
        ),
        numeric=frozenset(range(len(factors), len(factors) + len(columns))),
    )


def _value(measured: Measured | None) -> str:
    if measured is None:
        return "--"
    if measured.n_repeats > 1:
        return number_with_spread(measured.value, measured.spread)
    return number(measured.value)


def _over(over: Sequence[MetricOverDatasets]) -> Table:
    def text(value: float, significant: int = 4) -> str:
        return "--" if math.isnan(value) else number(value, significant=significant)

    rows = []
    for metric in over:
        for one in metric.distinct:
            paired = one.paired
            statistics_of = ["--"] * 3
            if paired is not None:
                low, high = (text(edge, 3) for edge in paired.interval)
                interval = "--" if "--" in (low, high) else f"{low} to {high}"
                statistics_of = [text(paired.median, 3), interval, text(paired.p_holm, 2)]
            name = f"{metric.column.step}: {metric.column.titled}"
            rows.append(
                (
                    name,
                    metric.column.better or "--",
                    one.name or "all",
                    str(one.n),
                    text(one.median),
                    *statistics_of,
                )
            )
    return Table(
        name="datasets",
        caption="Medians over the datasets, median differences from the reference with their 95 % "
        "confidence intervals, and p of Wilcoxon's signed-rank test after Holm's correction.",
        head=(
            *("metric", "better", "combination", "datasets", "median", "difference"),
            *("95 % interval", "p (Holm)"),
        ),
        rows=tuple(rows),
        numeric=frozenset(range(3, 8)),
    )


def _compared(run: Run) -> tuple[tuple[Combination, ...], tuple[MetricRow, ...]]:
    combinations = combinations_of(run)
    return combinations, comparison_columns(combinations)


def _factors(combinations: Iterable[Combination]) -> tuple[str, ...]:
    """Names of what varies, the dataset first."""
    found = dict.fromkeys(step for one in combinations for step in one.assignment)
    return tuple(sorted(found, key=lambda factor: factor != DATA))


def _heading(column: MetricRow) -> str:
    better = f" ({column.better} is better)" if column.better else ""
    return f"{column.step}: {column.titled}{better}"


def bibtex(cited: Mapping[str, Sequence[str]]) -> str:
    """Return citations as BibTeX entries, each with the methods that ask for it.

    Args:
        cited: text -> methods, with what each takes of it.

    >>> print(bibtex({"Gruen 1985, Adaptive matching, doi:10.1/x": ["inspect.surf"]}), end="")
    @misc{gruen1985,
      author = {Gruen},
      year = {1985},
      title = {Adaptive matching},
      doi = {10.1/x},
      note = {inspect.surf},
    }
    """
    keys: dict[str, int] = {}
    entries = []
    for fields in _once(cited):
        first = re.sub(r"[^a-z]", "", fields.get("author", "").split(" ")[0].lower()) or "cited"
        key = f"{first}{fields.get('year', '')}"
        keys[key] = keys.get(key, -1) + 1
        suffix = chr(ord("a") + keys[key]) if keys[key] else ""
        lines = [
            # A DOI and an address are taken as they are.
            f"  {name} = {{{value if name in ('doi', 'url') else escaped_latex(value)}}},"
            for name, value in fields.items()
            if value
        ]
        entries.append("\n".join((f"@misc{{{key}{suffix},", *lines, "}", "")))
    return "\n".join(entries)


def _once(cited: Mapping[str, Sequence[str]]) -> list[dict[str, str]]:
    """Fields of each entry; texts with one DOI are one, with the longest title of them."""
    found: dict[str, dict[str, str]] = {}
    for text, methods in cited.items():
        fields = {**_fields(" ".join(shown(text).split())), "note": "; ".join(methods)}
        same = found.setdefault(fields.get("doi", "").lower() or text, fields)
        if same is not fields:
            same["note"] = f"{same['note']}; {fields['note']}"
            same["title"] = max(same.get("title", ""), fields.get("title", ""), key=len)
    return list(found.values())


def _fields(text: str) -> dict[str, str]:
    found = _CITATION.fullmatch(text)
    if found is None:
        return {"title": text}
    rest, fields = found["rest"], {}
    for name, pattern in (("doi", _DOI), ("url", _URL)):
        if place := pattern.search(rest):
            fields[name] = re.sub(r"[{}\\]", "", place[1])
            rest = rest[: place.start()] + rest[place.end() :]
    authors = re.split(r",\s*(?:and\s+)?|\s+and\s+", found["authors"])
    return {
        "author": " and ".join(author for author in authors if author),
        "year": found["year"],
        "title": rest.strip(" ,;"),
        **fields,
    }
