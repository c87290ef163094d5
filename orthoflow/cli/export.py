"""`orthoflow export`: write a run's results in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from orthoflow.cli.failures import EXIT_GOOD
from orthoflow.cli.options import Command
from orthoflow.cli.tables import counted
from orthoflow.errors import ArgumentError

if TYPE_CHECKING:
    from orthoflow.records import Run


@click.command(cls=Command)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.option(
    "--to", "target", type=click.Choice(["colmap"]), required=True, help="The format to write."
)
@click.option(
    "--cell",
    metavar="ADDRESS",
    help="The cell whose orientations are meant; without it the last one that oriented photos.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Where to write it, a new or empty folder; without it RUN's own folder colmap.",
)
def export(run: Path, target: str, cell: str | None, output: Path | None) -> int:
    """Write the results of RUN, a run folder or its run.h5, for other programs.

    colmap: the oriented photos with their lenses and ties as a text model that COLMAP opens.
    """
    from orthoflow.files.colmap import write_colmap_model
    from orthoflow.products import Cameras
    from orthoflow.records import open_run

    opened = open_run(run)
    address, port = _orientation(opened, cell)
    cameras = Cameras.from_payload(opened.payload(address, port))
    folder = output if output is not None else opened.folder / target
    _make_empty(folder)
    model = write_colmap_model(folder, cameras)
    click.echo(
        f"colmap: {folder}: {counted(model.n_images, 'photo')}, "
        f"{counted(model.n_cameras, 'camera')}, {counted(model.n_points, 'point')} "
        f"of {address}"
    )
    return EXIT_GOOD


def _orientation(run: Run, cell: str | None) -> tuple[str, str]:
    """Cell and port that hold the orientations."""
    found = {
        address: port
        for address, recorded in run.cells.items()
        for port, output in recorded.outputs.items()
        if output.type_name == "cameras"
    }
    if cell is not None:
        run.cell(cell)
        if cell not in found:
            raise ArgumentError(
                f"the cell {cell} holds no orientations; those of this run: "
                f"{', '.join(found) or 'none'}"
            )
        return cell, found[cell]
    if not found:
        raise ArgumentError(f"the run {run.record.run_id} has oriented no photos")
    last = list(found)[-1]
    return last, found[last]


def _make_empty(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ArgumentError(
            f"{folder} exists already and is not empty: choose another folder with -o, or remove it"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArgumentError(f"{folder} cannot be made: {error.strerror}") from error
