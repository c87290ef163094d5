"""Functions that write a run: first the published files, then the record, which completes it."""

from __future__ import annotations

import dataclasses
import json
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Final

from orthoflow_provenance.document import (
    CellOutcome,
    Figure,
    InputFileError,
    MethodIdentity,
    ProductRef,
    PublishedFile,
    RecordedCell,
    RecordedEnvironment,
    RecordedFigure,
    RecordedFile,
    RecordedInput,
    RecordedProduct,
    RecordFormatError,
    RunRecord,
    shared_fields,
    to_json,
)
from orthoflow_provenance.paths import colliding, path_below
from orthoflow_provenance.record import write_record

from orthoflow.engine.durability import sync, sync_tree, write_whole, writing_to
from orthoflow.engine.file_digests import FileDigests, file_sha256
from orthoflow.engine.journal import (
    RECORD_FILE,
    cell_file_name,
    kept_from_others,
)
from orthoflow.engine.results import CellResult
from orthoflow.engine.store import Store, publish_into
from orthoflow.errors import (
    ArgumentError,
    DamageError,
    InputError,
    StoreError,
)
from orthoflow.files.geotiff import name_run
from orthoflow.geometry.threads import in_order
from orthoflow.products import (
    Orthoimages,
    Walls,
)
from orthoflow.records.inputs import RefusedRunError, embedded_inputs, find_inputs
from orthoflow.records.runs import (
    METRICS_FILE,
    PRODUCTS_FOLDER,
    Run,
    cell_metrics,
    copy_files,
    read_run,
    write_metrics_csv,
)
from orthoflow.records.walls import add_errors, write_walls_json
from orthoflow.untrusted_text import first_few
from orthoflow.version import __version__
from orthoflow.workflow.inputs import MissingInputsError
from orthoflow.workflow.views import resolved_json, workflow_from_resolved

if TYPE_CHECKING:
    from orthoflow.engine.plan import RunPlan
    from orthoflow.engine.results import CellResult
    from orthoflow.engine.scheduler import RunOutcome
    from orthoflow.engine.store import Store
    from orthoflow.workflow.expand import Cell
    from orthoflow.workflow.model import Workflow


def publish_products(
    run_folder: Path,
    cells: Iterable[RecordedCell],
    files_of: Mapping[str, Mapping[str, Mapping[Path, str]]],
    run_id: str,
) -> tuple[PublishedFile, ...]:
    """Write `products/` of a run folder, replacing files of an interrupted attempt.

    Args:
        run_folder: existing folder.
        cells: all cells of the run.
        files_of: address -> output port -> file in the store -> expected SHA-256.
        run_id: id of the run, which is inserted into the names of wall coordinate systems.

    Returns:
        The published files, sorted by path.

    Raises:
        StoreError: a file does not match its digest, or cannot be copied, e.g. because the disk is
            full.
    """
    target = run_folder / PRODUCTS_FOLDER
    cells = tuple(cells)
    with writing_to(target):
        if target.is_symlink():
            target.unlink()
        # Do not ignore other errors, because files that remain would be published as part of this
        # run.
        with suppress(FileNotFoundError):
            shutil.rmtree(target)
        target.mkdir(parents=True, exist_ok=True)
        replaced = _replaced(cells)
        for cell in cells:
            if cell.status == "ok":
                folder = path_below(target, cell_file_name(cell.address))
                ports = files_of.get(cell.address, {})
                current = {
                    port: files
                    for port, files in ports.items()
                    if f"{cell.address}.{port}" not in replaced
                }
                _publish_cell(folder, cell, current, run_id)
                add_errors(folder, cell.address, cells)
        write_walls_json(target, cells)
        rows = [row for cell in cells for row in cell_metrics(cell)]
        write_metrics_csv(target / METRICS_FILE, rows)
        return _digested(run_folder, target)


def _digested(run_folder: Path, target: Path) -> tuple[PublishedFile, ...]:
    paths = sorted(path for path in target.rglob("*") if path.is_file())
    digests = list(in_order(file_sha256, paths))
    return tuple(
        PublishedFile(
            path=path.relative_to(run_folder).as_posix(),
            size_bytes=path.stat().st_size,
            sha256=digest,
        )
        for path, digest in zip(paths, digests, strict=True)
    )


def _replaced(cells: Iterable[RecordedCell]) -> set[str]:
    """Return the outputs, as `address.port`, that a later cell replaces by one of the same type.

    A replaced output, such as planes whose sides are determined later, would contradict its
    replacement. Products read from files are not replaced.
    """
    made = {
        cell.address
        for cell in cells
        if any(not given.source.startswith("inputs.") for given in cell.inputs.values())
    }
    return {
        given.source
        for cell in cells
        if cell.status == "ok"
        for given in cell.inputs.values()
        for output in cell.outputs.values()
        if output.type_name == given.type_name
        and output.digest != given.digest
        and given.source.rpartition(".")[0] in made
    }


def _publish_cell(
    folder: Path,
    cell: RecordedCell,
    files_of: Mapping[str, Mapping[Path, str]],
    run_id: str,
) -> None:
    folder.mkdir()
    taken = [METRICS_FILE]
    for port, files in files_of.items():
        for file, sha256 in files.items():
            # Two outputs of the same type publish files with the same names, which are made unique
            # by the port.
            marks = chain(("", f"{port}_"), (f"{port}_{number}_" for number in count(2)))
            names = (f"{mark}{file.name}" for mark in marks)
            name = next(name for name in names if not colliding([*taken, name]))
            taken.append(name)
            # Do not create hard links, so that editing a published file does not change the store.
            copy = path_below(folder, name)
            shutil.copyfile(file, copy)
            if (found := file_sha256(copy)) != sha256:
                raise StoreError(f"{copy} must have the digest {sha256}, got {found}")
            name_run(copy, run_id)
    write_metrics_csv(folder / METRICS_FILE, cell_metrics(cell))


OUTLINE_FILE: Final = ".outline.json"


def recorded_environments(
    results: Mapping[str, CellResult],
) -> tuple[RecordedEnvironment, ...]:
    """Return the environments in which results were computed, without duplicates."""
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
    """Return the record entry of a cell with its result.

    Args:
        cell: the cell's entry, which has no result yet.
        result: result of the cell in the store.
        store: store with the figures.
        sources: input port -> source of the input.
        embedded: product types whose arrays are written into the record.
        cached_from: id of the earlier run that computed the result; empty if this run did.

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


_UNFINISHED: Final = f".{RECORD_FILE}.unfinished"
_MOST_ATTEMPTS: Final = 4
# This is the `error_type` of cells that an unfinished run has not computed yet.
NOT_YET: Final = "not-computed-yet"


def write_run(
    outcome: RunOutcome,
    plan: RunPlan,
    workflow: Workflow,
    run_folder: Path,
    store: Store,
    *,
    embed: bool = False,
    before_finish: Callable[[Run], None] | None = None,
) -> Run:
    """Write `products/` and `run.h5` of a run.

    `run.h5` gets its name last. A folder that contains it is finished; in any other folder,
    repeating the command writes all files again.

    Args:
        outcome: outcome of the engine.
        plan: plan of the run.
        workflow: workflow of the plan.
        run_folder: run folder, created if missing.
        store: store with the products and figures of the run.
        embed: whether to write all products, including large ones, and the input files into the
            record.
        before_finish: called with the run before the record gets its name, e.g. to write the
            report.

    Returns:
        The finished run.

    Raises:
        DamageError: an object that the record needs was damaged in the store and has been removed;
            resuming the run recomputes it.
        StoreError: the disk cannot be written to, or a step could not read from it or write to it.
        InputError: an input file to embed was changed during the run.
        ArgumentError: another run is using the folder.
    """
    for address, result in outcome.failed.items():
        # These errors mean that the disk has failed, not the method.
        if result.error_type in (StoreError.__name__, DamageError.__name__):
            raise StoreError(
                f"{address} failed: {result.error_message}; finished steps are kept: to continue, "
                f"repeat the command with -o {run_folder}"
            )
    try:
        with kept_from_others(run_folder):
            unfinished = _publish(outcome, plan, workflow, run_folder, store, embed=embed)
            with writing_to(run_folder):
                run = read_run(unfinished)
                if before_finish is not None:
                    before_finish(run)
                # Flush all files to the disk before the record, which references them, gets its
                # name.
                sync_tree(run_folder)
                finished = unfinished.replace(run_folder / RECORD_FILE)
                (run_folder / OUTLINE_FILE).unlink(missing_ok=True)
                sync(run_folder)
            return replace(run, path=finished)
    except StoreError as error:
        needed = [name for result in outcome.results.values() for name in result.objects]
        damaged = [name for name in needed if store.damage(name)]
        if not damaged and not isinstance(error, DamageError):
            raise
        raise DamageError(
            f"the store {store.folder} has lost data that the record needs ({error}); to "
            f"recompute the data, repeat the command with -o {run_folder}"
        ) from error


def _publish(
    outcome: RunOutcome,
    plan: RunPlan,
    workflow: Workflow,
    run_folder: Path,
    store: Store,
    *,
    embed: bool,
) -> Path:
    record = build_record(outcome, plan, workflow, store, embed=embed)
    given = {
        file.sha256: place
        for entry in plan.inputs.values()
        if entry is not None
        for file, place in zip(entry.files, entry.paths, strict=True)
    }
    unfinished = run_folder / _UNFINISHED
    with writing_to(run_folder):
        run_folder.mkdir(parents=True, exist_ok=True)
        files = files_of_outputs(outcome.results, store)
        published = publish_products(run_folder, record.cells, files, record.run_id)
        record = dataclasses.replace(record, published=published)
        for leftover in run_folder.glob(f".*{RECORD_FILE}.*"):
            leftover.unlink()
        try:
            write_record(unfinished, record, store.product_file, embed=embed, input_file=given.get)
        except InputFileError as error:
            raise InputError(f"{error}: run again") from error
        except RecordFormatError as error:
            raise StoreError(
                f"the record cannot be assembled from the store {store.folder}: {error}"
            ) from error
    return unfinished


def files_of_outputs(
    results: Mapping[str, CellResult], store: Store
) -> dict[str, dict[str, Mapping[Path, str]]]:
    """Return address -> port -> file in the store -> SHA-256 for the published files."""
    return {
        address: {port: store.published_files(ref.digest) for port, ref in result.outputs.items()}
        for address, result in results.items()
    }


def begin_run(
    plan: RunPlan, workflow: Workflow, run_folder: Path, store: Store, run_id: str
) -> None:
    """Write the outline of a run at its start.

    The outline contains the record with all cells skipped; `open.open_unfinished` uses it to show
    the run before it is finished.

    Raises:
        StoreError: the disk cannot be written to.
    """
    from orthoflow.engine.environment import now  # noqa: PLC0415 - runs alone begin
    from orthoflow.engine.scheduler import RunOutcome  # noqa: PLC0415

    began = now()
    outcome = RunOutcome(run_id=run_id, started=began, ended=began, results={})
    content = {
        "store": str(store.folder.absolute()),
        "record": to_json(build_record(outcome, plan, workflow, store)),
        "sources": {item.cell.address: _sources(item.cell) for item in plan.cells},
        "embedded": sorted(_embedded_types(plan)),
    }
    with writing_to(run_folder):
        write_whole(run_folder / OUTLINE_FILE, json.dumps(content).encode("utf-8", "replace"))


def _sources(cell: Cell) -> dict[str, str]:
    return {port: str(source) for port, source in cell.inputs.items()}


def _embedded_types(plan: RunPlan, *, embed: bool = False) -> frozenset[str]:
    specs = plan.products.items()
    return frozenset(name for name, one in specs if embed or resolve_name(one.target).embedded)


def executed_and_written(
    execute: Callable[[], RunOutcome], write: Callable[[RunOutcome], Run]
) -> tuple[RunOutcome, Run]:
    """Execute a run and write it; recompute results that turn out to be damaged in the store.

    Args:
        execute: function that resumes the run at each call, as `engine.scheduler.execute` does.
        write: function that calls `write_run`.

    Raises:
        DamageError: results in the store were found to be damaged at every attempt.
    """
    for _ in range(_MOST_ATTEMPTS - 1):
        with suppress(DamageError):
            outcome = execute()
            return outcome, write(outcome)
    outcome = execute()
    return outcome, write(outcome)


def build_record(
    outcome: RunOutcome,
    plan: RunPlan,
    workflow: Workflow,
    store: Store,
    *,
    embed: bool = False,
) -> RunRecord:
    """Convert the outcome of the engine into a record; cells without a result are skipped.

    Raises:
        DamageError: a figure of the run is missing or damaged in the store.
    """
    # Record deselected steps as an option, so that they do not count as differences in results.
    overrides = (*workflow.overrides, *plan.options.words)
    workflow = dataclasses.replace(workflow, overrides=overrides)
    results = outcome.results
    embedded = _embedded_types(plan, embed=embed)

    def recorded(cell: Cell) -> RecordedCell:
        identity = plan.methods.get(cell.method) or MethodIdentity(method=cell.method)
        found = RecordedCell(
            status="skipped",
            error_type=NOT_YET,
            error_message="not computed yet",
            address=cell.address,
            step=cell.step,
            assignment=dict(cell.assignment),
            repeat=cell.repeat,
            params=dict(cell.params),
            params_set=dict(cell.params_set),
            **shared_fields(identity, MethodIdentity),
        )
        if cell.address not in results:
            return found
        return recorded_cell(
            found,
            results[cell.address],
            store,
            sources=_sources(cell),
            embedded=embedded,
            cached_from=outcome.cached.get(cell.address, ""),
        )

    cells = tuple(recorded(item.cell) for item in plan.cells)
    return RunRecord(
        run_id=outcome.run_id,
        name=workflow.name,
        created_by=f"orthoflow {__version__}",
        status="failed" if any(cell.status == "failed" for cell in cells) else "ok",
        started=outcome.started,
        ended=outcome.ended,
        seed=workflow.seed,
        workflow_source=workflow.source,
        workflow_resolved=resolved_json(workflow),
        overrides=overrides,
        inputs=_recorded_inputs(plan, embed=embed),
        environments=recorded_environments(results),
        cells=cells,
    )


def write_embedded(run: Run, path: Path, store: Store, inputs: Sequence[str] = ()) -> Run:
    """Write another record of a run, with all products and input files embedded.

    Args:
        run: the run.
        path: path of the new record, in an existing folder.
        store: store that contains the products that the run's record references only by digest.
        inputs: inputs as `NAME=PATH`, as for `--input`; other input files are located by their
            content.

    Returns:
        The run with the new record, and with the files of the original run.

    Raises:
        InputError: an input file is missing.
        RefusedRunError: an input file was changed.
        ArgumentError: a product is neither in the record nor in the store.
        StoreError: the disk cannot be written to.
        InvalidArgumentsError: `inputs` contains a name that is not an input of the workflow.
    """
    missing = [
        f"{address}.{port}"
        for address, cell in run.cells.items()
        for port, output in cell.outputs.items()
        if not output.embedded and store.product_file(output.digest) is None
    ]
    if missing:
        raise ArgumentError(
            f"neither the record {run.path} nor the store {store.folder} contains "
            f"{first_few(missing)}: give the store of the run with --store, or replay the run"
        )
    whole = tuple(
        dataclasses.replace(entry, embedded=bool(entry.files)) for entry in run.record.inputs
    )
    with embedded_inputs(run, path.parent) as placed:
        files = _input_files(run, store.file_digests(), inputs, placed.extracted)
        _write_again(path, dataclasses.replace(run.record, inputs=whole), run, store, files)
    return replace(read_run(path), files_folder=run.folder)


def _write_again(
    path: Path,
    record: RunRecord,
    run: Run,
    store: Store,
    files: Mapping[str, Path],
    *,
    embed: bool = True,
) -> None:
    try:
        with writing_to(path.parent):
            write_record(
                path,
                record,
                store.product_file,
                embed=embed,
                input_file=files.get,
                earlier=run.path,
            )
    except (RecordFormatError, InputFileError) as error:
        raise StoreError(f"cannot write {path}: {error}") from error


def _recorded_inputs(plan: RunPlan, *, embed: bool) -> tuple[RecordedInput, ...]:
    return tuple(
        RecordedInput(
            name=name,
            files=tuple(
                RecordedFile(**shared_fields(file, RecordedFile))
                for file in (given.files if given is not None else ())
            ),
            embedded=embed and given is not None,
        )
        for name, given in plan.inputs.items()
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
    if search.is_changed:
        raise RefusedRunError(search.problems)
    if search.problems:
        raise MissingInputsError(search.problems)
    return {
        file.sha256: place
        for entry in record.inputs
        for file, place in zip(entry.files, search.paths[entry.name], strict=True)
    }


def write_part(part: Run, folder: Path, store: Store) -> Run:
    """Write one dataset as a run folder whose record can be verified and replayed by itself.

    Args:
        part: part from `parts_of`.
        folder: new folder for the record and the published files.
        store: store with the products that are missing from the run's record.

    Raises:
        RecordError: the run is damaged.
        StoreError: the disk cannot be written to.
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
    with embedded_inputs(part, folder) as placed:
        files = {
            file.sha256: place
            for entry in record.inputs
            for file, place in zip(entry.files, placed.extracted.get(entry.name, ()), strict=False)
        }
        _write_again(path, record, part, store, files, embed=False)
    return read_run(path)


_TYPES: Final = frozenset((Orthoimages.type_name, Walls.type_name))


@contextmanager
def with_files(run: Run, report: Callable[[str], None] = lambda _: None) -> Iterator[Run]:
    """Yield a run together with its published rasters.

    Files next to the record are used if there are any. Otherwise, they are created from the walls
    and orthoimages in the record, in a temporary folder that is removed after the block.

    Args:
        run: the run.
        report: called with a sentence if files are created.

    Raises:
        RecordError: the record is damaged.
        StoreError: the disk cannot be written to.
    """
    published = run.record.published
    if not published or any((run.folder / file.path).exists() for file in published):
        yield run
        return
    with tempfile.TemporaryDirectory(prefix="orthoflow-") as name, run.held_open() as opened:
        scratch = Path(name)
        if not (files_of := _made_again(opened, scratch / "made")):
            yield run
            return
        folder = scratch / "run"
        folder.mkdir()
        made = publish_products(folder, run.record.cells, files_of, run.record.run_id)
        report(
            f"{run.path} has no files next to it: its rasters are recreated from its products, and "
            "other published files are omitted"
        )
        record = replace(run.record, published=made)
        yield replace(opened, record=record, files_folder=folder)


def _made_again(run: Run, folder: Path) -> dict[str, dict[str, dict[Path, str]]]:
    from orthoflow.catalog.discovery import discover_catalog  # noqa: PLC0415 - loads plugins

    catalog = discover_catalog()
    found: dict[str, dict[str, dict[Path, str]]] = {}
    for address, cell in run.cells.items():
        for port, output in cell.outputs.items():
            if output.type_name not in _TYPES or not output.embedded:
                continue
            publish = catalog.publisher(output.type_name)
            if publish is None:
                continue
            own = folder / str(len(found)) / port
            publish_into(own, run.product(address, port), publish, output.digest)
            files = sorted(path for path in own.rglob("*") if path.is_file())
            found.setdefault(address, {})[port] = {path: file_sha256(path) for path in files}
    return found
