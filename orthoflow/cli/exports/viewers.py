"""Exports for viewers: a textured model of the room, and orthoimages as tiles."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.products import (
    branch_of,
    last_product,
    make_empty,
    output_of,
    wanted_wall,
)
from orthoflow.cli.tables import counted
from orthoflow.errors import ArgumentError
from orthoflow.files.drawings.printed_pictures import Light, write_relief
from orthoflow.files.gltf import write_page, write_room
from orthoflow.files.sidecars import OrthoFile, ortho_files, placed_raster
from orthoflow.files.tiles.iiif import MANIFEST, Canvas, Layer, write_manifest
from orthoflow.files.tiles.pyramid import PAGE, write_tiles, write_viewer
from orthoflow.products import Planes
from orthoflow.records.runs import Run, require_unchanged
from orthoflow.records.walls import WallResult, room_results

_LOCAL: Final = "http://localhost:8000"
_LAYERS: Final = {
    "ortho": "orthoimage",
    "intensity": "intensity",
    "depth": "depth",
    "relief": "raking light",
}


def export_gltf(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `room.glb`, and `room.html` to view it."""
    address, orthos = _orthos(run, chosen)
    planes = last_product(run, branch_of(run, address), Planes, chosen.store)
    if planes is None:
        raise ArgumentError(
            f"the orthoimages of {address} belong to no planes of this "
            "run, so the up direction is unknown"
        )
    depths = _depths(run, address, orthos, chosen.wall) if chosen.relief else None
    make_empty(folder)
    write_room(folder / "room.glb", orthos, planes.up, depths)
    write_page(folder / "room.html", folder / "room.glb")
    return f"room.glb and room.html: {counted(len(orthos), 'wall')} of {address}"


def _depths(
    run: Run, address: str, orthos: Sequence[OrthoFile], wall: int | None
) -> dict[int, Path]:
    walls = room_results(run, address, wall).walls
    found = {wall.number: wall.rasters["depth"] for wall in walls if "depth" in wall.rasters}
    for ortho in orthos:
        if ortho.wall not in found:
            raise ArgumentError(
                f"--relief: the run has no depth raster of wall {ortho.wall}; without --relief, "
                "the walls of the model are flat"
            )
    return found


def export_tiles(run: Run, folder: Path, chosen: Choices) -> str:
    """Write the tiles of each orthoimage, and `index.html` to view them."""
    address, orthos = _orthos(run, chosen)
    images = {f"wall_{ortho.wall}_ortho": ortho for ortho in orthos}
    make_empty(folder)
    n_tiles = sum(write_tiles(folder, name, ortho) for name, ortho in images.items())
    write_viewer(folder, images)
    return f"{PAGE}: {counted(len(orthos), 'wall')} in {counted(n_tiles, 'tile')} of {address}"


def export_iiif(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `manifest.json` and the tiles of each wall's pictures."""
    results = room_results(run, chosen.cell, chosen.wall)
    walls = {wall.number: wall for wall in results.walls}
    if chosen.wall is not None:
        walls = {chosen.wall: wanted_wall(chosen.wall, walls, results.address, "shows")}
    make_empty(folder)
    with tempfile.TemporaryDirectory() as scratch:
        canvases = [_canvas(wall, Path(scratch)) for wall in walls.values()]
        base = chosen.base_url or _LOCAL
        n_tiles = write_manifest(folder, run.record.name, canvases, base)
    return f"{MANIFEST}: {counted(len(walls), 'wall')} in {counted(n_tiles, 'tile')} below {base}"


def _canvas(wall: WallResult, scratch: Path) -> Canvas:
    rasters = dict(wall.rasters)
    if "depth" in rasters:
        rasters["relief"] = scratch / f"wall_{wall.number}_relief.tif"
        write_relief(rasters["depth"], rasters["relief"], Light())
    known = [kind for kind in _LAYERS if kind in rasters]
    frames = {kind: placed_raster(rasters[kind])[0] for kind in known if kind != "relief"}
    shape = frames[known[0]].shape
    same = [kind for kind in known if kind == "relief" or frames[kind].shape == shape]
    return Canvas(
        label=wall.name,
        summary=wall.about.sentence if wall.about else "no orthoimage",
        layers=[
            Layer(label=_LAYERS[kind], raster=rasters[kind], stem=f"wall_{wall.number}_{kind}")
            for kind in same
        ],
    )


def _orthos(run: Run, chosen: Choices) -> tuple[str, tuple[OrthoFile, ...]]:
    """Return the cell and its published orthoimages.

    The cell is the selected one or, if none is selected, the last cell with orthoimages.
    """
    address, _ = output_of(run, "orthoimages", chosen.cell)
    paths = [path for path in run.files.get(address, ()) if path.name.endswith("_ortho.tif")]
    for path in paths:
        require_unchanged(run, path, path.with_suffix(".json"))
    found = ortho_files(paths)
    if not found:
        raise ArgumentError(
            f"no orthoimages of {address} were found in {run.products_folder}: pass the "
            "unmodified run folder"
        )
    if chosen.wall is not None:
        numbered = {ortho.wall: ortho for ortho in found}
        found = (wanted_wall(chosen.wall, numbered, address, "shows"),)
    return address, found
