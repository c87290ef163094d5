"""Exports of plans and sections, which cut the planes and the cloud of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.products import branch_of, last_product, numbers_of, product_of
from orthoflow.cli.exports.sheets import grid_of, origin_of, text_of, write_drawings
from orthoflow.cli.tables import counted
from orthoflow.errors import ArgumentError
from orthoflow.files.drawings.sections import (
    Cut,
    SectionDrawing,
    plan_cut,
    section_cut,
    section_of,
    section_sheet,
    write_section,
)
from orthoflow.files.drawings.sheet_contents import Drawing
from orthoflow.products import Planes, PointCloud, PointLabels
from orthoflow.records.runs import Run
from orthoflow.records.walls import RoomResults, room_results

_USUAL_HEIGHT_M = 1.2
_THROUGH = "--through must be four numbers in metres, X,Y,X,Y of two points,"


def export_plans(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `plan_<n>.dxf`, `plan_<n>.svg` and `plan_<n>.pdf` for each height."""
    results, planes = _room(run, chosen)
    cuts = [
        plan_cut(planes, height, chosen.language or "en")
        for height in chosen.heights_m or (_USUAL_HEIGHT_M,)
    ]
    return _write(run, folder, chosen, "plan", (results, planes), cuts)


def export_sections(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `section_<n>` as DXF, SVG and PDF for each pair of points."""
    if not chosen.through:
        raise ArgumentError(
            "--to section needs --through X,Y,X,Y, two points of the plan in metres "
            "(`--to plan` shows the coordinates)"
        )
    results, planes = _room(run, chosen)
    cuts = [
        section_cut(planes, numbers_of(text, 4, _THROUGH), chosen.language or "en")
        for text in chosen.through
    ]
    return _write(run, folder, chosen, "section", (results, planes), cuts)


def _room(run: Run, chosen: Choices) -> tuple[RoomResults, Planes]:
    results = room_results(run, chosen.cell)
    if results.planes is None:
        raise ArgumentError(f"the run {run.record.run_id} has no planes to cut")
    return results, results.planes


def _write(
    run: Run,
    folder: Path,
    chosen: Choices,
    kind: Literal["plan", "section"],
    room: tuple[RoomResults, Planes],
    cuts: Sequence[Cut],
) -> str:
    results, planes = room
    cloud, labels = _points(run, results.address, chosen)
    made = [section_of(cut, planes, results.openings, cloud, labels) for cut in cuts]
    text = text_of(run, "", chosen)

    def at(scale: int) -> list[SectionDrawing]:
        return [
            SectionDrawing(
                kind=kind,
                section=section,
                scale=scale,
                origin=origin_of(run, chosen.language or "en"),
                has_dimensions=chosen.dimensions,
                language=chosen.language or "en",
            )
            for section in made
        ]

    def drawn(scale: int) -> list[Drawing]:
        return [
            section_sheet(
                f"{kind}_{number}",
                drawing,
                planes,
                text,
                grid=grid_of(chosen, scale),
                crs=results.crs,
            )
            for number, drawing in enumerate(at(scale), start=1)
        ]

    scale, _ = write_drawings(folder, drawn, chosen, alone="{stem}")
    said = []
    for number, drawing in enumerate(at(scale), start=1):
        section = drawing.section
        write_section(folder, f"{kind}_{number}", drawing)
        said.append(
            f"{kind}_{number} at 1:{scale}, {section.cut.title}: "
            f"{counted(len(section.lines), 'cut line')}, {section.n_points:,} points in a slab of "
            f"{1e3 * section.slab_m:.0f} mm"
        )
    if cloud is None:
        said.append("neither the record nor the store contains the cloud, so openings are missing")
    return "; ".join(said)


def _points(
    run: Run, address: str, chosen: Choices
) -> tuple[PointCloud | None, PointLabels | None]:
    """Return the cloud in which planes were detected, and its labels.

    Each is None if neither the record nor the store contains it.
    """
    cells = branch_of(run, address)
    try:
        for cell in reversed(cells.values()):
            labels = [out.digest for out in cell.outputs.values() if out.type_name == "labels"]
            taken = [item.digest for item in cell.inputs.values() if item.type_name == "cloud"]
            if labels and len(taken) == 1:
                return (
                    product_of(run, taken[0], PointCloud, chosen.store),
                    product_of(run, labels[0], PointLabels, chosen.store),
                )
        return last_product(run, cells, PointCloud, chosen.store), None
    except ArgumentError:
        return None, None
