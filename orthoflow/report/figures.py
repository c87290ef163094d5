"""Figures that methods drew, on the page and as files, and the graph of a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from markupsafe import Markup

from orthoflow.errors import InputError
from orthoflow.files.images import decode_image, encode_pdf, encode_png, shrunk_webp
from orthoflow.geometry.threads import in_order
from orthoflow.records import RecordedCell, RecordedFigure
from orthoflow.records.runs import FIGURES_FOLDER, GRAPH_FILE, Run, figure_files, write_files
from orthoflow.report.charts import as_image
from orthoflow.report.combinations import baseline_addresses
from orthoflow.report.pictures import LONGEST_SIDE_PX, Picture, data_uri
from orthoflow.report.rankings import seconds_in_words
from orthoflow.report.rendering import environment
from orthoflow.untrusted_text import shown

if TYPE_CHECKING:
    import networkx as nx

_MAX_ABREAST: Final = 5  # boxes in a row
_MAX_LETTERS: Final = 26
_SPACING_PT: Final = (132.0, 46.8)  # of the middles of boxes
_BOX_PT: Final = (102.0, 26.0)
# The states can be distinguished without colour, by line width and dashes.
_FRAMES: Final = {
    "ok": Markup('stroke="#5b6570" fill="#f3f5f7"'),
    "cached": Markup('stroke="#1c6b35" fill="#eaf5ec"'),
    "failed": Markup('stroke="#a11616" fill="#fbeaea" stroke-width="2"'),
    "skipped": Markup('stroke="#5b6570" fill="white" stroke-dasharray="4 2"'),
}


def run_graph(run: Run) -> nx.DiGraph[str]:
    """Return a graph whose nodes are the steps of a run, and whose edges are products.

    Nodes have the attributes `state`, `about` (methods and time), `row` and `column`. Each step is
    below all steps on which it depends. Wide levels are split into several rows, and skipped steps
    without connections come last.
    """
    import networkx as nx  # noqa: PLC0415 - takes 0.2 seconds

    members: dict[str, list[RecordedCell]] = {}
    for cell in run.cells.values():
        members.setdefault(cell.step, []).append(cell)
    graph: nx.DiGraph[str] = nx.DiGraph()
    for step, cells in members.items():
        graph.add_node(step, state=_state(cells), about=_about(cells))
    for cell in run.cells.values():
        for product in cell.inputs.values():
            before = run.cells.get(product.source.rpartition(".")[0])
            if before is not None:
                graph.add_edge(before.step, cell.step)
    loose = [node for node in nx.isolates(graph) if graph.nodes[node]["state"] == "skipped"]
    joined = graph.subgraph(node for node in graph if node not in loose)
    row = 0
    for level in (*nx.topological_generations(joined), loose):
        for first in range(0, len(level), _MAX_ABREAST):
            abreast = level[first : first + _MAX_ABREAST]
            for place, node in enumerate(abreast):
                graph.nodes[node].update(row=row, column=place - 0.5 * (len(abreast) - 1))
            row += 1
    return graph


def graph_file(run: Run) -> bytes:
    """Return the drawing of a run's graph as an SVG file."""
    nodes, edges = (graph := run_graph(run)).nodes, graph.edges
    rows = 1 + max((row for _, row in nodes(data="row")), default=0)
    wide = 0.5 + max((column for _, column in nodes(data="column")), default=0.0)
    middles = {
        node: ((about["column"] + wide) * _SPACING_PT[0], (about["row"] + 0.5) * _SPACING_PT[1])
        for node, about in nodes(data=True)
    }
    boxes = [
        {
            "x": middles[node][0],
            "y": middles[node][1],
            "frame": _FRAMES[about["state"]],
            "lines": [_shortened(line) for line in (node, about["about"])],
        }
        for node, about in nodes(data=True)
    ]
    drawing = environment().get_template("graph.svg.j2")
    return drawing.render(
        width=2.0 * wide * _SPACING_PT[0],
        height=rows * _SPACING_PT[1],
        size=_BOX_PT,
        boxes=boxes,
        arrows=[_arrow(middles[before], middles[after]) for before, after in edges],
    ).encode()


def _arrow(before: tuple[float, float], after: tuple[float, float]) -> str:
    """Return the path from the lower edge of a box to the upper edge of one in a later row."""
    (x0, y0), (x1, y1) = before, after
    # Curve the arrows that cross other rows, so that they pass between boxes.
    n_rows = round((y1 - y0) / _SPACING_PT[1])
    bulge = min(108.0 + 6.0 * n_rows, _SPACING_PT[0]) if n_rows > 1 else 0.0
    x, y = 0.5 * (x0 + x1) + bulge, 0.5 * (y0 + y1)
    half = 0.5 * _BOX_PT[1]
    return f"M{x0:g} {y0 + half:g}Q{x:g} {y:g} {x1:g} {y1 - half:g}"


def graph_picture(run: Run) -> Picture:
    """Return the graph as a picture on a page."""
    return Picture(
        uri=as_image(graph_file(run)),
        title="Steps and their products",
        caption="Each box is a step with its method and time; arrows are products. Frames are "
        "green for cached steps, thick red for failed steps, and dashed for steps not computed.",
    )


def _shortened(text: str) -> str:
    short = text if len(text) <= _MAX_LETTERS else f"{text[: _MAX_LETTERS - 6]}…{text[-5:]}"
    return shown(short)


def _about(cells: Sequence[RecordedCell]) -> str:
    done = [cell for cell in cells if cell.status == "ok"]
    seconds = seconds_in_words(sum(cell.wall_s for cell in done))
    if len(cells) == 1:
        return f"{cells[0].method}, {seconds}" if done else cells[0].status
    n_failed = sum(cell.status == "failed" for cell in cells)
    return f"run {len(cells)} times, {seconds}" + (f", {n_failed} failed" if n_failed else "")


def _state(cells: Sequence[RecordedCell]) -> str:
    states = {cell.status for cell in cells}
    if "failed" in states:
        return "failed"
    if "ok" not in states:
        return "skipped"
    return "cached" if all(cell.cached_from for cell in cells if cell.status == "ok") else "ok"


MAX_FIGURE_BYTES: Final = 3_900_000  # of all figures on a page; base64 adds a third
_LEAST_SIDE_PX: Final = 240
_MAX_SIDE_PX: Final = 700
_DPI: Final = 300
SMALL_BYTES: Final = 20_000  # smaller files are not scaled down


@dataclass(frozen=True, kw_only=True)
class FigureGroup:
    """The figures of one cell."""

    cell: str
    method: str
    pictures: tuple[Picture, ...]


def figure_groups(
    run: Run, *, share: float = 1.0, with_files: bool = False
) -> tuple[FigureGroup, ...]:
    """Return the figures of all cells except repeats, without duplicates.

    If the figures together exceed the size limit, the large ones are scaled down.

    Args:
        run: the run.
        share: the part of a page's size limit that the figures may use, from 0 to 1.
        with_files: whether the figures of `baseline_addresses` are also written to
            `FIGURES_FOLDER`.
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
    fitted = dict(
        zip(chosen, _fitted(tuple(chosen.values()), share * MAX_FIGURE_BYTES), strict=True)
    )
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
    """Write the figures of cells to `folder/<cell>/` as image files, and the graph of the run.

    Damaged pictures and SVG files, which may contain scripts, are omitted.

    Args:
        run: the run.
        folder: output folder, created if missing.
        addresses: addresses of the cells.
        inside: subfolder to write to instead of `folder`; it must not be a link.
        as_pdf: whether to write each picture as a PDF page at 300 dpi.

    Returns:
        The number of figures written.

    Raises:
        RecordError: the name of a cell or figure is not allowed as a file name, or the type of a
            figure has no suffix; nothing is written.
        StoreError: the folder cannot be written to.
    """
    named = figure_files(run, addresses)
    contents: dict[str, Callable[[], bytes | None]] = {GRAPH_FILE: partial(graph_file, run)}
    for path, figure in named.items():
        name = f"{path.rpartition('.')[0]}.pdf" if as_pdf else path
        contents[name] = partial(_content, figure, as_pdf=as_pdf)
    way = f"{inside}/" if inside else ""
    written = write_files(folder, {f"{way}{path}": content for path, content in contents.items()})
    return written - 1


def _content(figure: RecordedFigure, *, as_pdf: bool) -> bytes | None:
    if figure.media_type == "image/svg+xml":
        return None
    try:
        if as_pdf:
            return encode_pdf(decode_image(figure.data, figure.name), dpi=_DPI)
        # Convert WebP to PNG, which publishers and word processors accept.
        if figure.media_type == "image/webp":
            return encode_png(decode_image(figure.data, figure.name))
    except InputError:
        return None
    return figure.data


def _fitted(figures: tuple[RecordedFigure, ...], bytes_most: float) -> Iterable[RecordedFigure]:
    n_bytes = sum(len(figure.data) for figure in figures)
    if n_bytes <= bytes_most:
        return figures
    # The size in bytes is roughly proportional to the number of pixels.
    side_px = round(LONGEST_SIDE_PX * math.sqrt(0.8 * max(0.0, bytes_most) / n_bytes))
    side_px = min(max(side_px, _LEAST_SIDE_PX), _MAX_SIDE_PX)
    return tuple(in_order(partial(_smaller, side_px=side_px), figures))


def _smaller(figure: RecordedFigure, side_px: int) -> RecordedFigure:
    if figure.media_type == "image/svg+xml" or len(figure.data) <= SMALL_BYTES:
        return figure
    try:
        data = shrunk_webp(figure.data, figure.name, longest_side_px=side_px)
    except InputError:
        # Omit a picture that cannot be decoded; the page can still be written.
        return replace(figure, data=b"", caption=f"{figure.caption} (the picture is damaged)")
    is_smaller = len(data) < len(figure.data)
    return replace(figure, media_type="image/webp", data=data) if is_smaller else figure
