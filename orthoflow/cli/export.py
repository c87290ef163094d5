"""`orthoflow export`: write a run's results in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

import click

from orthoflow.cli.failures import EXIT_GOOD
from orthoflow.cli.options import Command, store_option
from orthoflow.cli.tables import counted
from orthoflow.errors import ArgumentError, StoreError

if TYPE_CHECKING:
    from orthoflow.products import PointCloud, PointLabels
    from orthoflow.records import Run

    ProductT = TypeVar("ProductT", PointCloud, PointLabels)

# What a product type is called where a cell has none, and where a run has none.
_SAID: Final = {
    "cameras": ("orientations", "has oriented no photos"),
    "labels": ("labels of points", "has found no planes"),
}


@click.command(cls=Command)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.option(
    "--to",
    "target",
    type=click.Choice(["colmap", "csv", "laz", "ro-crate"]),
    required=True,
    help="The format to write.",
)
@click.option(
    "--cell",
    metavar="ADDRESS",
    help="colmap: the cell whose orientations are meant; without it the last one that oriented "
    "photos. laz: the cell that found the planes; without it the last one that did.",
)
@click.option(
    "--license",
    "license_text",
    metavar="URL",
    help="ro-crate: the license of the results, its URL or name.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Where to write it, a new or empty folder; without it RUN's own folder of that name.",
)
@store_option
def export(
    run: Path,
    target: str,
    cell: str | None,
    license_text: str | None,
    output: Path | None,
    store: Path,
) -> int:
    """Write the results of RUN, a run folder or its run.h5, for other programs.

    colmap: the oriented photos with their lenses and ties as a text model that COLMAP opens. csv:
    tables of cells, metrics, parameters, inputs, products and environments. laz: the cloud, each
    point in the colour of its plane, from the store unless the run was made with --embed. ro-crate:
    record, report and products as a Provenance Run Crate, for archives.
    """
    from orthoflow.records import open_run

    if cell is not None and target not in {"colmap", "laz"}:
        raise ArgumentError(f"--cell belongs to --to colmap or laz, not to --to {target}")
    if license_text is not None and target != "ro-crate":
        raise ArgumentError(f"--license belongs to --to ro-crate, not to --to {target}")
    opened = open_run(run)
    folder = output if output is not None else opened.folder / target
    if target == "colmap":
        said = _export_colmap(opened, folder, cell)
    elif target == "csv":
        said = _export_csv(opened, folder)
    elif target == "laz":
        said = _export_laz(opened, folder, cell, store)
    else:
        said = _export_crate(opened, folder, license_text)
    click.echo(f"{target}: {folder}: {said}")
    return EXIT_GOOD


def _export_colmap(run: Run, folder: Path, cell: str | None) -> str:
    from orthoflow.files.colmap import write_colmap_model
    from orthoflow.products import Cameras

    address, port = _output_of(run, "cameras", cell)
    cameras = Cameras.from_payload(run.payload(address, port))
    _make_empty(folder)
    model = write_colmap_model(folder, cameras)
    return (
        f"{counted(model.n_images, 'photo')}, {counted(model.n_cameras, 'camera')}, "
        f"{counted(model.n_points, 'point')} of {address}"
    )


def _export_csv(run: Run, folder: Path) -> str:
    from orthoflow.records.spreadsheets import write_csv_tables

    _make_empty(folder)
    return ", ".join(path.name for path in write_csv_tables(run, folder))


def _export_crate(run: Run, folder: Path, license_text: str | None) -> str:
    from orthoflow.records.crates import NO_LICENSE, write_crate

    _make_empty(folder)
    files = write_crate(run, folder, license_text=license_text or NO_LICENSE)
    return f"{counted(len(files), 'file')}, described in {files[0].name}"


def _export_laz(run: Run, folder: Path, cell: str | None, store: Path) -> str:
    from orthoflow.files.points.plane_clouds import write_plane_cloud
    from orthoflow.products import PointCloud, PointLabels

    address, port = _output_of(run, "labels", cell)
    recorded = run.cell(address)
    clouds = [item.digest for item in recorded.inputs.values() if item.type_name == "cloud"]
    if len(clouds) != 1:
        raise ArgumentError(
            f"the cell {address} labels no cloud of its own: it takes {len(clouds)} clouds"
        )
    cloud = _product(run, clouds[0], PointCloud, store)
    labels = _product(run, recorded.outputs[port].digest, PointLabels, store)
    _make_empty(folder)
    path = folder / f"{recorded.step}.laz"
    write_plane_cloud(path, cloud, labels)
    n_planes = int(labels.plane_index.max(initial=-1)) + 1
    return (
        f"{path.name}: {counted(len(cloud), 'point')} on {counted(n_planes, 'plane')} of {address}"
    )


def _product(run: Run, digest: str, cls: type[ProductT], store: Path) -> ProductT:
    """A product from the record, or from the store where the record only names it."""
    from orthoflow.engine.store import Store

    for address, recorded in run.cells.items():
        for port, output in recorded.outputs.items():
            if output.digest == digest and output.embedded:
                return cls.from_payload(run.payload(address, port))
    try:
        return Store(store).get_product(digest, cls)
    except StoreError as error:
        raise ArgumentError(
            f"the {cls.type_name} of this run is neither in its record nor in the store {store} "
            f"({error}): name its store with --store, or run the workflow again with --embed"
        ) from error


def _output_of(run: Run, type_name: str, cell: str | None) -> tuple[str, str]:
    """The wanted cell, or the last one, that gives a product of a type, and the port."""
    named, missing = _SAID[type_name]
    found = {
        address: port
        for address, recorded in run.cells.items()
        for port, output in recorded.outputs.items()
        if output.type_name == type_name
    }
    if cell is not None:
        run.cell(cell)
        if cell not in found:
            raise ArgumentError(
                f"the cell {cell} holds no {named}; those of this run: {', '.join(found) or 'none'}"
            )
        return cell, found[cell]
    if not found:
        raise ArgumentError(f"the run {run.record.run_id} {missing}")
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
