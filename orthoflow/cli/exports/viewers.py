"""Exports to look at: the room as a textured model, orthoimages as tiles with a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

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
from orthoflow.files.gltf import write_page, write_room
from orthoflow.files.ortho_files import OrthoFile, ortho_files
from orthoflow.files.tiles.pyramid import PAGE, write_tiles, write_viewer
from orthoflow.products import Planes
from orthoflow.records.runs import Run
from orthoflow.records.verification import require_unchanged
from orthoflow.records.wall_results import room_results


def export_gltf(run: Run, folder: Path, chosen: Choices) -> str:
    """Write `room.glb`, and `room.html` that shows it."""
    address, orthos = _orthos(run, chosen)
    planes = last_product(run, branch_of(run, address), Planes, chosen.store)
    if planes is None:
        raise ArgumentError(
            f"the orthoimages of {address} come of no planes of this run, so nothing says which "
            "way is up"
        )
    depths = _depths(run, address, orthos, chosen.wall) if chosen.relief else None
    make_empty(folder)
    write_room(folder / "room.glb", orthos, planes.up, depths)
    write_page(folder / "room.html", folder / "room.glb")
    return f"room.glb and room.html: {counted(len(orthos), 'wall')} of {address}"


def _depths(
    run: Run, address: str, orthos: Sequence[OrthoFile], wall: int | None
) -> dict[int, Path]:
    """The published depths of walls, by number."""
    walls = room_results(run, address, wall).walls
    found = {wall.number: wall.rasters["depth"] for wall in walls if "depth" in wall.rasters}
    for ortho in orthos:
        if ortho.wall not in found:
            raise ArgumentError(
                f"--relief: the run has no depth of wall {ortho.wall}; without --relief the model "
                "has planes"
            )
    return found


def export_tiles(run: Run, folder: Path, chosen: Choices) -> str:
    """Write the tiles of each orthoimage, and `index.html`."""
    address, orthos = _orthos(run, chosen)
    images = {f"wall_{ortho.wall}_ortho": ortho for ortho in orthos}
    make_empty(folder)
    n_tiles = sum(write_tiles(folder, name, ortho) for name, ortho in images.items())
    write_viewer(folder, images)
    return f"{PAGE}: {counted(len(orthos), 'wall')} in {counted(n_tiles, 'tile')} of {address}"


def _orthos(run: Run, chosen: Choices) -> tuple[str, tuple[OrthoFile, ...]]:
    """The published orthoimages of the wanted cell, or the last one that gave any."""
    address, _ = output_of(run, "orthoimages", chosen.cell)
    paths = [path for path in run.files.get(address, ()) if path.name.endswith("_ortho.tif")]
    for path in paths:
        require_unchanged(run, path, path.with_suffix(".json"))
    found = ortho_files(paths)
    if not found:
        raise ArgumentError(
            f"no orthoimages of {address} lie below {run.products_folder}: give the run folder as "
            "the run left it"
        )
    if chosen.wall is not None:
        numbered = {ortho.wall: ortho for ortho in found}
        found = (wanted_wall(chosen.wall, numbered, address, "shows"),)
    return address, found
