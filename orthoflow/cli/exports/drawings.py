"""Exports of drawings: sheets, CAD files and vectors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.products import make_empty, numbers_of, wanted_wall
from orthoflow.cli.tables import counted
from orthoflow.errors import ArgumentError
from orthoflow.files.drawings.dxf import write_room_dxf, write_wall_dxf
from orthoflow.files.drawings.geojson import (
    PROJECT,
    ProjectLayer,
    write_project,
    write_room_geojson,
    write_seams_geojson,
    write_wall_geojson,
)
from orthoflow.files.drawings.key_plans import DrawnWall, RoomLines
from orthoflow.files.drawings.printed_pictures import (
    Light,
    write_cad_picture,
    write_contours,
    write_depth_figure,
    write_relief,
)
from orthoflow.files.sidecars import placed_raster
from orthoflow.products import Orthoimage, Orthoimages
from orthoflow.records.runs import Run
from orthoflow.records.walls import RoomResults, WallResult, room_results


def chosen_walls(results: RoomResults, chosen: Choices) -> Sequence[WallResult]:
    """Return the selected wall, or all walls if none is selected."""
    if chosen.wall is None:
        return results.walls
    numbered = {wall.number: wall for wall in results.walls}
    return [wanted_wall(chosen.wall, numbered, results.address, "shows")]


def export_dxf(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `wall_<k>.dxf` and `room.dxf`, and the images to which the drawings refer."""
    results = room_results(run, chosen.cell, chosen.wall)
    walls = chosen_walls(results, chosen)
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
    walls = chosen_walls(results, chosen)
    lines = _lines(results)
    make_empty(folder)
    for wall in walls:
        write_wall_geojson(folder / f"wall_{wall.number}.geojson", _drawn(results, wall, ""), lines)
    for image in _images(run, results.address):
        if len(image.sources) > 1 and chosen.wall in {None, image.number}:
            write_seams_geojson(folder / f"wall_{image.number}_seams.geojson", image)
    if lines is None:
        return counted(len(walls), "wall")
    write_room_geojson(folder / "room.geojson", lines, results.crs)
    return f"{counted(len(walls), 'wall')}, and the room: {_said(lines)}"


def export_relief(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `wall_<k>_relief.tif`, `wall_<k>_relief.png` and `wall_<k>_contours.geojson`."""
    light = _light(chosen.light)
    results = room_results(run, chosen.cell, chosen.wall)
    walls = [wall for wall in chosen_walls(results, chosen) if "depth" in wall.rasters]
    if not walls:
        raise ArgumentError(f"the run {run.record.run_id} has no depth rasters of walls")
    make_empty(folder)
    intervals = []
    for wall in walls:
        depth, stem = wall.rasters["depth"], folder / f"wall_{wall.number}"
        frame, _ = placed_raster(depth)
        write_relief(depth, Path(f"{stem}_relief.tif"), light)
        write_depth_figure(depth, frame, Path(f"{stem}_relief.png"), light)
        interval_m = write_contours(depth, frame, Path(f"{stem}_contours.geojson"))
        intervals.append(f"{wall.name} {1e3 * interval_m:g} mm")
    return f"{counted(len(walls), 'wall')}, contour intervals: {', '.join(intervals)}"


def _light(text: str | None) -> Light:
    if text is None:
        return Light()
    expected = (
        "--light must be two numbers in degrees, the azimuth on the wall clockwise from the top "
        "and the altitude above its plane (0 to 90),"
    )
    azimuth, altitude = numbers_of(text, 2, expected)
    if not (-360.0 <= azimuth <= 360.0 and 0.0 < altitude <= 90.0):
        raise ArgumentError(f"{expected} got {text!r}")
    return Light(azimuth_deg=azimuth, altitude_deg=altitude)


def export_qgis(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `walls.qgs` and one virtual raster per layer."""
    results = room_results(run, chosen.cell)
    walls = [wall for wall in results.walls if wall.frame.raster_axes == "wall"]
    if not walls:
        raise ArgumentError(f"the run {run.record.run_id} has no vertical wall")
    layers = []
    for wall in walls:
        kinds = [kind for kind in ("ortho", "intensity", "depth") if kind in wall.rasters]
        layers += [
            ProjectLayer(
                wall=wall.name,
                kind=kind,
                raster=wall.rasters[kind].resolve(),
                about=wall.about.sentence if wall.about and kind == "ortho" else "",
                is_shown=kind == kinds[0],
            )
            for kind in kinds
        ]
    make_empty(folder)
    write_project(folder, run.record.name, layers)
    return f"{PROJECT}: {counted(len(walls), 'wall')} side by side, Y is the height"


def _images(run: Run, address: str) -> Sequence[Orthoimage]:
    for port, output in run.cell(address).outputs.items():
        if output.type_name == Orthoimages.type_name and output.embedded:
            return Orthoimages.from_payload(run.payload(address, port)).images
    return ()


def _lines(results: RoomResults) -> RoomLines | None:
    if results.planes is None:
        return None
    return RoomLines(
        planes=results.planes, checkpoints=results.checkpoints, openings=results.openings
    )


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
