"""The pictures that methods drew: on the page, bounded in bytes, and as files of the run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

from orthoflow.errors import InputError
from orthoflow.files.images import decode_image, encode_pdf, encode_png, shrunk_webp
from orthoflow.geometry.threads import in_order
from orthoflow.records import RecordedFigure
from orthoflow.records.runs import FIGURES_FOLDER, GRAPH_FILE, Run, figure_files, write_files
from orthoflow.report.combinations import baseline_addresses
from orthoflow.report.diagrams import graph_file
from orthoflow.report.pictures import LONGEST_SIDE_PX, Picture, data_uri
from orthoflow.untrusted_text import is_plain_svg

_BYTES_MOST: Final = 3_900_000  # of all figures on a page; a third more in base64
_LEAST_SIDE_PX: Final = 240
_MAX_SIDE_PX: Final = 700
_DPI: Final = 300
_SMALL_BYTES: Final = 20_000  # not worth drawing again


@dataclass(frozen=True, kw_only=True)
class FigureGroup:
    """The figures of one cell."""

    cell: str
    method: str
    pictures: tuple[Picture, ...]


def figure_groups(
    run: Run, *, share: float = 1.0, with_files: bool = False
) -> tuple[FigureGroup, ...]:
    """The figures of every cell, repeats of random methods left out; equal ones once.

    When they are too many for a page, the large ones are drawn smaller.

    Args:
        run: the run.
        share: which part of a page's bytes they may take.
        with_files: those of `baseline_addresses` lie in `FIGURES_FOLDER` beside the page.
    """
    named = figure_files(run, baseline_addresses(run)) if with_files else {}
    files = {id(figure): path for path, figure in named.items()}
    chosen: dict[tuple[str, str], RecordedFigure] = {}
    seen: set[bytes] = set()
    for address, cell in run.cells.items():
        for figure in cell.figures if cell.repeat == 0 else ():
            if figure.data not in seen:
                seen.add(figure.data)
                chosen[address, figure.name] = figure
    fitted = dict(zip(chosen, _fitted(tuple(chosen.values()), share * _BYTES_MOST), strict=True))
    groups = []
    for address, cell in run.cells.items():
        pictures = tuple(
            Picture(
                uri=data_uri(figure.data, figure.media_type),
                title=figure.name.replace("_", " "),
                caption=figure.caption,
                file=(
                    f"{FIGURES_FOLDER}/{files[id(chosen[owner, name])]}"
                    if id(chosen[owner, name]) in files
                    else ""
                ),
                cell=address,
            )
            for (owner, name), figure in fitted.items()
            if owner == address
        )
        if pictures:
            groups.append(FigureGroup(cell=address, method=cell.method, pictures=pictures))
    return tuple(groups)


def write_figures(
    run: Run, folder: Path, addresses: Iterable[str], *, inside: str = "", as_pdf: bool = False
) -> int:
    """Write the figures of cells as PNG or SVG files below `folder/<cell>/`, and the run's graph.

    A picture that is damaged has no file, nor has an SVG one in which a browser would run or load
    something.

    Args:
        run: the run.
        folder: made when missing.
        addresses: of the cells.
        inside: a folder in it that takes the place of `folder`; it must be no link.
        as_pdf: pictures as a page of a PDF each, 300 dpi.

    Returns:
        How many figures were written.

    Raises:
        RecordError: a figure has a name or a type that no file can have; nothing is written.
        StoreError: the folder cannot be written.
    """
    named = figure_files(run, addresses)
    contents: dict[str, Callable[[], bytes | None]] = {GRAPH_FILE: partial(graph_file, run)}
    for path, figure in named.items():
        is_pdf = as_pdf and figure.media_type != "image/svg+xml"
        name = f"{path.rpartition('.')[0]}.pdf" if is_pdf else path
        contents[name] = partial(_content, figure, as_pdf=is_pdf)
    way = f"{inside}/" if inside else ""
    written = write_files(folder, {f"{way}{path}": content for path, content in contents.items()})
    return written - 1


def _content(figure: RecordedFigure, *, as_pdf: bool) -> bytes | None:
    """The bytes of a figure's file; None for one that is damaged, or more than a drawing."""
    if figure.media_type == "image/svg+xml":
        return figure.data if is_plain_svg(figure.data) else None
    try:
        if as_pdf:
            return encode_pdf(decode_image(figure.data, figure.name), dpi=_DPI)
        # PNG is what papers and word processors take.
        if figure.media_type == "image/webp":
            return encode_png(decode_image(figure.data, figure.name))
    except InputError:
        return None
    return figure.data


def _fitted(figures: tuple[RecordedFigure, ...], bytes_most: float) -> Iterable[RecordedFigure]:
    """Figures as they are or, where all are too many bytes, drawn smaller."""
    n_bytes = sum(len(figure.data) for figure in figures)
    if n_bytes <= bytes_most:
        return figures
    # Bytes go about with the area.
    side_px = round(LONGEST_SIDE_PX * math.sqrt(0.8 * max(0.0, bytes_most) / n_bytes))
    side_px = min(max(side_px, _LEAST_SIDE_PX), _MAX_SIDE_PX)
    return tuple(in_order(partial(_smaller, side_px=side_px), figures))


def _smaller(figure: RecordedFigure, side_px: int) -> RecordedFigure:
    if figure.media_type == "image/svg+xml" or len(figure.data) <= _SMALL_BYTES:
        return figure
    try:
        data = shrunk_webp(figure.data, figure.name, longest_side_px=side_px)
    except InputError:
        # A picture that cannot be decoded costs its place on the page, not the page.
        return replace(figure, data=b"", caption=f"{figure.caption} (the picture is damaged)")
    if len(data) >= len(figure.data):
        return figure
    return RecordedFigure(
        name=figure.name, caption=figure.caption, media_type="image/webp", data=data
    )
