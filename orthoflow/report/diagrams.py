"""The graph of a run: steps as boxes in rows, arrows for what they pass on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from orthoflow.files.drawing import styled
from orthoflow.records import RecordedCell
from orthoflow.records.runs import Run
from orthoflow.report.charts import as_image, saved
from orthoflow.report.numbers import seconds_in_words
from orthoflow.report.pictures import Picture
from orthoflow.untrusted_text import shown

if TYPE_CHECKING:
    import networkx as nx

_MAX_ABREAST: Final = 5  # boxes in a row
_MAX_LETTERS: Final = 26
# Distinguished without colours by the width and dashes of the frame.
_FRAMES: Final[dict[str, dict[str, Any]]] = {
    "ok": {"edgecolor": "#5b6570", "facecolor": "#f3f5f7"},
    "cached": {"edgecolor": "#1c6b35", "facecolor": "#eaf5ec"},
    "failed": {"edgecolor": "#a11616", "facecolor": "#fbeaea", "linewidth": 2.0},
    "skipped": {"edgecolor": "#5b6570", "facecolor": "white", "linestyle": "--"},
}


def run_graph(run: Run) -> nx.DiGraph[str]:
    """Return the steps of a run, each below all that it depends on; arrows are products.

    Nodes have `state`, `about` (methods and time) and `row`; wide levels continue in further rows,
    and what neither takes nor gives anything because it was skipped is last.
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
    """Draw the graph of a run as an SVG file."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - pages without charts need none

    nodes, edges = (graph := run_graph(run)).nodes, graph.edges
    rows = 1 + max((row for _, row in nodes(data="row")), default=0)
    wide = 0.5 + max((column for _, column in nodes(data="column")), default=0.0)
    with styled({"font.size": 7.0}):
        figure = Figure(figsize=(3.0 * wide, 0.65 * rows))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        axes.set(xlim=(-wide, wide), ylim=(rows - 0.5, -0.5))
        boxes = {
            node: axes.text(
                about["column"],
                about["row"],
                "\n".join(_shortened(line) for line in (node, about["about"])),
                ha="center",
                va="center",
                bbox={"boxstyle": "round", **_FRAMES[about["state"]]},
            ).get_bbox_patch()
            for node, about in nodes(data=True)
        }
        for before, after in edges:
            (x0, y0), (x1, y1) = (
                (nodes[node]["column"], nodes[node]["row"]) for node in (before, after)
            )
            # Past other rows an arrow bulges, so that it is seen beside their boxes.
            bulge = 0.25 if y1 - y0 > 1 else 0.0
            axes.annotate(
                "",
                (x1, y1),
                (x0, y0),
                arrowprops={
                    "arrowstyle": "-|>",
                    "color": "#5b6570",
                    "connectionstyle": f"arc3,rad={bulge}",
                    "patchA": boxes[before],
                    "patchB": boxes[after],
                    "shrinkB": 3.0,
                    "mutation_scale": 8.0,
                },
            )
        return saved(figure, "svg")


def graph_picture(run: Run) -> Picture:
    """Return the drawing as a picture of a page."""
    return Picture(
        uri=as_image(graph_file(run)),
        title="What each step passes on",
        caption="Each box is a step with its method and time; arrows are products. Green frames "
        "come from the cache, thick red ones failed, dashed ones were not computed.",
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
