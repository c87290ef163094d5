"""Exports that draw: sheets, CAD files, vectors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.products import make_empty, wanted_wall
from orthoflow.cli.tables import counted
from orthoflow.errors import ArgumentError
from orthoflow.files.drawings.cad_pictures import write_cad_picture
from orthoflow.files.drawings.dxf import write_room_dxf, write_wall_dxf
from orthoflow.files.drawings.elevations import (
    ElevationWall,
    elevation_scale,
    unfolded,
    write_elevation,
)
from orthoflow.files.drawings.geojson import (
    write_room_geojson,
    write_seams_geojson,
    write_wall_geojson,
)
from orthoflow.files.drawings.key_plans import key_plan
from orthoflow.files.drawings.papers import (
    Paper,
    Part,
    View,
    fitting_scale,
    nice_step,
    paper_for_one,
    paper_of,
    placed_views,
)
from orthoflow.files.drawings.printed_pictures import stretch_of
from orthoflow.files.drawings.qgis import PROJECT, ProjectLayer, write_project
from orthoflow.files.drawings.relief import (
    Light,
    write_contours,
    write_depth_figure,
    write_relief,
)
from orthoflow.files.drawings.room_lines import DrawnWall, RoomLines, room_lines
from orthoflow.files.drawings.sheet_contents import MarkedArea, Sheet, SheetText, WallDrawing
from orthoflow.files.drawings.sheets import axes_of, write_sheet
from orthoflow.files.drawings.title_blocks import TitleBlock, read_title_block
from orthoflow.files.sidecars import placed_raster
from orthoflow.products import Orthoimage, Orthoimages
from orthoflow.records.runs import Run
from orthoflow.records.wall_results import RoomResults, WallResult, room_results

_DEFAULT_PAPER: Final = "A3"
_GRID_MM: Final = 20.0


def export_sheets(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `wall_<k>_sheet_<n>.pdf`, and `wall_<k>_index.pdf` where a wall takes several."""
    paper = paper_of(chosen.paper or _DEFAULT_PAPER)
    block = read_title_block(chosen.title_block) if chosen.title_block else TitleBlock()
    results = room_results(run, chosen.cell, chosen.wall)
    walls = _chosen_walls(results, chosen)
    scale = chosen.scale or fitting_scale([_size_m(wall) for wall in walls], paper)
    digest = run.content_sha256
    drawings = [
        _drawing(results, wall, chosen, scale, _sheet_text(run, wall, block, digest))
        for wall in walls
    ]
    make_empty(folder)
    counts = [
        _write_wall(folder, drawing, wall, paper)
        for drawing, wall in zip(drawings, walls, strict=True)
    ]
    said = f"{counted(sum(counts), 'sheet')} of {counted(len(walls), 'wall')} at 1:{scale}"
    if sum(counts) > len(walls):
        sizes = [
            (tuple(one.rasters), _size_m(wall)) for one, wall in zip(drawings, walls, strict=True)
        ]
        larger = paper_for_one(sizes, scale)
        said += f" (on {larger} each wall takes one)" if larger else ""
    return said


def _chosen_walls(results: RoomResults, chosen: Choices) -> Sequence[WallResult]:
    if chosen.wall is None:
        return results.walls
    numbered = {wall.number: wall for wall in results.walls}
    return [wanted_wall(chosen.wall, numbered, results.address, "shows")]


def _size_m(wall: WallResult) -> tuple[float, float]:
    return wall.frame.width * wall.frame.gsd_m, wall.frame.height * wall.frame.gsd_m


def _drawing(
    results: RoomResults, wall: WallResult, chosen: Choices, scale: int, text: SheetText
) -> WallDrawing:
    kinds = _kinds(wall, chosen)
    grid_m = nice_step(1e-3 * _GRID_MM * scale) if chosen.grid_m is None else chosen.grid_m
    if 0.0 < grid_m < 2e-3 * scale:
        raise ArgumentError(
            f"--grid {grid_m:g} puts crosses closer than 2 mm at 1:{scale}: take at least "
            f"{2e-3 * scale:g}, or 0 for none"
        )
    planes = results.planes
    depths = stretch_of(wall.rasters["depth"]) if "depth" in kinds else None
    return WallDrawing(
        number=wall.number,
        rasters={kind: wall.rasters[kind] for kind in kinds},
        axes=axes_of(wall.frame),
        plan=None if planes is None else key_plan(planes, wall.frame),
        text=text,
        scale=scale,
        grid_m=grid_m if math.isfinite(grid_m) else 0.0,
        interval_m=0.0 if depths is None else depths.interval,
        depth_range_m=None if depths is None else (depths.low, depths.high),
        areas=_areas(results, wall),
        intensity_is_grey=wall.intensity_source != "laser",
    )


def _areas(results: RoomResults, wall: WallResult) -> tuple[MarkedArea, ...]:
    """Openings of a wall, from the top-left corner of its raster."""
    frame = wall.frame
    return tuple(
        MarkedArea(
            text=opening.said, outline_m=frame.gsd_m * frame.wall_from_raster(opening.outline_m)
        )
        for opening in results.openings_of(wall)
    )


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


def _sheet_text(run: Run, wall: WallResult, block: TitleBlock, digest: str) -> SheetText:
    notes = [f"accuracy: {'; '.join(wall.accuracy)}" if wall.accuracy else "accuracy not checked"]
    if wall.colours:
        notes.append(wall.colours)
    notes.append(f"cells of {1e3 * wall.frame.gsd_m:g} mm")
    return SheetText(
        name=wall.name,
        block=block,
        notes=tuple(notes),
        digest=digest,
        run=f"run {run.record.run_id} of {run.record.name}, {run.record.created_by}",
    )


def _write_wall(folder: Path, drawing: WallDrawing, wall: WallResult, paper: Paper) -> int:
    """Write the sheets of a wall, and give how many there are besides the index."""
    kinds = tuple(drawing.rasters)
    way, views = placed_views(
        kinds, _size_m(wall), paper, scale=drawing.scale, grid_m=drawing.grid_m
    )
    for number, shown in enumerate(views, start=1):
        sheet = Sheet(
            paper=way,
            views=shown,
            number=number,
            count=len(views),
            numbered=_numbered(views, shown[0].kind),
        )
        write_sheet(folder / f"wall_{drawing.number}_sheet_{number}.pdf", drawing, sheet)
    numbered = _numbered(views, kinds[0])
    if numbered:
        # As large as one sheet takes; its scale is as true as that of the others.
        scale = fitting_scale([_size_m(wall)], paper)
        small = replace(drawing, scale=scale, grid_m=0.0)
        way, whole = placed_views(kinds[:1], _size_m(wall), paper, scale=scale, grid_m=0.0)
        index = Sheet(paper=way, views=whole[0], number=0, count=len(views), numbered=numbered)
        # Of what no usual scale gets onto one sheet there is none.
        if len(whole) == 1:
            write_sheet(folder / f"wall_{drawing.number}_index.pdf", small, index)
    return len(views)


def _numbered(views: Sequence[tuple[View, ...]], kind: str) -> tuple[tuple[int, Part], ...]:
    """What of a wall is on which of the sheets of one picture; empty where it is not cut."""
    parts = tuple(
        (number, sheet[0].part)
        for number, sheet in enumerate(views, start=1)
        if sheet[0].kind == kind
    )
    return parts if len(parts) > 1 else ()


def export_dxf(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `wall_<k>.dxf` and `room.dxf`, and the pictures that they refer to."""
    results = room_results(run, chosen.cell, chosen.wall)
    walls = _chosen_walls(results, chosen)
    lines = _lines(results)
    make_empty(folder)
    drawn = []
    for wall in walls:
        image = f"wall_{wall.number}_ortho.png" if "ortho" in wall.rasters else ""
        if image:
            write_cad_picture(wall.rasters["ortho"], folder / image)
        drawn.append(_drawn(results, wall, image))
        write_wall_dxf(folder / f"wall_{wall.number}.dxf", drawn[-1], lines)
    if lines is None:
        return counted(len(walls), "wall")
    write_room_dxf(folder / "room.dxf", drawn, lines)
    return f"{counted(len(walls), 'wall')}, and the room: {_said(lines)}"


def export_geojson(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `wall_<k>.geojson`, `wall_<k>_seams.geojson` and `room.geojson`."""
    results = room_results(run, chosen.cell, chosen.wall)
    walls = _chosen_walls(results, chosen)
    lines = _lines(results)
    make_empty(folder)
    for wall in walls:
        write_wall_geojson(folder / f"wall_{wall.number}.geojson", _drawn(results, wall, ""), lines)
    for image in _images(run, results.address):
        if len(image.sources) > 1 and chosen.wall in {None, image.number}:
            write_seams_geojson(folder / f"wall_{image.number}_seams.geojson", image)
    if lines is None:
        return counted(len(walls), "wall")
    crs = next((wall.frame.map_crs for wall in results.walls if wall.frame.map_crs), None)
    write_room_geojson(folder / "room.geojson", lines, crs)
    return f"{counted(len(walls), 'wall')}, and the room: {_said(lines)}"


def export_elevations(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `elevation_<n>.pdf`."""
    results = room_results(run, chosen.cell)
    walls = [
        ElevationWall(
            name=wall.name,
            frame=wall.frame,
            raster=next(
                wall.rasters[kind]
                for kind in ("ortho", "intensity", "depth")
                if kind in wall.rasters
            ),
        )
        for wall in results.walls
        if wall.frame.raster_axes == "wall"
    ]
    if results.planes is None or not walls:
        raise ArgumentError(
            f"the run {run.record.run_id} shows no upright wall, so there is nothing to unfold"
        )
    up = results.planes.up
    order, is_inside = unfolded(walls, up)
    scale, paper, sheets = elevation_scale(order, up, chosen.scale, chosen.paper)
    make_empty(folder)
    origin = f"run {run.record.run_id} of {run.record.name}, {run.record.created_by}"
    for number, shown in enumerate(sheets, start=1):
        path = folder / f"elevation_{number}.pdf"
        write_elevation(path, shown, up, (scale, paper), (origin, chosen.language or "en"))
    side = "inside" if is_inside else "outside"
    return f"{counted(len(walls), 'wall')} as seen from {side} at 1:{scale} on " + counted(
        len(sheets), "sheet"
    )


def export_relief(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `wall_<k>_relief.tif`, `wall_<k>_relief.png` and `wall_<k>_contours.geojson`."""
    light = _light(chosen.light)
    results = room_results(run, chosen.cell, chosen.wall)
    walls = [wall for wall in _chosen_walls(results, chosen) if "depth" in wall.rasters]
    if not walls:
        raise ArgumentError(f"the run {run.record.run_id} has no depths of walls")
    make_empty(folder)
    intervals = []
    for wall in walls:
        depth, stem = wall.rasters["depth"], folder / f"wall_{wall.number}"
        frame, _ = placed_raster(depth)
        write_relief(depth, Path(f"{stem}_relief.tif"), light)
        write_depth_figure(depth, Path(f"{stem}_relief.png"), light)
        interval_m = write_contours(depth, frame, Path(f"{stem}_contours.geojson"))
        intervals.append(f"{wall.name} {1e3 * interval_m:g} mm")
    return f"{counted(len(walls), 'wall')}, contour lines every: {', '.join(intervals)}"


def _light(text: str | None) -> Light:
    if text is None:
        return Light()
    try:
        azimuth, altitude = (float(word) for word in text.split(","))
    except ValueError:
        azimuth = altitude = math.nan
    if not (-360.0 <= azimuth <= 360.0 and 0.0 < altitude <= 90.0):
        raise ArgumentError(
            f"--light takes two numbers in degrees with a comma between, the azimuth on the wall "
            f"clockwise from above and the altitude over its plane (0 to 90), got {text!r}"
        )
    return Light(azimuth_deg=azimuth, altitude_deg=altitude)


def export_qgis(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `walls.qgs` and a virtual raster per layer."""
    results = room_results(run, chosen.cell)
    walls = [wall for wall in results.walls if wall.frame.raster_axes == "wall"]
    if not walls:
        raise ArgumentError(f"the run {run.record.run_id} shows no upright wall")
    layers = []
    for wall in walls:
        kinds = [kind for kind in ("ortho", "intensity", "depth") if kind in wall.rasters]
        layers += [
            ProjectLayer(
                wall=wall.name,
                kind=kind,
                raster=wall.rasters[kind].resolve(),
                is_shown=kind == kinds[0],
            )
            for kind in kinds
        ]
    make_empty(folder)
    write_project(folder, run.record.name, layers)
    return f"{PROJECT}: {counted(len(walls), 'wall')} side by side, Y is the height"


def _images(run: Run, address: str) -> Sequence[Orthoimage]:
    """The orthoimages of a cell; none where it gives other rasters."""
    for port, output in run.cell(address).outputs.items():
        if output.type_name == Orthoimages.type_name and output.embedded:
            return Orthoimages.from_payload(run.payload(address, port)).images
    return ()


def _lines(results: RoomResults) -> RoomLines | None:
    if results.planes is None:
        return None
    return room_lines(results.planes, results.checkpoints, results.openings)


def _drawn(results: RoomResults, wall: WallResult, image: str) -> DrawnWall:
    return DrawnWall(
        number=wall.number,
        name=wall.name,
        plane_index=wall.plane_index,
        frame=wall.frame,
        image=image,
        openings=results.openings_of(wall),
    )


def _said(lines: RoomLines) -> str:
    return (
        f"{counted(len(lines.surfaces), 'plane')}, {counted(len(lines.edges), 'edge')}, "
        f"{counted(len(lines.corners), 'corner')}"
        + (f", {counted(len(lines.openings), 'opening')}" if lines.openings else "")
    )
