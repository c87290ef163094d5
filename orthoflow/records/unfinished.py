"""A running or interrupted run, as far as it has results: from its outline, journal and store.

The outline is written when a run begins: the record of a run in which nothing was computed yet.
Cells that ended since, according to the journal, come from the store.
"""

from __future__ import annotations

import atexit
import dataclasses
import json
import shutil
import tempfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from orthoflow_provenance.document import (
    CellOutcome,
    Figure,
    ProductRef,
    RecordedCell,
    RecordedEnvironment,
    RecordedFigure,
    RecordedProduct,
    RecordFormatError,
    RunRecord,
    from_json,
    parse_json,
    shared_fields,
    to_json,
)
from orthoflow_provenance.record import write_record

from orthoflow.engine.durability import write_whole, writing_to
from orthoflow.engine.journal import (
    RECORD_FILE,
    readable_lines,
)
from orthoflow.errors import ArgumentError, DamageError, StoreError
from orthoflow.records.published import publish_products
from orthoflow.records.runs import Run, find_record, read_run
from orthoflow.records.verification import published_state

if TYPE_CHECKING:
    from orthoflow.engine.results import CellResult
    from orthoflow.engine.store import Store

OUTLINE_FILE: Final = ".outline.json"


def open_run(path: str | Path) -> Run:
    """Open a run; a running or interrupted one as far as it has results.

    Args:
        path: a run folder, or the `run.h5` in it.

    Raises:
        ArgumentError: nothing is there, or the folder holds no finished run.
        RecordError: the record is damaged, no record at all, or of a newer format.
    """
    if has_outline(Path(path)):
        return open_unfinished(Path(path))
    return read_run(find_record(path))


def write_outline(
    record: RunRecord,
    run_folder: Path,
    store: Store,
    *,
    sources: Mapping[str, Mapping[str, str]],
    embedded: Collection[str],
) -> None:
    """Keep what a run is about to compute, so that it can be shown before it is finished.

    Args:
        record: of the run, with every cell skipped.
        run_folder: existing folder.
        store: where its results go.
        sources: address -> input port -> its source.
        embedded: product types whose arrays go into a record.

    Raises:
        StoreError: the disk cannot be written.
    """
    content = {
        "store": str(store.folder.absolute()),
        "record": to_json(record),
        "sources": {address: dict(ports) for address, ports in sources.items()},
        "embedded": sorted(embedded),
    }
    with writing_to(run_folder):
        write_whole(run_folder / OUTLINE_FILE, json.dumps(content).encode("utf-8", "replace"))


def has_outline(folder: Path) -> bool:
    """Return whether a folder holds a run that began and has no record yet."""
    return (folder / OUTLINE_FILE).is_file() and not (folder / RECORD_FILE).is_file()


def open_unfinished(folder: Path) -> Run:
    """Open an unfinished run; cells without a result yet are skipped in it.

    Its record is in a folder that is removed with this process, as are its published files if the
    run folder does not have them. The run folder is not written to.

    Raises:
        ArgumentError: its outline or its store is missing or unreadable.
        StoreError: the disk cannot be written.
    """
    from orthoflow.engine.store import Store  # noqa: PLC0415 - only who looks at such a run

    try:
        content: Any = parse_json((folder / OUTLINE_FILE).read_text("utf-8"), OUTLINE_FILE)
        record = from_json(RunRecord, content["record"], lambda _: b"")
        store = Store(Path(content["store"]))
        sources, embedded = content["sources"], frozenset(content["embedded"])
    except (OSError, RecordFormatError, KeyError, TypeError) as error:
        raise ArgumentError(
            f"{folder} holds a run that is not finished, and what it has so far cannot be read: "
            f"{error}; repeat the run with -o {folder} to finish it"
        ) from error
    lines = readable_lines(folder)
    ended = [line for line in lines if line.event == "finished"]
    found = {line.address: (line, store.result(line.key)) for line in ended if line.key}
    results = {address: result for address, (_, result) in found.items() if result is not None}
    cached = {address for address, (line, _) in found.items() if line.cached}
    began = next((line for line in lines if line.event == "run"), None)
    record = dataclasses.replace(
        record,
        # A resumed run keeps its first id.
        run_id=began.run_id if began else record.run_id,
        started=began.time if began else record.started,
        ended=lines[-1].time if lines else record.ended,
        status="failed" if any(one.status == "failed" for one in results.values()) else "ok",
        environments=recorded_environments(results),
        cells=tuple(
            recorded_cell(
                cell,
                results[cell.address],
                store,
                sources=sources.get(cell.address, {}),
                embedded=embedded,
                cached_from=results[cell.address].run_id if cell.address in cached else "",
            )
            if cell.address in results
            else cell
            for cell in record.cells
        ),
    )
    aside = Path(tempfile.mkdtemp(prefix="orthoflow-"))
    atexit.register(shutil.rmtree, aside, ignore_errors=True)
    files = {
        address: {port: store.published_files(ref.digest) for port, ref in result.outputs.items()}
        for address, result in results.items()
    }
    published = publish_products(aside, record.cells, files, record.run_id)
    path = aside / RECORD_FILE
    try:
        write_record(path, dataclasses.replace(record, published=published), store.product_file)
    except RecordFormatError as error:
        raise StoreError(f"the record of {folder} cannot be assembled: {error}") from error
    # An interrupted run has left them; a running one is not touched.
    is_there = all(published_state(folder, file) == "same" for file in published)
    return dataclasses.replace(
        read_run(path), files_folder=folder if is_there else aside, home=folder
    )


def recorded_environments(
    results: Mapping[str, CellResult],
) -> tuple[RecordedEnvironment, ...]:
    """Return the environments of results, each once."""
    given = (result.environment for result in results.values())
    return tuple({one.id: one for one in given if one is not None}.values())


def recorded_cell(
    cell: RecordedCell,
    result: CellResult,
    store: Store,
    *,
    sources: Mapping[str, str],
    embedded: Collection[str],
    cached_from: str,
) -> RecordedCell:
    """Return a cell as recorded with its result.

    Args:
        cell: the cell without a result.
        result: what the store keeps of it.
        store: has the figures.
        sources: source of each input port.
        embedded: product types whose arrays go into the record.
        cached_from: the earlier run that computed it, if any.

    Raises:
        DamageError: a figure is missing or damaged.
    """
    figures = []
    for figure in result.figures:
        try:
            data = store.blob(figure.sha256)
        except DamageError as error:
            raise DamageError(f"the figure {figure.name} is damaged") from error
        figures.append(RecordedFigure(data=data, **shared_fields(figure, Figure)))
    return dataclasses.replace(
        cell,
        **shared_fields(result, CellOutcome),
        environment=result.environment.id if result.environment else "",
        cached_from=cached_from,
        figures=tuple(figures),
        inputs={
            port: RecordedProduct(source=sources.get(port, ""), **shared_fields(ref, ProductRef))
            for port, ref in result.inputs.items()
        },
        outputs={
            port: RecordedProduct(
                embedded=ref.type_name in embedded, **shared_fields(ref, ProductRef)
            )
            for port, ref in result.outputs.items()
        },
    )
