"""What the page says in numbers and words, taken from the record."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

from orthoflow.diagnostics import DiagnosticGroup, grouped, standing
from orthoflow.products import Orthoimages
from orthoflow.records.metrics import MetricRow, cell_metrics
from orthoflow.records.runs import Run
from orthoflow.report.combinations import baseline_cells, combinations_of, unequal_walls
from orthoflow.report.metric_words import WORDS, words_of
from orthoflow.report.numbers import number, number_with_unit
from orthoflow.report.ways import improved_on
from orthoflow.workflow.expand import NOT_ASKED_FOR

# Without photos that show a place, completeness cannot be asked for there.
_SHARPER_COMPLETENESS: Final = "completeness_seen_by_both"
# Metrics that say how good the products are, in the order in which a reader wants them.
QUALITY: Final[Mapping[str, str]] = {
    name: WORDS[name]
    for name in (
        "rmse_u_mm",
        "rmse_v_mm",
        "nmad_u_mm",
        "nmad_v_mm",
        _SHARPER_COMPLETENESS,
        "n_oriented",
        "sigma_wall_mm_worst",
        "check_rmse_mm_worst",
        "plane_angle_deg",
        "plane_offset_mm",
        "depth_rmse_mm",
        "completeness",
        "rms_mm",
    )
}

_DECLARED_MOST: Final = 3
_IMAGE: Final = re.compile(r"/wall_(\d+)_ortho\.tif$")
_PLACE: Final = re.compile(r"(.*\S) \(([^()]+)\)")
_PLANE: Final = re.compile(r"\b(?:wall|floor|ceiling) (\d+)")
CHECKING: Final = "check_rmse_mm_worst"
OF_PLANE: Final = "rms_mm"
# What a reader may take such a number for, and it is not.
_RELIEF_COUNTS: Final = "relief of the wall counts in full: it is no error of the image"
_NOT_HELD: Final[Mapping[str, str]] = {
    "sigma_wall_mm_worst": "against the scan; errors of depth and scan add to it",
    CHECKING: "mean of both axes of the photo; along one of the wall it may be more",
    "depth_rmse_mm": "cells at edges hold two depths and weigh most; typical is depth_nmad_mm",
}


@dataclass(frozen=True, kw_only=True)
class Answer:
    """One number of the first screen: what, how much, from which cell, and what it leaves out."""

    what: str
    value: str
    cell: str
    not_held: str = ""
    metric: str = ""

    def along(self, wall: str, check_rms_mm: tuple[float, float]) -> Answer:
        """Say of ties that only check what they are along a wall, as their drawing does.

        Args:
            wall: its name.
            check_rms_mm: of all photos on it, along u and v.
        """
        u, v = check_rms_mm
        return replace(
            self,
            what=f"ties that only check, RMS on {wall} along u / along v",
            value=f"{u:.2f} / {v:.2f} mm",
            not_held=(
                "u: right, v: down; of all photos. In the worst photo it is "
                f"{self.value} in the mean of the photo's two axes"
            ),
        )

    def of_plane(self, wall: str, rms_mm: float) -> Answer:
        """Say of points to their plane what they are on a wall, not on the first plane."""
        value = _in_words(self.metric, rms_mm, "mm")
        return replace(self, what=f"points to the plane of {wall}, RMS", value=value)


@dataclass(frozen=True, kw_only=True)
class Limit:
    """A sentence on what limits the result, the cells that say it, and whether they failed."""

    text: str
    cells: tuple[str, ...]
    is_failure: bool = False


def is_quality(row: MetricRow) -> bool:
    """Whether a number is one of QUALITY; a stranger's kind may mean something else by the name."""
    return row.metric in QUALITY and words_of(row.metric, row.method, row.label) != row.metric


def answers(run: Run) -> tuple[Answer, ...]:
    """How good the products are: the quality metrics of the baseline's inspections and planes."""
    rows = [row for cell in baseline_cells(run) for row in cell_metrics(cell)]
    values = {(row.cell, row.metric): row.value for row in rows}
    found: list[Answer] = [
        Answer(what="main wall of the scene", value="not found", cell=row.cell)
        for row in rows
        if row.metric == "main_found" and row.method.startswith("inspect.") and row.value == 0
    ]
    # The one number that comes from outside stands before what the run says of itself.
    at_points = len(found)
    # What a stranger's method says to be good or bad is what its workflow is about.
    found += [
        Answer(what=row.label, value=_in_words(row.metric, row.value, row.unit), cell=row.cell)
        for row in rows
        if row.label and row.better
    ][:_DECLARED_MOST]
    for wanted in QUALITY:
        stated = [row for row in rows if row.metric == wanted and is_quality(row)]
        # Own orthoimages stand behind those of others, whatever the order of the steps.
        stated.sort(key=lambda row: not _is_of_others(run, row.cell))
        # A later step of the chain improves on an earlier one: first and final orientation.
        stated = [row for row in stated if row.step == stated[-1].step]
        if wanted == "completeness":
            stated = [row for row in stated if (row.cell, _SHARPER_COMPLETENESS) not in values]
        for row in stated:
            value = _in_words(wanted, row.value, row.unit)
            if wanted == "n_oriented" and (row.cell, "n_photos") in values:
                value = f"{value} of {number(values[row.cell, 'n_photos'])}"
            what = words_of(wanted, row.method, row.label)
            not_held = _NOT_HELD.get(wanted, "")
            if wanted == OF_PLANE and row.method.startswith("plane."):
                not_held = _RELIEF_COUNTS
            n_found = int(values.get((row.cell, "n_found"), 0.0))
            if wanted == "rms_mm" and n_found and row.method.startswith("inspect."):
                # Of one point it is no RMS, and of few it says little.
                what = "check point, residual" if n_found == 1 else what
                n_points = int(values.get((row.cell, "n_points"), n_found))
                of_all = f"{n_found} of {n_points}" if n_points > n_found else f"{n_found}"
                not_held = f"{of_all} {'point' if n_points == 1 else 'points'}"
            answer = Answer(what=what, value=value, cell=row.cell, not_held=not_held, metric=wanted)
            if wanted == "rms_mm" and row.method.startswith("inspect."):
                own = {name: value for (cell, name), value in values.items() if cell == row.cell}
                of_points = (answer, *_in_space(row.cell, own))
                found[at_points:at_points] = of_points
                at_points += len(of_points)
            else:
                found.append(answer)
    return tuple(found)


def _in_space(cell: str, values: Mapping[str, float]) -> Iterator[Answer]:
    """How far check points are off in space, beside how far they are in the plane of the wall."""
    if "rms_3d_mm" in values:
        n_found = int(values.get("n_3d", 0.0))
        yield Answer(
            what="check point in space, off by" if n_found == 1 else WORDS["rms_3d_mm"],
            value=_in_words("rms_3d_mm", values["rms_3d_mm"], "mm"),
            cell=cell,
            not_held=(
                "with its depth" if n_found == 1 else f"of {n_found} points, with their depth"
            ),
            metric="rms_3d_mm",
        )


def says_how_far_off(run: Run) -> bool:
    """Whether an inspection of the baseline measured lengths, by which its pictures are off."""
    return any(
        metric.unit == "mm"
        for cell in baseline_cells(run)
        if cell.method.startswith("inspect.")
        for metric in cell.metrics
    )


def _is_of_others(run: Run, address: str) -> bool:
    """Whether a cell looks at orthoimages that were read from files."""
    makers = (
        run.cells.get(given.source.rpartition(".")[0])
        for given in run.cells[address].inputs.values()
        if given.type_name == Orthoimages.type_name
    )
    return any(maker is not None and maker.method.startswith("read.") for maker in makers)


def limits(run: Run, on_show: str = "") -> tuple[Limit, ...]:
    """What limits the results: failures, combinations of different walls, then diagnostics by code.

    Of the diagnostics that no later step has settled errors stand first. Behind the others stands
    what is only about other planes than the one on show, last what is only about planes of which
    no orthoimage was made.

    Args:
        run: the run.
        on_show: name of the plane whose picture stands beside them; empty where there is none.
    """
    failures: dict[str, list[str]] = {}
    for cell in run.record.cells:
        if cell.status == "failed":
            failures.setdefault(cell.error_message, []).append(cell.address)
    first = {cell.address for cell in baseline_cells(run)}
    by_baseline = sorted(run.record.cells, key=lambda cell: cell.address not in first)
    imaged = {
        found[1] for file in run.record.published if (found := _IMAGE.search(file.path)) is not None
    }
    shown = set(_PLANE.findall(on_show))
    # What a later orientation leaves open of the photos it says itself.
    oriented = [
        cell.address
        for cell in by_baseline
        if cell.status == "ok" and cell.method.startswith("orient.")
    ]
    settled = improved_on(run, oriented)
    groups = sorted(
        grouped(
            (address, one)
            for address, one in standing(by_baseline)
            if address not in settled and one.severity != "note"
        ),
        key=lambda group: (
            group.worst.severity != "error",
            _is_of_others_than(imaged, group),
            _is_of_others_than(shown, group),
        ),
    )
    apart = unequal_walls(combinations_of(run))
    rastered = tuple(one.address for one in by_baseline if one.method.startswith("raster."))
    return (
        *(Limit(text=why, cells=tuple(where), is_failure=True) for why, where in failures.items()),
        *([Limit(text=apart, cells=rastered)] if apart else []),
        *(Limit(text=group.sentence, cells=group.places) for group in groups),
    )


def _is_of_others_than(numbers: Collection[str], group: DiagnosticGroup) -> bool:
    """Whether diagnostics are about planes, but none of these, where there are any."""
    about = (_PLANE.fullmatch(subject) for subject in (group.worst.subject, *group.subjects))
    named = [plane[1] for plane in about if plane]
    return bool(numbers and named) and not any(number in numbers for number in named)


def results(run: Run) -> dict[str, tuple[str, ...]]:
    """Which cells have a result, failed, were not reached or not asked for: which -> addresses."""
    found: dict[str, tuple[str, ...]] = {"ok": (), "failed": (), "skipped": (), "not asked for": ()}
    for cell in run.record.cells:
        is_unasked = cell.status == "skipped" and cell.error_message.startswith(NOT_ASKED_FOR)
        which = "not asked for" if is_unasked else cell.status
        found[which] = (*found[which], cell.address)
    return found


def _in_words(metric: str, value: float, unit: str) -> str:
    if metric.startswith("completeness"):
        return f"{100 * value:.1f} %"
    return number_with_unit(value, unit, significant=3 if abs(value) >= 0.01 else 2)


def citations(run: Run) -> dict[str, tuple[str, ...]]:
    """What the methods of a run ask to be cited: text -> methods, with what each takes of it."""
    found: dict[str, dict[str, None]] = {}
    for cell in run.record.cells:
        if cell.status != "skipped":
            for citation in cell.citations:
                # `..., doi:... (4.4, Table 2)`: one entry for a paper, wherever in it a method is.
                placed = _PLACE.fullmatch(citation)
                text, place = placed.groups() if placed else (citation, "")
                method = f"{cell.method}: {place}" if place else cell.method
                found.setdefault(text, {})[method] = None
    return {citation: tuple(methods) for citation, methods in found.items()}
