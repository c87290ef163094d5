"""A record that needs nothing beside it: every product and every input file inside."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from orthoflow_provenance.errors import RecordFormatError
from orthoflow_provenance.input_files import extract_files
from orthoflow_provenance.writer import write_record

from orthoflow.engine.durability import writing_to
from orthoflow.engine.file_digests import FileDigests
from orthoflow.errors import InputError, StoreError
from orthoflow.records.input_search import find_inputs
from orthoflow.records.runs import Run, record_errors
from orthoflow.workflow.resolved import workflow_from_resolved

if TYPE_CHECKING:
    from orthoflow.engine import Store


@contextmanager
def embedded_inputs(run: Run, beside: Path) -> Iterator[Mapping[str, tuple[Path, ...]]]:
    """Give the input files that lie in a record as files, as long as the context lasts.

    Args:
        run: the run.
        beside: folder on a disk with room for them, made when missing.

    Raises:
        RecordError: the record is damaged.
        StoreError: the disk refuses.
    """
    if not any(entry.embedded for entry in run.record.inputs):
        yield {}
        return
    with writing_to(beside):
        beside.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".inputs-", dir=beside) as folder:
        with record_errors(run.path), writing_to(Path(folder)):
            files = extract_files(run.path, run.record.inputs, Path(folder))
        yield files


def write_embedded(run: Run, path: Path, store: Store, inputs: Sequence[str] = ()) -> Run:
    """Write the record of a run again with every product and every input file in it.

    Args:
        run: the run.
        path: the new record; its folder exists.
        store: holds the products that the run's record names by digest only.
        inputs: `NAME=PATH`, each as behind `--input`; other files are looked for by content.

    Returns:
        The run, with the new record.

    Raises:
        InputError: an input file is missing or was changed.
        StoreError: a product is in neither record nor store, or the disk refuses.
        InvalidArgumentsError: `inputs` names no input of the workflow.
    """
    _check_products(run, store)
    with embedded_inputs(run, path.parent) as extracted:
        files = _input_files(run, store.file_digests(), inputs, extracted)
        record = dataclasses.replace(
            run.record,
            inputs=tuple(
                dataclasses.replace(entry, embedded=bool(entry.files))
                for entry in run.record.inputs
            ),
            cells=tuple(
                dataclasses.replace(
                    cell,
                    outputs={
                        port: dataclasses.replace(output, embedded=True)
                        for port, output in cell.outputs.items()
                    },
                )
                for cell in run.record.cells
            ),
        )
        try:
            with writing_to(path.parent):
                write_record(
                    path, record, store.product_file, input_file=files.get, earlier=run.path
                )
        except RecordFormatError as error:
            raise StoreError(f"{path} cannot be written: {error}") from error
    return Run(path=path, record=record)


def _check_products(run: Run, store: Store) -> None:
    missing = [
        f"{address}.{port} ({output.digest})"
        for address, cell in run.cells.items()
        for port, output in cell.outputs.items()
        if not output.embedded and store.product_file(output.digest) is None
    ]
    if missing:
        raise StoreError(
            f"neither the record {run.path} nor the store {store.folder} has "
            f"{', '.join(missing)}: name the store of the run with --store, or replay the run"
        )


def _input_files(
    run: Run,
    digests: FileDigests,
    given: Sequence[str],
    extracted: Mapping[str, tuple[Path, ...]],
) -> dict[str, Path]:
    record = run.record
    workflow = workflow_from_resolved(record.workflow_resolved, record.workflow_source)
    search = find_inputs(
        workflow, record.inputs, run.folder, digests, given=given, extracted=extracted
    )
    if search.problems:
        raise InputError("; ".join(search.problems))
    return {
        file.sha256: place
        for entry in record.inputs
        for file, place in zip(entry.files, search.paths[entry.name], strict=True)
    }
