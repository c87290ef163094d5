"""Writing the page: the template filled with what the records say."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import jinja2
from markupsafe import Markup

from orthoflow import __version__
from orthoflow.errors import StoreError
from orthoflow.records import Run
from orthoflow.report.diagrams import run_diagram
from orthoflow.report.pictures import Picture, data_uri, orthoimage_pictures, wall_pictures
from orthoflow.report.summaries import (
    Answer,
    Comparison,
    PlaneTable,
    answers,
    comparisons,
    number,
    number_with_unit,
    plane_tables,
    warnings,
)


@dataclass(frozen=True, kw_only=True)
class _Section:
    """All that the template needs of one run."""

    run: Run
    answers: tuple[Answer, ...]
    warnings: tuple[tuple[str, str], ...]
    orthoimages: tuple[Picture, ...]
    walls: tuple[Picture, ...]
    planes: tuple[PlaneTable, ...]
    comparisons: tuple[Comparison, ...]
    figures: Mapping[str, tuple[Picture, ...]]
    diagram: Markup


def write_report(runs: Sequence[Run], path: Path) -> None:
    """Write one self-contained HTML file about one or more runs.

    Args:
        runs: opened with `orthoflow.open_run`.
        path: file to write; replaced as a whole, never half.

    Raises:
        StoreError: the file cannot be written.
        RecordError: a record is damaged.
    """
    text = _template().render(
        sections=[_section(run) for run in runs],
        title=", ".join(dict.fromkeys(run.record.name for run in runs)),
        version=__version__,
    )
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        aside.write_text(text, encoding="utf-8")
        aside.replace(path)
    except OSError as error:
        with suppress(OSError):
            aside.unlink()
        raise StoreError(
            f"the report {path} cannot be written: {error.strerror}; choose another place with -o"
        ) from error


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["number"] = number
    environment.filters["with_unit"] = number_with_unit
    source = files("orthoflow.report").joinpath("page.html.j2").read_text(encoding="utf-8")
    return environment.from_string(source)


def _section(run: Run) -> _Section:
    return _Section(
        run=run,
        answers=answers(run),
        warnings=warnings(run),
        orthoimages=tuple(orthoimage_pictures(run)),
        walls=tuple(wall_pictures(run)),
        planes=tuple(plane_tables(run)),
        comparisons=tuple(comparisons(run)),
        figures={
            address: tuple(
                Picture(
                    uri=data_uri(figure.data, figure.media_type),
                    title=figure.name.replace("_", " "),
                    caption=figure.caption,
                )
                for figure in cell.figures
            )
            for address, cell in run.cells.items()
            if cell.figures
        },
        # Built from escaped parts only.
        diagram=Markup(run_diagram(run)),
    )
