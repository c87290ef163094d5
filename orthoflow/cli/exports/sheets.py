"""The export of sheets: which paper, which scale, what is written, and how a wall is cut."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.drawings import chosen_walls
from orthoflow.cli.exports.products import make_empty
from orthoflow.cli.tables import counted
from orthoflow.errors import ArgumentError
from orthoflow.files.drawings.key_plans import key_plan
from orthoflow.files.drawings.papers import (
    FOOT_M,
    SCALES,
    SCALES_FT,
    nice_step,
    paper_of,
)
from orthoflow.files.drawings.printed_pictures import stretch_of
from orthoflow.files.drawings.sheet_contents import (
    MarkedArea,
    SheetText,
    WallDrawing,
    axes_of,
    north_of,
)
from orthoflow.files.drawings.sheet_layout import Sized, fitting_scale, lay_out, paper_for_one
from orthoflow.files.drawings.sheets import write_sheet
from orthoflow.files.drawings.title_blocks import TitleBlock, read_title_block
from orthoflow.files.drawings.words import Phrase, label, surface_name
from orthoflow.products import Opening
from orthoflow.records.runs import Run
from orthoflow.records.wall_results import RoomResults, WallResult, room_results

_USUAL_PAPER: Final = "A3"
_GRID_MM: Final = 20.0
_LEAST_PPI: Final = 150.0
_MM_PER_INCH: Final = 25.4
_KINDS: Final = {"through": "through_opening", "niche": "niche", "no data": "no_data"}


def export_sheets(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `wall_<k>_sheet_<n>.pdf`, and `wall_<k>_index.pdf` where a wall takes several."""
    block = read_title_block(chosen.title_block) if chosen.title_block else TitleBlock()
    results = room_results(run, chosen.cell, chosen.wall)
    walls = chosen_walls(results, chosen)
    digest = run.content_sha256
    drawings = [_drawing(run, results, wall, chosen, block, digest) for wall in walls]
    given = [paper_of(chosen.paper)] if chosen.paper else []
    sizes = [_size_m(wall) for wall in walls]

    def drawn(scale: int) -> list[Sized]:
        scaled = (
            _scaled(drawing, wall, chosen, scale)
            for drawing, wall in zip(drawings, walls, strict=True)
        )
        return list(zip(scaled, sizes, strict=True))

    usual = SCALES_FT if chosen.units == "ft" else SCALES
    scale = chosen.scale or fitting_scale(drawn, usual, given or [paper_of(_USUAL_PAPER)])
    sized = drawn(scale)
    laid = [lay_out(drawing, size_m, given) for drawing, size_m in sized]
    make_empty(folder)
    for one in laid:
        stem = f"wall_{one.drawing.number}"
        for sheet, furniture in one.sheets:
            path = folder / f"{stem}_sheet_{sheet.number}.pdf"
            write_sheet(path, one.drawing, sheet, furniture)
        if one.index is not None:
            drawing, sheet, furniture = one.index
            write_sheet(folder / f"{stem}_index.pdf", drawing, sheet, furniture)
    n_sheets = sum(len(one.sheets) for one in laid)
    said = f"{counted(n_sheets, 'sheet')} of {counted(len(walls), 'wall')} at 1:{scale}"
    if n_sheets > len(walls):
        larger = paper_for_one(sized)
        said += f" (on {larger} each wall takes one)" if larger else ""
    return said + _coarse(walls, scale)


def _coarse(walls: Sequence[WallResult], scale: int) -> str:
    """Say which pictures have less than 150 pixels per inch, and at which scale they have."""
    coarse = [wall for wall in walls if _ppi(wall, scale) < _LEAST_PPI]
    if not coarse:
        return ""
    worst = min(coarse, key=lambda wall: _ppi(wall, scale))
    enough = math.ceil(scale * _LEAST_PPI / _ppi(worst, scale))
    names = ", ".join(wall.name for wall in coarse)
    return (
        f"; coarser than print, {_ppi(worst, scale):.0f} pixels per inch instead of "
        f"{_LEAST_PPI:.0f}: {names}; from 1:{enough} on they are fine enough"
    )


def _ppi(wall: WallResult, scale: int) -> float:
    return _MM_PER_INCH * scale / (1e3 * wall.frame.gsd_m)


def _size_m(wall: WallResult) -> tuple[float, float]:
    return wall.frame.width * wall.frame.gsd_m, wall.frame.height * wall.frame.gsd_m


def _drawing(
    run: Run,
    results: RoomResults,
    wall: WallResult,
    chosen: Choices,
    block: TitleBlock,
    digest: str,
) -> WallDrawing:
    """What is drawn of a wall, at no scale yet."""
    language, unit = chosen.language or "en", chosen.units or "m"
    kinds = _kinds(wall, chosen)
    depths = stretch_of(wall.rasters["depth"]) if "depth" in kinds else None
    is_upright = wall.frame.raster_axes == "wall"
    openings = results.openings_of(wall)
    areas = tuple(_area(wall, opening, chosen) for opening in openings)
    high_m = _size_m(wall)[1]
    edges = [0.0, high_m]
    for area in areas:
        edges += [float(area.outline_m[:, 1].min()), float(area.outline_m[:, 1].max())]
    notes = wall.accuracy or (Phrase(key="not_checked"),)
    return WallDrawing(
        number=wall.number,
        rasters={kind: wall.rasters[kind] for kind in kinds},
        axes=axes_of(wall.frame),
        plan=None if results.planes is None else key_plan(results.planes, wall.frame),
        text=SheetText(
            name=surface_name(wall.name, language),
            block=block,
            notes=(*notes, *([wall.colours] if wall.colours else [])),
            digest=digest,
            run=f"run {run.record.run_id} of {run.record.name}, {run.record.created_by}",
        ),
        scale=1,
        grid=0.0,
        unit=unit,
        language=language,
        interval_m=0.0 if depths is None else depths.interval,
        depth_range_m=None if depths is None else (depths.low, depths.high),
        areas=areas,
        heights=tuple(sorted({round(edge, 4) for edge in edges})) if is_upright else (),
        north=north_of(wall.frame),
        is_flipped=wall.frame.raster_down > 0.0,
        intensity_is_grey=wall.intensity_source != "laser",
    )


def _scaled(drawing: WallDrawing, wall: WallResult, chosen: Choices, scale: int) -> WallDrawing:
    """Give a drawing its scale, and what follows from it: the grid, and how fine cells print."""
    unit_m = FOOT_M if drawing.unit == "ft" else 1.0
    grid = nice_step(1e-3 * _GRID_MM * scale / unit_m) if chosen.grid is None else chosen.grid
    if not math.isfinite(grid):
        grid = 0.0
    if 0.0 < grid * unit_m < 2e-3 * scale:
        raise ArgumentError(
            f"--grid {grid:g} puts crosses closer than 2 mm at 1:{scale}: take at least "
            f"{2e-3 * scale / unit_m:g}, or 0 for none"
        )
    ppi = _ppi(wall, scale)
    values = {"mm": f"{1e3 * wall.frame.gsd_m:g}", "ppi": f"{ppi:.0f}"}
    coarse = (Phrase(key="coarse", values={"least": f"{_LEAST_PPI:.0f}"}),)
    cells = Phrase(key="cells", values=values, asides=coarse if ppi < _LEAST_PPI else ())
    text = replace(drawing.text, notes=(*drawing.text.notes, cells))
    return replace(drawing, scale=scale, grid=grid, text=text)


def _area(wall: WallResult, opening: Opening, chosen: Choices) -> MarkedArea:
    """An opening of a wall, from the top-left corner of the drawn wall."""
    frame, language = wall.frame, chosen.language or "en"
    outline_m = frame.gsd_m * frame.wall_from_raster(opening.outline_m)
    unit_m, unit = (FOOT_M, "ft") if chosen.units == "ft" else (1.0, "m")
    wide, high = opening.width_m / unit_m, opening.height_m / unit_m
    rows = [label(_KINDS[opening.kind], language), f"{wide:.2f} x {high:.2f} {unit}"]
    return MarkedArea(text=", ".join(rows), outline_m=outline_m)


def _kinds(wall: WallResult, chosen: Choices) -> list[str]:
    """What is shown of a wall: its orthoimage, or else what the scan shows, and what is asked."""
    first = next(kind for kind in ("ortho", "intensity", "depth") if kind in wall.rasters)
    for kind in chosen.beside:
        if kind not in wall.rasters:
            raise ArgumentError(
                f"--beside {kind}: the run has no {kind} of wall {wall.number}, only "
                f"{', '.join(wall.rasters)}"
            )
    return list(dict.fromkeys((first, *chosen.beside)))
