"""Tables and citations for publications, as CSV, LaTeX, Markdown and BibTeX."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from orthoflow.records.runs import Run, parts_of
from orthoflow.report.combinations import Combination, combinations_of
from orthoflow.report.comparisons import comparison_columns, measured_text
from orthoflow.report.paired import over_datasets, over_table
from orthoflow.report.summaries import citations
from orthoflow.report.tables import Column, Table, escaped_latex
from orthoflow.untrusted_text import shown
from orthoflow.workflow.model import DATA

# If there are more combinations, the table shows them as rows instead of columns.
_FEW_COMBINATIONS: Final = 4
# An example is `Hoehle and Hoehle 2009, title, doi:10.1016/...`; only authors and year are
# required.
_CITATION: Final = re.compile(
    r"(?P<authors>[^\d]+?),? (?P<year>(?:19|20)\d\d)\b[,:]?\s*(?P<rest>.*)"
)
_DOI: Final = re.compile(r",?\s*doi:\s*(\S+?)[.,;]?(?=\s|$)")
_URL: Final = re.compile(r",?\s*(https?://\S+)")


def paper_files(run: Run) -> dict[str, str]:
    """Return file name -> content for a publication about a run.

    The LaTeX and Markdown tables `results` contain the metrics that the comparison selects, by
    default the headline metrics; `results.csv` contains one row per value, with all digits. If
    there are several datasets, `datasets` contains the statistics over them.
    """
    files = {"results.csv": _values(run).csv()}
    tables = [_results(run)]
    if over := over_datasets(parts_of(run)):
        files["datasets.csv"] = over_table(over).csv()
        names = ("label", "better", "combination", "datasets", "median", "median_difference")
        tables.append(over_table(over).only(*names, "interval_low", "interval_high", "p_holm"))
    for table in tables:
        files[f"{table.name}.tex"] = table.latex()
        files[f"{table.name}.md"] = table.markdown()
    files["citations.bib"] = bibtex(citations(run))
    return files


def _values(run: Run) -> Table:
    columns = comparison_columns(combinations := combinations_of(run))
    factors = _factors(combinations)
    names = (
        *(factor if factor != DATA else "dataset" for factor in factors),
        *("step", "metric", "label", "unit", "better", "value", "standard_deviation", "n_repeats"),
    )
    return Table(
        name="results",
        caption="",
        columns=tuple(Column(name, name) for name in names),
        rows=tuple(
            (
                *(one.assignment.get(factor, "") for factor in factors),
                *(column.step, column.metric, column.titled, column.unit, column.better),
                measured.value,
                None if math.isnan(measured.spread) else measured.spread,
                measured.n_repeats,
            )
            for one in combinations
            for column in columns
            if (measured := one.measured(column.step, column.metric))
        ),
    )


def _results(run: Run) -> Table:
    columns = comparison_columns(combinations := combinations_of(run))
    factors = _factors(combinations)
    texts = [
        [
            measured_text(value) if (value := one.measured(column.step, column.metric)) else None
            for column in columns
        ]
        for one in combinations
    ]
    repeated = any(cell.repeat for one in combinations for cell in one.cells)
    spread = ", mean and standard deviation of the repeats" if repeated else ""
    caption = f"Results of {run.record.name} (run {run.record.run_id}){spread}."
    titles = [f"{column.step}: {column.titled}" for column in columns]
    if len(combinations) <= _FEW_COMBINATIONS:
        return Table(
            name="results",
            caption=caption,
            columns=(
                *(Column(label, is_numeric=False) for label in ("metric", "better")),
                *(Column(one.name or "value") for one in combinations),
            ),
            rows=tuple(
                (title, column.better or None, *values)
                for title, column, *values in zip(titles, columns, *texts, strict=True)
            ),
        )
    return Table(
        name="results",
        caption=caption,
        columns=(
            *(
                Column("dataset" if factor == DATA else factor, is_numeric=False)
                for factor in factors
            ),
            *(
                Column(f"{title} ({column.better} is better)" if column.better else title)
                for title, column in zip(titles, columns, strict=True)
            ),
        ),
        rows=tuple(
            (*(one.assignment.get(factor) for factor in factors), *values)
            for one, values in zip(combinations, texts, strict=True)
        ),
    )


def _factors(combinations: Iterable[Combination]) -> tuple[str, ...]:
    found = dict.fromkeys(step for one in combinations for step in one.assignment)
    return tuple(sorted(found, key=lambda factor: factor != DATA))


def bibtex(cited: Mapping[str, Sequence[str]]) -> str:
    """Format citations as BibTeX entries, with notes on the methods that use the source.

    Args:
        cited: citation -> methods, each with the part of the source that it uses.

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
            # DOIs and URLs must not be escaped.
            f"  {name} = {{{value if name in ('doi', 'url') else escaped_latex(value)}}},"
            for name, value in fields.items()
            if value
        ]
        entries.append("\n".join((f"@misc{{{key}{suffix},", *lines, "}", "")))
    return "\n".join(entries)


def _once(cited: Mapping[str, Sequence[str]]) -> list[dict[str, str]]:
    """Return the fields of each entry; citations with the same DOI are merged into one entry."""
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
