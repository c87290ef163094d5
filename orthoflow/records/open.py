"""Functions that open finished and unfinished runs."""

from __future__ import annotations

import atexit
import dataclasses
import json
import shutil
import tempfile
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Final

from orthoflow_provenance.document import (
    CellStatus,
    RecordedCell,
    RecordFormatError,
    from_json,
    parse_json,
)
from orthoflow_provenance.record import write_record

from orthoflow.diagnostics import placement
from orthoflow.engine.journal import RECORD_FILE, kept_from_others, readable_lines
from orthoflow.errors import ArgumentError, CancelledStepError, StoreError
from orthoflow.records.runs import Run, find_record, published_state, read_run
from orthoflow.records.write import (
    OUTLINE_FILE,
    files_of_outputs,
    publish_products,
    recorded_cell,
    recorded_environments,
)

_INTERRUPTED: Final = CancelledStepError.__name__


def open_run(path: str | Path) -> Run:
    """Open a run; if it is unfinished, it contains the results so far.

    Args:
        path: a run folder, or the `run.h5` in this folder.

    Raises:
        ArgumentError: the path does not exist, or the folder contains no run.
        RecordError: the record is damaged, not a record, or of a newer format.
    """
    if has_outline(Path(path)):
        return open_unfinished(Path(path))
    return read_run(find_record(path))


def has_outline(folder: Path) -> bool:
    """Return whether a folder contains a run that has started but has no record yet."""
    return (folder / OUTLINE_FILE).is_file() and not (folder / RECORD_FILE).is_file()


def open_unfinished(folder: Path, *, publish: bool = False) -> Run:
    """Open an unfinished run; cells without a result have the status `skipped`.

    The record is in a temporary folder, which is removed at exit.

    Args:
        folder: run folder.
        publish: whether to write the products of an interrupted run into the run folder. Otherwise,
            the products are written next to the temporary record, unless the run folder already
            contains them.

    Raises:
        ArgumentError: the outline or the store of the run is missing or unreadable, or the run is
            still in progress.
        StoreError: the disk cannot be written to.
    """
    from orthoflow.engine.store import Store  # noqa: PLC0415 - only who looks at such a run

    try:
        content: Any = parse_json((folder / OUTLINE_FILE).read_text("utf-8"), OUTLINE_FILE)
        record = from_json(json.dumps(content["record"]), lambda _: b"")
        store = Store(Path(content["store"]))
        sources, embedded = content["sources"], frozenset(content["embedded"])
    except (OSError, RecordFormatError, KeyError, TypeError) as error:
        raise ArgumentError(
            f"{folder} contains an unfinished run, whose results so far cannot be read: "
            f"{error}; repeat the run with -o {folder} to finish it"
        ) from error
    lines = readable_lines(folder)
    ended = {line.address: line for line in lines if line.event == "finished"}
    found = {address: store.result(line.key) for address, line in ended.items() if line.key}
    results = {address: result for address, result in found.items() if result is not None}

    named = placement((cell.step, cell.method) for cell in record.cells)

    def known(cell: RecordedCell) -> RecordedCell:
        result, line = results.get(cell.address), ended.get(cell.address)
        if result is not None and line is not None:
            texts = tuple(named(one, cell.step) for one in result.diagnostics)
            return recorded_cell(
                cell,
                dataclasses.replace(result, diagnostics=texts),
                store,
                sources=sources.get(cell.address, {}),
                embedded=embedded,
                cached_from=result.run_id if line.cached else "",
            )
        if line is None or not line.error or line.error_type == _INTERRUPTED:
            return cell
        status: CellStatus = "failed" if line.status == "failed" else "skipped"
        return dataclasses.replace(
            cell, status=status, error_type=line.error_type, error_message=line.error
        )

    cells = tuple(map(known, record.cells))
    began = next((line for line in lines if line.event == "run"), None)
    record = dataclasses.replace(
        record,
        # A resumed run keeps the id of its first attempt.
        run_id=began.run_id if began else record.run_id,
        started=began.time if began else record.started,
        ended=lines[-1].time if lines else record.ended,
        status="failed" if any(cell.status == "failed" for cell in cells) else "ok",
        environments=recorded_environments(results),
        cells=cells,
    )
    aside = Path(tempfile.mkdtemp(prefix="orthoflow-"))
    atexit.register(shutil.rmtree, aside, ignore_errors=True)
    files = files_of_outputs(results, store)
    target = folder if publish else aside
    with kept_from_others(folder) if publish else nullcontext():
        published = publish_products(target, record.cells, files, record.run_id)
    path = aside / RECORD_FILE
    try:
        write_record(path, dataclasses.replace(record, published=published), store.product_file)
    except RecordFormatError as error:
        raise StoreError(f"the record of {folder} cannot be assembled: {error}") from error
    # If all published files are already in the run folder, use these.
    is_there = all(published_state(folder, file) == "same" for file in published)
    return dataclasses.replace(
        read_run(path), files_folder=folder if is_there else aside, home=folder
    )
