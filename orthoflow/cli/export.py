"""`orthoflow export`: write a run's results in the formats of other programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

from orthoflow.cli.commands import RecordCommand
from orthoflow.cli.failures import EXIT_GOOD
from orthoflow.cli.options import input_option, store_option
from orthoflow.cli.tables import counted, echo
from orthoflow.errors import ArgumentError, StoreError

if TYPE_CHECKING:
    from orthoflow.products import Layers, PointCloud, PointLabels
    from orthoflow.records import Run

    ProductT = TypeVar("ProductT", Layers, PointCloud, PointLabels)

# What a product type is called where a cell has none, and where a run has none.
_SAID: Final = {
    "cameras": ("orientations", "has oriented no photos"),
    "layers": ("layers", "has laid nothing onto walls"),
    "labels": ("labels of points", "has found no planes"),
}


@click.command(cls=RecordCommand)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.option(
    "--to",
    "target",
    type=click.Choice(["colmap", "csv", "figures", "layers", "laz", "ro-crate"]),
    help="The format to write.",
)
@click.option(
    "--embed",
    is_flag=True,
    help="Write a record that needs nothing beside it: with every product and input file in it; "
    "alone, or in the place of the record with --to ro-crate.",
)
@click.option(
    "--split",
    is_flag=True,
    help="Write a run folder per dataset, whose record verifies and replays alone.",
)
@input_option
@store_option
@click.option(
    "--cell",
    metavar="ADDRESS",
    help="colmap: the cell whose orientations are meant; without it the last one that oriented "
    "photos. laz: the cell that found the planes; without it the last one that did. layers: the "
    "cell that laid photos onto walls, likewise. figures: the only cell that is meant.",
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
    help="Where to write it, a new or empty folder; without it one in RUN of the format's name "
    "(all-figures, embedded, datasets).",
)
def export(run: Path, target: str | None, output: Path | None, **choices: Any) -> int:
    """Write the results of RUN, a run folder or its run.h5, for other programs.

    colmap: the oriented photos with their lenses and ties as a text model that COLMAP opens. csv:
    tables of cells, metrics, parameters, inputs, products and environments. figures: every figure
    as PNG or SVG. layers: what each photo shows of each wall by itself, as GeoTIFFs, from the store
    unless the run was made with --embed. laz: the cloud, each point in the colour of its plane,
    likewise. ro-crate: record, report and products as a Provenance Run Crate, for archives.
    --embed: run.h5 alone, which verifies and replays without any other file; what it lacks so far
    comes from the store and from the input files, looked for by content or given with --input.
    --split: of a run on several datasets a run folder each, with record, report and products.
    """
    from orthoflow.engine.durability import whole_folder
    from orthoflow.records import open_run

    chosen = _Choices(**choices)
    chosen.check(target)
    opened = open_run(run)
    name = target or ("datasets" if chosen.split else "embedded")
    # figures/ has those of the baseline already.
    folder = output or _folder_inside(opened, "all-figures" if target == "figures" else name)
    _refuse_filled(folder)
    with whole_folder(folder) as aside:
        said = _exported(target, opened, aside, chosen)
    echo(f"{name}: {folder}: {said}")
    return EXIT_GOOD


def _exported(target: str | None, run: Run, folder: Path, chosen: _Choices) -> str:
    """Write a format into a folder and say what was written."""
    if target == "colmap":
        return _export_colmap(run, folder, chosen.cell)
    if target == "csv":
        return _export_csv(run, folder)
    if target == "figures":
        return _export_figures(run, folder, chosen.cell)
    if target in {"layers", "laz"}:
        return (_export_laz if target == "laz" else _export_layers)(run, folder, chosen)
    if target == "ro-crate":
        return _export_crate(run, folder, chosen)
    return (_export_split if chosen.split else _export_embedded)(run, folder, chosen)


@dataclass(frozen=True, kw_only=True)
class _Choices:
    """The options that belong to some formats only."""

    cell: str | None
    license_text: str | None
    embed: bool
    split: bool
    inputs: Sequence[str]
    store: Path

    def check(self, target: str | None) -> None:
        """Refuse options that do not belong to the format."""
        if target is None and not self.embed and not self.split:
            raise ArgumentError(
                "say what to write: --to colmap, csv, figures, layers, laz or ro-crate, or --embed "
                "or --split"
            )
        said = f"--to {target}" if target else "--split" if self.split else "--embed"
        if self.split and (target or self.embed):
            raise ArgumentError(
                f"--split writes records of its own, so it does not go with "
                f"{f'--to {target}' if target else '--embed'}"
            )
        if self.cell is not None and target not in {"colmap", "figures", "layers", "laz"}:
            raise ArgumentError(
                f"--cell belongs to --to colmap, figures, layers or laz, not to {said}"
            )
        if self.license_text is not None and target != "ro-crate":
            raise ArgumentError(f"--license belongs to --to ro-crate, not to {said}")
        if self.embed and target not in {None, "ro-crate"}:
            raise ArgumentError(f"{said} writes no record, so nothing can be embedded with --embed")
        if self.inputs and not self.embed:
            raise ArgumentError(f"--input belongs to --embed, not to {said}")


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


def _export_figures(run: Run, folder: Path, cell: str | None) -> str:
    from orthoflow.records import figure_files
    from orthoflow.report import write_figures

    addresses = run.cells if cell is None else (run.cell(cell).address,)
    # Refused before a folder is made for them.
    figure_files(run, addresses)
    _make_empty(folder)
    return f"{counted(write_figures(run, folder, addresses), 'figure')} and the graph"


def _export_crate(run: Run, folder: Path, chosen: _Choices) -> str:
    from orthoflow.records.crates import NO_LICENSE, write_crate

    _make_empty(folder)
    license_text = chosen.license_text or NO_LICENSE
    record = _embedded(run, folder, chosen) if chosen.embed else None
    files = write_crate(run, folder, license_text=license_text, record=record)
    return f"{counted(len(files), 'file')}, described in {files[0].name}"


def _export_embedded(run: Run, folder: Path, chosen: _Choices) -> str:
    _make_empty(folder)
    record = _embedded(run, folder, chosen)
    n_products = sum(len(cell.outputs) for cell in record.cells.values())
    n_files = sum(len(entry.files) for entry in record.record.inputs)
    return (
        f"{record.path.name} with {counted(n_products, 'product')} and "
        f"{counted(n_files, 'input file')}, {record.path.stat().st_size:,} bytes"
    )


def _export_split(run: Run, folder: Path, chosen: _Choices) -> str:
    from orthoflow.engine import Store
    from orthoflow.records import REPORT_FILE
    from orthoflow.records.datasets import parts_of, write_part
    from orthoflow.records.run_files import path_inside
    from orthoflow.report import write_page

    parts = parts_of(run)
    if not parts:
        raise ArgumentError(
            f"the run {run.record.run_id} ran on no datasets, so there is nothing to split"
        )
    _make_empty(folder)
    for name, part in parts.items():
        written = write_part(part, path_inside(folder, name), Store(chosen.store))
        write_page(written, written.folder / REPORT_FILE)
    return f"{counted(len(parts), 'run folder')}: {', '.join(parts)}"


def _embedded(run: Run, folder: Path, chosen: _Choices) -> Run:
    from orthoflow.engine import Store
    from orthoflow.records import RECORD_FILE
    from orthoflow.records.writing import write_embedded

    return write_embedded(run, folder / RECORD_FILE, Store(chosen.store), chosen.inputs)


def _export_layers(run: Run, folder: Path, chosen: _Choices) -> str:
    from orthoflow.files.publishing import publish_layers
    from orthoflow.products import Layers

    address, port = _output_of(run, "layers", chosen.cell)
    digest = run.cell(address).outputs[port].digest
    layers = _product(run, digest, Layers, chosen.store)
    _make_empty(folder)
    publish_layers(layers, folder, digest)
    return f"{counted(len(layers.layers), 'layer')} of {address}"


def _export_laz(run: Run, folder: Path, chosen: _Choices) -> str:
    from orthoflow.files.points.plane_clouds import write_plane_cloud
    from orthoflow.products import PointCloud, PointLabels
    from orthoflow.records.run_files import path_inside

    address, port = _output_of(run, "labels", chosen.cell)
    recorded = run.cell(address)
    clouds = [item.digest for item in recorded.inputs.values() if item.type_name == "cloud"]
    if len(clouds) != 1:
        raise ArgumentError(
            f"the cell {address} labels no cloud of its own: it takes {len(clouds)} clouds"
        )
    cloud = _product(run, clouds[0], PointCloud, chosen.store)
    labels = _product(run, recorded.outputs[port].digest, PointLabels, chosen.store)
    path = path_inside(folder, f"{recorded.step}.laz")
    _make_empty(folder)
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


def _folder_inside(run: Run, name: str) -> Path:
    """A folder of the run that nobody named; a link there would lead to where nobody wants it."""
    folder = run.folder / name
    if folder.is_symlink():
        raise ArgumentError(f"{folder} is a link: choose a folder with -o, or remove it")
    return folder


def _refuse_filled(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ArgumentError(
            f"{folder} exists already and is not empty: choose another folder with -o, or remove it"
        )


def _make_empty(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArgumentError(f"{folder} cannot be made: {error.strerror}") from error
