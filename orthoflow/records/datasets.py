"""One dataset of a run as a run of its own: its cells, and those common to all datasets."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from orthoflow_provenance.document import (
    InputFileError,
    PublishedFile,
    RecordedCell,
    RecordFormatError,
    RunRecord,
)
from orthoflow_provenance.record import write_record

from orthoflow.catalog.discovery import NAME_PATTERN
from orthoflow.engine.durability import writing_to
from orthoflow.engine.journal import RECORD_FILE, cell_file_name
from orthoflow.engine.store import Store
from orthoflow.errors import StoreError
from orthoflow.products.product import JsonValue
from orthoflow.records.input_files import embedded_inputs
from orthoflow.records.published import PRODUCTS_FOLDER
from orthoflow.records.runs import PAGES_FOLDER, Run, copy_files, read_run
from orthoflow.untrusted_text import parse_json
from orthoflow.workflow.model import (
    DATA,
)

_DATASETS = "datasets"


def datasets_of(run: Run) -> tuple[str, ...]:
    """Return the datasets of a run that has cells of them, in order; usually none.

    Names that are invalid are left out, because folders and pages are named after them.
    """
    if not _resolved(run).get(_DATASETS):
        return ()
    named = (cell.assignment[DATA] for cell in run.record.cells if DATA in cell.assignment)
    return tuple(name for name in dict.fromkeys(named) if re.fullmatch(NAME_PATTERN, name))


def parts_of(run: Run) -> dict[str, Run]:
    """Return the part of each dataset of a run, including common cells, as a run of its own.

    Their products are read from the record of the whole run.
    """
    cells: dict[str, list[RecordedCell]] = {name: [] for name in datasets_of(run)}
    for cell in run.record.cells:
        for name in [cell.assignment[DATA]] if DATA in cell.assignment else cells:
            if name in cells:
                cells[name].append(cell)
    published: dict[str, list[PublishedFile]] = {}
    for file in run.record.published:
        published.setdefault(file.path.rpartition("/")[0], []).append(file)
    document = _resolved(run)
    return {
        name: dataclasses.replace(
            run, record=_record_of(run.record, document, name, tuple(own), published)
        )
        for name, own in cells.items()
    }


def _record_of(
    record: RunRecord,
    document: Mapping[str, JsonValue],
    name: str,
    cells: tuple[RecordedCell, ...],
    published: Mapping[str, Sequence[PublishedFile]],
) -> RunRecord:
    taken = {product.source for cell in cells for product in cell.inputs.values()}
    environments = {cell.environment for cell in cells}
    return dataclasses.replace(
        record,
        status="failed" if any(cell.status == "failed" for cell in cells) else "ok",
        workflow_resolved=_resolved_of(document, name),
        inputs=tuple(
            entry
            for entry in record.inputs
            if f"inputs.{entry.name}" in taken or entry.name.partition("@")[2] in ("", name)
        ),
        environments=tuple(item for item in record.environments if item.id in environments),
        cells=cells,
        published=tuple(
            file
            for cell in cells
            for file in published.get(f"{PRODUCTS_FOLDER}/{cell_file_name(cell.address)}", ())
        ),
    )


def write_part(part: Run, folder: Path, store: Store) -> Run:
    """Write one dataset of a run as a run folder, whose record can be verified and replayed alone.

    Args:
        part: from `parts_of`.
        folder: a new folder for the record and the published files.
        store: has the products that were embedded and are no longer in the run's record.

    Raises:
        RecordError: the run is damaged.
        StoreError: the disk cannot be written.
    """
    with writing_to(folder):
        folder.mkdir(parents=True)
    published = part.record.published
    copied = set(copy_files(part.folder, folder, [file.path for file in published], published))
    record = dataclasses.replace(
        part.record,
        published=tuple(file for file in published if file.path in copied),
    )
    path = folder / RECORD_FILE
    with embedded_inputs(part, folder) as laid_out:
        files = {
            file.sha256: place
            for entry in record.inputs
            for file, place in zip(
                entry.files, laid_out.extracted.get(entry.name, ()), strict=False
            )
        }
        try:
            with writing_to(folder):
                write_record(
                    path, record, store.product_file, input_file=files.get, earlier=part.path
                )
        except (RecordFormatError, InputFileError) as error:
            raise StoreError(f"{path} cannot be written: {error}") from error
    return read_run(path)


def pages_of(run: Run) -> dict[str, str]:
    """Return the page of each dataset: name -> path below the run folder, if several."""
    names = datasets_of(run)
    return {name: f"{PAGES_FOLDER}/{name}.html" for name in names} if len(names) > 1 else {}


def _resolved(run: Run) -> Mapping[str, JsonValue]:
    try:
        document = parse_json(run.record.workflow_resolved)
    except ValueError:
        return {}
    return document if isinstance(document, dict) else {}


def _resolved_of(document: Mapping[str, JsonValue], name: str) -> str:
    datasets = document[_DATASETS]
    own = {name: datasets.get(name)} if isinstance(datasets, dict) else datasets
    return json.dumps(
        {**document, _DATASETS: own},
        sort_keys=True,
        separators=(",", ":"),
        ensure_ascii=False,
        allow_nan=False,
    )
