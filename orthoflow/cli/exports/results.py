"""Exports of results and their provenance, other than drawings and clouds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from orthoflow.cli.exports.products import make_empty, output_of, product_of
from orthoflow.cli.tables import counted

if TYPE_CHECKING:
    from orthoflow.cli.exports.choices import Choices
    from orthoflow.records.runs import Run


def export_colmap(run: Run, folder: Path, chosen: Choices) -> str:
    """Write the orientations of a cell as a COLMAP model."""
    from orthoflow.files.colmap import write_colmap_model
    from orthoflow.products import Cameras

    address, port = output_of(run, "cameras", chosen.cell)
    cameras = Cameras.from_payload(run.payload(address, port))
    make_empty(folder)
    model = write_colmap_model(folder, cameras)
    return (
        f"{counted(model.n_images, 'photo')}, {counted(model.n_cameras, 'camera')}, "
        f"{counted(model.n_points, 'point')} of {address}"
    )


def export_csv(run: Run, folder: Path, _chosen: Choices) -> str:
    """Write the tables of a run as CSV files."""
    from orthoflow.records.runs import parts_of
    from orthoflow.records.tables import write_csv_tables
    from orthoflow.report.paired import over_datasets, over_table

    make_empty(folder)
    written = [path.name for path in write_csv_tables(run, folder)]
    over = over_datasets(parts_of(run))
    files = {"datasets.csv": over_table(over).csv()} if over else {}
    _write_texts(folder, files)
    return ", ".join([*written, *files])


def _write_texts(folder: Path, files: Mapping[str, str]) -> None:
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8", errors="backslashreplace", newline="")


def export_figures(run: Run, folder: Path, chosen: Choices) -> str:
    """Write the figures of a cell, or the figures of all cells with charts.

    The charts are the plan of the photos and the curves of sweeps.
    """
    from functools import partial

    from orthoflow.records.runs import figure_files, write_files
    from orthoflow.report import write_figures
    from orthoflow.report.curves import curve_files
    from orthoflow.report.photo_plans import photo_plan
    from orthoflow.report.pictures import wall_pictures

    suffix = chosen.figure_format or "svg"
    addresses = run.cells if chosen.cell is None else (run.cell(chosen.cell).address,)
    # Reject invalid names before a folder is created.
    n_figures = len(figure_files(run, addresses))
    make_empty(folder)
    n_written = write_figures(run, folder, addresses, as_pdf=suffix == "pdf")
    curves = curve_files(run, suffix) if chosen.cell is None else {}
    charts = {f"curves/{name}": data for name, data in curves.items()}
    plan = photo_plan(run, list(wall_pictures(run))) if chosen.cell is None else None
    if plan is not None:
        charts[f"photos_and_walls.{suffix}"] = plan.file(suffix)
    write_files(folder, {name: partial(bytes, data) for name, data in charts.items()})
    damaged = f"; {n_figures - n_written} omitted (damaged or unsafe)"
    return (
        f"{counted(n_written, 'figure')}, {counted(len(charts), 'chart')} and the graph"
        f"{damaged if n_written < n_figures else ''}"
    )


def export_tables(run: Run, folder: Path, _chosen: Choices) -> str:
    """Write the tables and citations of a run for publications."""
    from orthoflow.report.paper_tables import paper_files

    files = paper_files(run)
    make_empty(folder)
    _write_texts(folder, files)
    return ", ".join(files)


def export_crate(run: Run, folder: Path, chosen: Choices) -> str:
    """Write an RO-Crate; its record contains all products and inputs if `embed` is set."""
    from orthoflow.records.archive import NO_LICENSE, write_crate
    from orthoflow.records.runs import REPORT_FILE
    from orthoflow.report import write_page

    make_empty(folder)
    license_text = chosen.license_text or NO_LICENSE
    if run.files_folder is not None:
        # The rasters were restored to a separate folder, because the run folder contains only the
        # record. Write the report there.
        write_page(run, run.folder / REPORT_FILE)
    if chosen.embed:
        run = embedded(run, folder, chosen)
    author = (chosen.author or "").strip()
    files = write_crate(run, folder, license_text=license_text, author=author)
    lacking = "" if chosen.license_text and author else "; license or author unknown"
    return f"{counted(len(files), 'file')}, described in {files[0].name}{lacking}"


def export_layers(run: Run, folder: Path, chosen: Choices) -> str:
    """Write the layers of a cell as GeoTIFFs."""
    from orthoflow.files.publishing import publish_layers
    from orthoflow.products import Layers

    address, port = output_of(run, "layers", chosen.cell)
    digest = run.cell(address).outputs[port].digest
    layers = product_of(run, digest, Layers, chosen.store)
    make_empty(folder)
    publish_layers(layers, folder, digest)
    return f"{counted(len(layers.layers), 'layer')} of {address}"


def export_prov(run: Run, folder: Path, _chosen: Choices) -> str:
    """Write `prov.json`, which describes the provenance of the results."""
    from prov.model import ProvActivity, ProvAgent, ProvEntity

    from orthoflow.records.archive import prov_document
    from orthoflow.records.runs import creating

    document = prov_document(run.record)
    make_empty(folder)
    with creating(folder, "prov.json") as stream:
        stream.write((document.serialize(format="json", indent=1) or "").encode() + b"\n")
    kinds = {"entity": ProvEntity, "activity": ProvActivity, "agent": ProvAgent}
    counts = {name: len(list(document.get_records(kind))) for name, kind in kinds.items()}
    return f"prov.json: {', '.join(f'{name}: {count}' for name, count in counts.items())}"


def export_stac(run: Run, folder: Path, _chosen: Choices) -> str:
    """Write `collection.json`, the orthoimages, and a STAC item for each orthoimage."""
    from orthoflow.records.stac import COLLECTION_FILE, write_stac

    make_empty(folder)
    n_items = write_stac(run, folder)
    return f"{COLLECTION_FILE} and {counted(n_items, 'item')} next to the orthoimages"


def embedded(run: Run, folder: Path, chosen: Choices) -> Run:
    """Write a record that contains all products and input files, and return the new run."""
    from orthoflow.engine.journal import RECORD_FILE
    from orthoflow.engine.store import Store
    from orthoflow.records.write import write_embedded

    return write_embedded(run, folder / RECORD_FILE, Store(chosen.store), chosen.inputs)
