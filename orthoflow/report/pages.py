"""Generation of report pages from templates and records."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

from orthoflow.engine.durability import write_whole
from orthoflow.products import Cameras
from orthoflow.records.compare import compare_runs
from orthoflow.records.runs import (
    FIGURES_FOLDER,
    METRICS_FILE,
    PRODUCTS_FOLDER,
    Run,
    figure_files,
    pages_of,
    parts_of,
    write_files,
)
from orthoflow.records.seals import sealed_page
from orthoflow.records.tables import common_points
from orthoflow.records.walls import delivered_walls, uncounted_points
from orthoflow.report.combinations import (
    baseline_addresses,
    baseline_cells,
    improved_on,
    is_missing,
    ways,
)
from orthoflow.report.comparisons import comparison_table, dataset_table
from orthoflow.report.curves import curves
from orthoflow.report.differences import differences
from orthoflow.report.figures import figure_groups, graph_picture, write_figures
from orthoflow.report.overlays import overlays
from orthoflow.report.paired import over_datasets, over_table, who_leads
from orthoflow.report.photo_plans import photo_plan
from orthoflow.report.pictures import (
    cursor_places,
    orthoimage_pictures,
    products_of,
    sliders,
    wall_pictures,
)
from orthoflow.report.rendering import environment
from orthoflow.report.summaries import answers, citations, has_measured_lengths, limits, results
from orthoflow.report.tables import plane_tables

if TYPE_CHECKING:
    from orthoflow.engine.store import Store

# These columns of the statistics over all datasets are shown on the page.
_OVER_SHOWN: Final = (
    *("combination", "datasets", "failed", "absent", "partly", "median", "spread"),
    *(
        "repeat_spread",
        "reference",
        "pairs",
        "wins",
        "losses",
        "median_difference",
        "interval_low",
        "interval_high",
    ),
    *("p", "p_holm", "effect"),
)
_NONE_BROKEN: Final[Mapping[Path, str]] = MappingProxyType({})


def _part(every: Mapping[str, Sequence[Any]], addresses: Collection[str]) -> SimpleNamespace:
    return SimpleNamespace(
        **{
            kind: [one for one in ones if (getattr(one, "cell", "") or one.address) in addresses]
            for kind, ones in every.items()
        }
    )


def write_page(
    run: Run,
    path: Path,
    *,
    go_on: str = "",
    broken_seals: Mapping[Path, str] = _NONE_BROKEN,
    note: Callable[[str], None] = lambda _: None,
) -> None:
    """Write the report of one run, and its figures as image files in `figures/` next to it.

    If the run has variants, only the figures of the baseline are written; `write_figures` writes
    the figures of any cell. If the run has several datasets, the main page links to a page for each
    dataset in `pages/`.

    Args:
        run: the run.
        path: output file.
        go_on: command that resumes the run if it was interrupted.
        broken_seals: record -> reason why its seal is broken.
        note: function that is called with the name of each part of the report before it is written.

    Raises:
        StoreError: a file cannot be written.
        RecordError: the record is damaged, or the name of a figure is not allowed as a file name.
    """
    addresses = baseline_addresses(run)
    # Check the names first, so that no page is written if a name is invalid.
    figure_files(run, addresses)
    pages = pages_of(run)
    with run.held_open() as opened:
        parts = parts_of(opened)
        for number, (name, page) in enumerate(pages.items(), start=1):
            note(f"writing the page of {name}, {number} of {len(pages)}")
            folder = (path.parent / page).parent
            section = _section(parts[name], "r1-", folder, broken_seals)
            section.title, section.whole = f"{run.record.name}: {name}", f"../{path.name}"
            content = _content([parts[name]], [section], section.title)
            write_files(path.parent, {page: partial(bytes, content)})
        note("writing the report")
        if pages:
            section = _overview(opened, "r1-", path.parent, pages)
        else:
            section = _section(opened, "r1-", path.parent, broken_seals, with_files=True)
        write_whole(path, _content([opened], [section], run.record.name, go_on=go_on))
    write_figures(run, path.parent, addresses, inside=FIGURES_FOLDER)


def write_report(
    runs: Sequence[Run],
    path: Path,
    *,
    go_on: str = "",
    broken_seals: Mapping[Path, str] = _NONE_BROKEN,
    stores: Sequence[Store] = (),
) -> None:
    """Write a self-contained HTML file about one or more runs.

    Args:
        runs: runs opened with `orthoflow.open_run`; for two runs, the page also lists their
            differences.
        path: output file, which is replaced atomically.
        go_on: command that resumes the run if it was interrupted.
        broken_seals: record -> reason why its seal is broken.
        stores: stores with products that the records of two compared runs reference but do not
            contain.

    Raises:
        StoreError: the file cannot be written.
        RecordError: a record is damaged.
    """
    sections = [
        _overview(run, f"r{index}-", path.parent, {})
        if pages_of(run)
        else _section(run, f"r{index}-", path.parent, broken_seals, share=1 / len(runs))
        for index, run in enumerate(runs, start=1)
    ]
    title = ", ".join(dict.fromkeys(run.record.name for run in runs))
    write_whole(path, _content(runs, sections, title, go_on=go_on, stores=stores))


def _content(
    runs: Sequence[Run],
    sections: Sequence[SimpleNamespace],
    title: str,
    *,
    go_on: str = "",
    stores: Sequence[Store] = (),
) -> bytes:
    compared = compare_runs(*runs, stores=stores) if len(runs) == 2 else None
    text = (
        environment()
        .get_template("page.html.j2")
        .render(
            sections=sections,
            comparison_of_all=comparison_table(runs) if len(runs) > 1 else None,
            compared=compared,
            differences=differences(compared) if compared else (),
            title=title,
            go_on=go_on,
        )
    )
    return sealed_page(text, runs).encode("utf-8")


def _overview(run: Run, prefix: str, folder: Path, pages: Mapping[str, str]) -> SimpleNamespace:
    """Return the data for the template of a run whose datasets have their own pages.

    Args:
        run: the run.
        prefix: prefix of the HTML anchors.
        folder: folder of the page.
        pages: dataset -> path of its page; empty if datasets have no pages.
    """
    parts = parts_of(run)
    over = over_datasets(parts)
    section = _section(replace(run, record=replace(run.record, cells=())), prefix, folder)
    vars(section).update(
        run=run,
        limits=limits(run),
        results=results(run),
        diagram=graph_picture(next(iter(parts.values()))),
        citations=citations(run),
        datasets=dataset_table(parts, pages),
        curves=curves([*parts.values()]),
        over=[(one, over_table([one]).only(*_OVER_SHOWN)) for one in over],
        leads=who_leads(over, len(parts)),
    )
    return section


def _section(
    run: Run,
    prefix: str,
    folder: Path,
    broken_seals: Mapping[Path, str] = _NONE_BROKEN,
    *,
    share: float = 1.0,
    with_files: bool = False,
) -> SimpleNamespace:
    """Return the data for the template of one run.

    Args:
        run: the run.
        prefix: prefix of the HTML anchors.
        folder: folder of the page; paths of files are relative to it.
        broken_seals: record -> reason why its seal is broken.
        share: the part of a page's size limit that pictures may use, from 0 to 1.
        with_files: whether files of the figures are written next to the page.
    """
    from_page = Path(os.path.relpath(run.folder, folder))
    # Pictures of the baseline come first, because the metrics shown next to them are those of the
    # baseline.
    baseline = {cell.address for cell in baseline_cells(run)}
    orthoimages, walls = (
        sorted(pictures(run, share=share), key=lambda picture: picture.cell not in baseline)
        for pictures in (orthoimage_pictures, wall_pictures)
    )
    numbered = [
        replace(
            picture,
            id=f"{prefix}picture-{index}",
            file=(from_page / picture.file).as_posix() if picture.file else "",
        )
        for index, picture in enumerate([*orthoimages, *walls])
    ]
    orthoimages, walls = numbered[: len(orthoimages)], numbered[len(orthoimages) :]
    every: dict[str, Sequence[Any]] = {
        "cells": [cell for cell in run.record.cells if cell.repeat == 0],
        "orthoimages": orthoimages,
        "walls": walls,
        "overlays": list(overlays(run, walls, share=share)),
        "planes": plane_tables(run),
        "figures": figure_groups(run, share=share, with_files=with_files),
    }
    main = baseline_addresses(run)
    shown = _part(every, main)
    is_measured = has_measured_lengths(run)
    comparison = comparison_table([run])
    photographed = [product for _, product in products_of(run, Cameras)]
    return SimpleNamespace(
        run=run,
        prefix=prefix,
        title=run.record.name,
        whole="",
        broken=broken_seals.get(run.path, ""),
        answers=answers(run),
        is_measured=is_measured,
        is_unfinished=any(is_missing(cell) for cell in run.record.cells),
        uncounted=uncounted_points(run) if shown.orthoimages and not is_measured else None,
        limits=limits(run),
        delivered=delivered_walls(run.folder / PRODUCTS_FOLDER) if shown.orthoimages else (),
        results=results(run),
        comparison=comparison,
        curves=curves([run]) if comparison else (),
        common_points=common_points(run) if comparison else (),
        main=shown,
        earlier=improved_on(run, main),
        ways=[(way, _part(every, way.cells)) for way in ways(run, prefix)] if comparison else [],
        sliders=sliders(numbered, len(orthoimages)),
        places=cursor_places(orthoimages, walls),
        photos=sorted({camera.photo for one in photographed for camera in one.cameras}),
        plan=photo_plan(run, walls),
        diagram=graph_picture(run),
        record_file=(from_page / run.file_name).as_posix(),
        citations=citations(run),
        files=_files(run, from_page),
        datasets=None,
        over=(),
        leads="",
    )


def _files(run: Run, from_page: Path) -> Mapping[str, Mapping[str, str]]:
    published = {file.path for file in run.record.published}
    found: dict[str, dict[str, str]] = defaultdict(dict)
    for address, paths in run.files.items():
        for path in paths:
            if path.name != METRICS_FILE and path.relative_to(run.folder).as_posix() in published:
                place = from_page / PRODUCTS_FOLDER / path.parent.name / path.name
                found[address][path.name] = place.as_posix()
    return found
