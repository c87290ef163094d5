"""Exports of sheets: choice of paper and scale, lettering, and division into sheets."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from orthoflow.cli.commands import echo_error
from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.drawings import chosen_walls
from orthoflow.cli.exports.products import make_empty
from orthoflow.cli.tables import counted
from orthoflow.errors import ArgumentError
from orthoflow.files.drawings.key_plans import key_plan
from orthoflow.files.drawings.printed_pictures import (
    Area,
    ElevationWall,
    elevation,
    unfolded,
    wall_picture,
)
from orthoflow.files.drawings.sheet_contents import (
    FOOT_M,
    SCALES,
    SCALES_FT,
    Drawing,
    Picture,
    SheetText,
    TitleBlock,
    axes_of,
    nice_step,
    north_of,
    paper_of,
    read_title_block,
)
from orthoflow.files.drawings.sheets import fitting_scale, lay_out, write_sheet
from orthoflow.files.drawings.words import Language, Phrase, label, numerals, surface_name
from orthoflow.products import Opening
from orthoflow.records.runs import Run
from orthoflow.records.walls import RoomResults, WallResult, room_results
from orthoflow.untrusted_text import first_few

_USUAL_PAPER: Final = "A3"
_GRID_MM: Final = 20.0
_LEAST_PPI: Final = 150.0
_MM_PER_INCH: Final = 25.4
_MOST_NAMED: Final = 8
_KINDS: Final = {"through": "through_opening", "niche": "niche", "no data": "no_data"}


def write_drawings(
    folder: Path,
    drawn: Callable[[int], Sequence[Drawing]],
    chosen: Choices,
    *,
    alone: str = "{stem}_sheet_{number}",
    several: str = "{stem}_sheet_{number}",
) -> tuple[int, int]:
    """Choose the scale and paper of drawings, and write their sheets into a new folder.

    Args:
        folder: output folder, which is created after the layout.
        drawn: function that returns the drawings at a given scale.
        chosen: the options.
        alone: file name of a drawing that fits on one sheet.
        several: file name of a drawing that needs several sheets.

    Returns:
        The denominator N of the scale 1:N, and the number of sheets.
    """
    given = [paper_of(chosen.paper)] if chosen.paper else []
    usual = SCALES_FT if chosen.units == "ft" else SCALES
    scale = chosen.scale or fitting_scale(drawn, usual, given or [paper_of(_USUAL_PAPER)])
    drawings = drawn(scale)
    laid = [lay_out(drawing, given) for drawing in drawings]
    make_empty(folder)
    for drawing, sheets in zip(drawings, laid, strict=True):
        for sheet, furniture in sheets:
            pattern = alone if len(sheets) == 1 else several
            name = pattern.format(stem=drawing.stem, number=sheet.number)
            write_sheet(folder / f"{name}.pdf", drawing, sheet, furniture)
    return scale, sum(map(len, laid))


def text_of(run: Run, name: str, chosen: Choices, notes: tuple[Phrase, ...] = ()) -> SheetText:
    """Return the title block and notes for the sheets of a run."""
    return SheetText(
        name=name,
        block=read_title_block(chosen.title_block) if chosen.title_block else TitleBlock(),
        notes=notes,
        digest=run.content_sha256,
        run=origin_of(run, chosen.language or "en"),
    )


def origin_of(run: Run, language: Language) -> str:
    """Return a line of text that names the run from which the drawings were made."""
    about = run.record
    return label("origin", language, run=about.run_id, name=about.name, program=about.created_by)


def grid_of(chosen: Choices, scale: int) -> float:
    """Return the spacing of the grid crosses in the unit of the sheets.

    Raises:
        ArgumentError: the requested spacing is too small for the scale.
    """
    unit_m = FOOT_M if chosen.units == "ft" else 1.0
    grid = nice_step(1e-3 * _GRID_MM * scale / unit_m) if chosen.grid is None else chosen.grid
    if not math.isfinite(grid):
        return 0.0
    if 0.0 < grid * unit_m < 2e-3 * scale:
        raise ArgumentError(
            f"--grid {grid:g} puts crosses closer together than 2 mm at 1:{scale}: use at least "
            f"{2e-3 * scale / unit_m:g}, or 0 for none"
        )
    return grid


def export_sheets(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `wall_<k>_sheet_<n>.pdf`."""
    text = text_of(run, "", chosen)
    results = room_results(run, chosen.cell, chosen.wall)
    walls, empty = _without_empty(chosen_walls(results, chosen), chosen)
    drawings = [_drawing(text, results, wall, chosen) for wall in walls]

    def drawn(scale: int) -> list[Drawing]:
        pairs = zip(drawings, walls, strict=True)
        return [_scaled(drawing, wall, chosen, scale) for drawing, wall in pairs]

    scale, n_sheets = write_drawings(folder, drawn, chosen)
    _warn(walls)
    said = f"{counted(n_sheets, 'sheet')} of {counted(len(walls), 'wall')} at 1:{scale}"
    return said + _coarse(walls, scale) + empty


def _without_empty(
    walls: Sequence[WallResult], chosen: Choices
) -> tuple[Sequence[WallResult], str]:
    """Omit walls with an empty orthoimage, and return a remark on them.

    Nothing is omitted if a wall is selected or all orthoimages are empty.
    """
    empty = [wall for wall in walls if wall.about and wall.about.painted_share == 0.0]
    if chosen.wall is not None or len(empty) in (0, len(walls)):
        return walls, ""
    names = first_few([wall.name for wall in empty], most=_MOST_NAMED)
    return [wall for wall in walls if wall not in empty], f"; left out as empty: {names}"


def export_elevations(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `elevation_<n>.pdf`."""
    results = room_results(run, chosen.cell)
    language = chosen.language or "en"
    upright, empty = _without_empty(
        [wall for wall in results.walls if wall.frame.raster_axes == "wall"], chosen
    )
    walls = [
        ElevationWall(
            name=surface_name(wall.name, language),
            frame=wall.frame,
            raster=wall.rasters[_first_kind(wall)],
        )
        for wall in upright
    ]
    if results.planes is None or not walls:
        raise ArgumentError(f"the run {run.record.run_id} has no vertical walls for an elevation")
    up = results.planes.up
    order, is_inside = unfolded(walls, up)
    # The accuracy differs between walls; list walls with the same notes together.
    known: dict[str, list[str]] = {}
    for wall in upright:
        about = [wall.about.accuracy if wall.about else Phrase(key="not_checked")]
        if wall.about and wall.about.objection:
            about.insert(0, wall.about.objection)
        if wall.frame.bend is not None:
            about.append(axes_of(wall.frame).phrase)
        said = "; ".join(phrase.text(language) for phrase in about)
        known.setdefault(said, []).append(surface_name(wall.name, language))
    notes = tuple(
        Phrase(key="of_wall", values={"wall": ", ".join(names), "text": said})
        for said, names in known.items()
    )
    text = text_of(run, ", ".join(wall.name for wall in order), chosen, notes)

    def drawn(scale: int) -> list[Drawing]:
        plain = elevation(order, up, text, scale, language)
        return [replace(plain, grid=nice_step(1e-3 * _GRID_MM * scale))]

    pattern = "{stem}_{number}"
    scale, n_sheets = write_drawings(folder, drawn, chosen, alone=pattern, several=pattern)
    _warn(upright)
    side = "inside" if is_inside else "outside"
    said = f"{counted(len(walls), 'wall')} as seen from {side} at 1:{scale} on "
    return said + counted(n_sheets, "sheet") + empty


def _warn(walls: Sequence[WallResult]) -> None:
    few = [
        f"{wall.name} ({wall.about.reason})"
        for wall in walls
        if wall.about and not wall.about.recommended
    ]
    if few:
        echo_error(f"warning: not recommended for delivery: {first_few(few, most=_MOST_NAMED)}")


def _coarse(walls: Sequence[WallResult], scale: int) -> str:
    """Return a remark on walls whose resolution is too low for printing at a scale.

    The remark contains a scale at which the resolution is sufficient; it is empty if no resolution
    is too low.
    """
    coarse = [wall for wall in walls if _ppi(wall, scale) < _LEAST_PPI]
    if not coarse:
        return ""
    worst = min(coarse, key=lambda wall: _ppi(wall, scale))
    enough = usual_scale(scale * _LEAST_PPI / _ppi(worst, scale))
    names = ", ".join(wall.name for wall in coarse)
    return (
        f"; the resolution of {names} is too low for printing ({_ppi(worst, scale):.0f} pixels "
        f"per inch instead of {_LEAST_PPI:.0f}), but sufficient at 1:{enough}"
    )


def usual_scale(least: float) -> int:
    """Return the smallest denominator of the usual scales that is not below a given value.

    >>> usual_scale(30.2), usual_scale(20.1), usual_scale(200.0), usual_scale(2.4), usual_scale(9)
    (50, 25, 200, 5, 10)
    """
    return next((n for n in SCALES if n >= least * (1.0 - 1e-9)), round(nice_step(least)))


def _ppi(wall: WallResult, scale: int) -> float:
    return _MM_PER_INCH * scale / (1e3 * wall.frame.gsd_m)


def _drawing(text: SheetText, results: RoomResults, wall: WallResult, chosen: Choices) -> Drawing:
    language, unit = chosen.language or "en", chosen.units or "m"
    frame = wall.frame
    areas = [_area(wall, opening, chosen) for opening in results.openings_of(wall)]
    high_m = frame.height * frame.gsd_m
    edges = {0.0, round(high_m, 4)}
    for _, outline_m in areas:
        edges |= {round(float(outline_m[:, 1].min()), 4), round(float(outline_m[:, 1].max()), 4)}
    notes = wall.accuracy or (Phrase(key="not_checked"),)
    if wall.about and wall.about.objection:
        notes = (wall.about.objection, *notes)
    planes = results.planes
    plan = None if planes is None else key_plan(planes, frame, wall.number)
    pictures: dict[str, Picture] = {}
    for kind in _kinds(wall, chosen):
        is_grey = kind == "intensity" and wall.intensity_source != "laser"
        words = label("grey" if is_grey else kind, language)
        if frame.raster_down > 0.0:
            words += f", {label('reflected', language)}"
        pictures[words] = wall_picture(
            wall.rasters[kind],
            is_depth=kind == "depth",
            is_flipped=frame.raster_down > 0.0,
            areas=areas,
            language=language,
        )
    return Drawing(
        stem=f"wall_{wall.number}",
        size_m=(frame.width * frame.gsd_m, high_m),
        pictures=pictures,
        axes=axes_of(frame),
        plan=plan,
        text=replace(
            text,
            name=surface_name(wall.name, language),
            notes=(*notes, *([wall.colours] if wall.colours else [])),
        ),
        scale=1,
        unit=unit,
        language=language,
        heights=tuple(sorted(edges)) if frame.raster_axes == "wall" else (),
        north=north_of(frame),
        up_label=plan.up_label if plan else "y",
    )


def _scaled(drawing: Drawing, wall: WallResult, chosen: Choices, scale: int) -> Drawing:
    ppi = _ppi(wall, scale)
    values = {"mm": f"{1e3 * wall.frame.gsd_m:g}", "ppi": f"{ppi:.0f}"}
    coarse = (Phrase(key="coarse", values={"least": f"{_LEAST_PPI:.0f}"}),)
    cells = Phrase(key="cells", values=values, asides=coarse if ppi < _LEAST_PPI else ())
    text = replace(drawing.text, notes=(*drawing.text.notes, cells))
    return replace(drawing, scale=scale, grid=grid_of(chosen, scale), text=text)


def _area(wall: WallResult, opening: Opening, chosen: Choices) -> Area:
    """Return the label of an opening, and its outline (n, 2) in metres.

    The origin of the outline is the top-left corner of the drawn wall.
    """
    frame, language = wall.frame, chosen.language or "en"
    outline_m = frame.gsd_m * frame.wall_from_raster(opening.outline_m)
    unit_m, unit = (FOOT_M, "ft") if chosen.units == "ft" else (1.0, "m")
    wide, high = opening.width_m / unit_m, opening.height_m / unit_m
    size = " x ".join((numerals(f"{wide:.2f}", language), numerals(f"{high:.2f} {unit}", language)))
    return f"{label(_KINDS[opening.kind], language)}, {size}", outline_m


def _first_kind(wall: WallResult) -> str:
    return next(kind for kind in ("ortho", "intensity", "depth") if kind in wall.rasters)


def _kinds(wall: WallResult, chosen: Choices) -> list[str]:
    for kind in chosen.beside:
        if kind not in wall.rasters:
            raise ArgumentError(
                f"--beside {kind}: the run has no {kind} raster of wall {wall.number}, only "
                f"{', '.join(wall.rasters)}"
            )
    return list(dict.fromkeys((_first_kind(wall), *chosen.beside)))
