"""One dataset of a run as a run of its own: what it computed, and what all of them share."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

from orthoflow_provenance.errors import InputFileError, RecordFormatError
from orthoflow_provenance.model import RecordedCell
from orthoflow_provenance.writer import write_record

from orthoflow.engine.durability import writing_to
from orthoflow.engine.run_folder import RECORD_FILE, cell_file_name
from orthoflow.engine.store import Store
from orthoflow.errors import ArgumentError, StoreError
from orthoflow.files.json_texts import parse_json
from orthoflow.products.product import JsonValue
from orthoflow.records.input_files import embedded_inputs
from orthoflow.records.published import PRODUCTS_FOLDER
from orthoflow.records.run_files import copy_files, path_inside
from orthoflow.records.runs import Run
from orthoflow.workflow.format import DATA

_DATASETS = "datasets"


def datasets_of(run: Run) -> tuple[str, ...]:
    """Names of the datasets that a run has cells of, in their order; none of most runs."""
    if not _resolved(run).get(_DATASETS):
        return ()
    return tuple(
        dict.fromkeys(cell.assignment[DATA] for cell in run.record.cells if DATA in cell.assignment)
    )


def run_of_dataset(run: Run, name: str) -> Run:
    """Give the part of a run that belongs to one dataset, what all share included.

    Its products are read from the record of the whole run.

    Raises:
        ArgumentError: the run has no such dataset.
    """
    if name not in datasets_of(run):
        raise ArgumentError(f"the run {run.record.run_id} has no dataset {name}")
    record = run.record
    cells = tuple(cell for cell in record.cells if cell.assignment.get(DATA, name) == name)
    folders = {f"{PRODUCTS_FOLDER}/{cell_file_name(cell.address)}" for cell in cells}
    taken = {product.source for cell in cells for product in cell.inputs.values()}
    environments = {cell.environment for cell in cells}
    return dataclasses.replace(
        run,
        record=dataclasses.replace(
            record,
            status="failed" if any(cell.status == "failed" for cell in cells) else "ok",
            workflow_resolved=_resolved_of(run, name),
            inputs=tuple(
                entry
                for entry in record.inputs
                if f"inputs.{entry.name}" in taken or entry.name.partition("@")[2] in ("", name)
            ),
            environments=tuple(item for item in record.environments if item.id in environments),
            cells=cells,
            published=tuple(
                file for file in record.published if file.path.rpartition("/")[0] in folders
            ),
        ),
    )


def write_dataset(run: Run, name: str, folder: Path, store: Store) -> Run:
    """Write one dataset of a run as a run folder, whose record verifies and replays alone.

    Args:
        run: the whole run.
        name: of the dataset.
        folder: gets a folder of that name, with the record and the published files.
        store: has the products that were embedded and are not in the run's record any more.

    Raises:
        ArgumentError: the run has no such dataset.
        RecordError: the run is damaged.
        StoreError: the disk refuses.
    """
    part = run_of_dataset(run, name)
    target = path_inside(folder, name)
    with writing_to(folder):
        target.mkdir(parents=True)
    sizes = {file.path: file.size_bytes for file in part.record.published}
    copied = set(copy_files(run.folder, target, sizes, sizes))
    record = dataclasses.replace(
        part.record,
        published=tuple(file for file in part.record.published if file.path in copied),
    )
    path = target / RECORD_FILE
    with embedded_inputs(part, folder) as extracted:
        files = {
            file.sha256: place
            for entry in record.inputs
            for file, place in zip(entry.files, extracted.get(entry.name, ()), strict=False)
        }
        try:
            with writing_to(target):
                write_record(
                    path, record, store.product_file, input_file=files.get, earlier=run.path
                )
        except (RecordFormatError, InputFileError) as error:
            raise StoreError(f"{path} cannot be written: {error}") from error
    return Run(path=path, record=record)


def own_cells(run: Run, name: str) -> tuple[RecordedCell, ...]:
    """The cells of one dataset alone, without those that all share."""
    return tuple(cell for cell in run.record.cells if cell.assignment.get(DATA) == name)


def _resolved(run: Run) -> Mapping[str, JsonValue]:
    try:
        document = parse_json(run.record.workflow_resolved)
    except ValueError:
        return {}
    return document if isinstance(document, dict) else {}


def _resolved_of(run: Run, name: str) -> str:
    document = dict(_resolved(run))
    datasets = document[_DATASETS]
    if isinstance(datasets, dict):
        document[_DATASETS] = {name: datasets.get(name)}
    return json.dumps(
        document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )
