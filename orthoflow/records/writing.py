"""Writing a finished run: published products, then the record, whose name marks completion."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Final

from orthoflow_provenance.document import (
    InputFileError,
    MethodIdentity,
    RecordedCell,
    RecordedFile,
    RecordedInput,
    RecordFormatError,
    RunRecord,
    shared_fields,
)
from orthoflow_provenance.record import write_record

from orthoflow.engine.durability import sync_folder, sync_tree, writing_to
from orthoflow.engine.file_digests import FileDigests
from orthoflow.engine.journal import RECORD_FILE, kept_from_others
from orthoflow.engine.results import CellResult
from orthoflow.errors import ArgumentError, DamageError, InputError, OrthoflowError, StoreError
from orthoflow.records.input_files import ChangedInputsError, embedded_inputs, find_inputs
from orthoflow.records.published import publish_products
from orthoflow.records.runs import Run, read_run
from orthoflow.records.unfinished import (
    OUTLINE_FILE,
    recorded_cell,
    recorded_environments,
    write_outline,
)
from orthoflow.untrusted_text import first_few
from orthoflow.version import __version__
from orthoflow.workflow.inputs import MissingInputsError
from orthoflow.workflow.resolved import (
    resolved_json,
    workflow_from_resolved,
)

if TYPE_CHECKING:
    from orthoflow.engine.plan import RunPlan
    from orthoflow.engine.scheduler import RunOutcome
    from orthoflow.engine.store import Store
    from orthoflow.workflow.expand import Cell
    from orthoflow.workflow.model import (
        Workflow,
    )

_UNFINISHED: Final = f".{RECORD_FILE}.unfinished"
_MOST_ATTEMPTS: Final = 4
NOT_YET: Final = "not computed yet: the run was interrupted"


@dataclass(frozen=True, kw_only=True)
class WrittenRun:
    """A run that was executed, and its record.

    Attributes:
        run: the finished run.
        outcome: the result of the engine.
        kept: addresses that the run folder already had, from an interrupted attempt.
    """

    run: Run
    outcome: RunOutcome
    kept: frozenset[str] = frozenset()


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

    `run.h5` gets its name last: a folder with it is finished, everything else is written again by
    the same command.

    Args:
        outcome: the result of the engine.
        plan: the plan of the run.
        workflow: the document of the plan.
        run_folder: the folder, created if missing.
        store: holds the products and pictures of the run.
        embed: put every product into the record, including large ones, and the input files.
        before_finish: called with the run before the record gets its name, e.g. for the report.

    Returns:
        The finished run.

    Raises:
        DamageError: something that the record needs was damaged in the store; it has been set
            aside, and the same run, continued, computes it again.
        StoreError: the disk cannot be written, or a step could not read or write it.
        InputError: an input file to embed was changed during the run.
        ArgumentError: another run uses the folder.
    """
    _check_failures(outcome, run_folder)
    try:
        with kept_from_others(run_folder):
            return _write_run(
                outcome, plan, workflow, run_folder, store, embed=embed, before_finish=before_finish
            )
    except StoreError as error:
        needed = [name for result in outcome.results.values() for name in result.objects]
        damaged = store.damaged_objects(needed)
        if not damaged and not isinstance(error, DamageError):
            raise
        raise DamageError(
            f"the store {store.folder} does not hold any more what the record needs ({error}); the "
            f"same command with -o {run_folder} computes it again"
        ) from error


def _check_failures(outcome: RunOutcome, run_folder: Path) -> None:
    """Refuse to finish a run in which a step failed because of the disk, not of its method."""
    for address, result in outcome.failed.items():
        if result.error_type in (StoreError.__name__, DamageError.__name__):
            raise StoreError(
                f"{address} failed: {result.error_message}; finished steps are kept, and "
                f"the same command with -o {run_folder} goes on from there"
            )


def _write_run(
    outcome: RunOutcome,
    plan: RunPlan,
    workflow: Workflow,
    run_folder: Path,
    store: Store,
    *,
    embed: bool,
    before_finish: Callable[[Run], None] | None,
) -> Run:
    unfinished = _publish(outcome, plan, workflow, run_folder, store, embed=embed)
    with writing_to(run_folder):
        if before_finish is not None:
            before_finish(_under_way(unfinished))
        # Everything that the record names must exist before the record gets its name.
        sync_tree(run_folder)
        finished = unfinished.replace(run_folder / RECORD_FILE)
        (run_folder / OUTLINE_FILE).unlink(missing_ok=True)
        sync_folder(run_folder)
    return read_run(finished)


def _publish(
    outcome: RunOutcome,
    plan: RunPlan,
    workflow: Workflow,
    run_folder: Path,
    store: Store,
    *,
    embed: bool,
) -> Path:
    """Fill `products/` and write the record under its temporary name."""
    record = build_record(outcome, plan, workflow, store, embed=embed)
    with writing_to(run_folder):
        run_folder.mkdir(parents=True, exist_ok=True)
    published = publish_products(
        run_folder, record.cells, _published(outcome, store), record.run_id
    )
    record = dataclasses.replace(record, published=published)
    unfinished = run_folder / _UNFINISHED
    with writing_to(run_folder):
        for leftover in run_folder.glob(f".*{RECORD_FILE}.*"):
            leftover.unlink()
        _write_record(unfinished, record, store, plan, embed=embed)
    return unfinished


def _under_way(unfinished: Path) -> Run:
    return read_run(unfinished, later_name=RECORD_FILE)


def show_unfinished(
    outcome: RunOutcome,
    plan: RunPlan,
    workflow: Workflow,
    run_folder: Path,
    store: Store,
    show: Callable[[Run], None],
) -> bool:
    """Publish and show the results of an interrupted run; the run stays unfinished.

    Args:
        outcome: the results, as passed by `execute` to `on_interruption`.
        plan: the plan of the run.
        workflow: the document of the plan.
        run_folder: its folder.
        store: holds the products and pictures.
        show: called with a run whose record is temporary, e.g. to write the report; cells without a
            result yet are skipped in it.

    Returns:
        False if it cannot be shown, e.g. on a full disk: the run itself loses nothing.
    """
    whole = _with_missing(outcome, plan)
    try:
        unfinished = _publish(whole, plan, workflow, run_folder, store, embed=False)
        try:
            show(_under_way(unfinished))
        finally:
            unfinished.unlink(missing_ok=True)
    except (OrthoflowError, OSError):
        return False
    return True


def begin_run(
    plan: RunPlan, workflow: Workflow, run_folder: Path, store: Store, run_id: str
) -> None:
    """Keep the outline of a run that begins, see `records.unfinished`.

    Raises:
        StoreError: the disk cannot be written.
    """
    from orthoflow.engine.environment import now  # noqa: PLC0415 - runs alone begin
    from orthoflow.engine.scheduler import RunOutcome  # noqa: PLC0415

    began = now()
    outcome = RunOutcome(run_id=run_id, started=began, ended=began, results={})
    write_outline(
        build_record(_with_missing(outcome, plan), plan, workflow, store),
        run_folder,
        store,
        sources={item.cell.address: _sources(item.cell) for item in plan.cells},
        embedded=_embedded_types(plan),
    )


def _sources(cell: Cell) -> dict[str, str]:
    return {port: str(source) for port, source in cell.inputs.items()}


def _embedded_types(plan: RunPlan, *, embed: bool = False) -> frozenset[str]:
    """Return the product types whose arrays go into a record."""
    specs = plan.products.items()
    return frozenset(name for name, one in specs if embed or resolve_name(one.target).embedded)


def _with_missing(outcome: RunOutcome, plan: RunPlan) -> RunOutcome:
    """Return an outcome in which cells without a result yet are skipped."""
    missing = {
        item.cell.address: CellResult(
            status="skipped",
            run_id=outcome.run_id,
            error_message=item.cell.skip_reason or NOT_YET,
            **shared_fields(
                plan.methods.get(item.cell.method) or MethodIdentity(method=item.cell.method),
                MethodIdentity,
            ),
        )
        for item in plan.cells
        if item.cell.address not in outcome.results
    }
    return dataclasses.replace(outcome, results={**outcome.results, **missing})


def executed_and_written(
    execute: Callable[[], RunOutcome], write: Callable[[RunOutcome], Run]
) -> WrittenRun:
    """Execute a run and write it; results that the store has lost are computed again.

    Args:
        execute: continues the run each time it is called, as `engine.scheduler.execute` does.
        write: calls `write_run`.

    Raises:
        DamageError: the store loses results faster than they can be computed.
    """
    outcome = execute()
    kept = outcome.resumed
    for _ in range(_MOST_ATTEMPTS - 1):
        with suppress(DamageError):
            return WrittenRun(run=write(outcome), outcome=outcome, kept=kept)
        outcome = execute()
        # Results of the first attempt are cached in the second.
        kept &= outcome.resumed
    return WrittenRun(run=write(outcome), outcome=outcome, kept=kept)


def _write_record(
    path: Path, record: RunRecord, store: Store, plan: RunPlan, *, embed: bool
) -> None:
    files = {
        file.sha256: place
        for given in plan.inputs.values()
        if given is not None
        for file, place in zip(given.files, given.paths, strict=True)
    }
    try:
        write_record(path, record, store.product_file, embed=embed, input_file=files.get)
    except InputFileError as error:
        raise InputError(f"{error}: run again") from error
    except RecordFormatError as error:
        raise StoreError(
            f"the record cannot be assembled from the store {store.folder}: {error}"
        ) from error


def build_record(
    outcome: RunOutcome,
    plan: RunPlan,
    workflow: Workflow,
    store: Store,
    *,
    embed: bool = False,
) -> RunRecord:
    """Convert the engine's outcome into a record.

    Raises:
        DamageError: the store lost a picture of the run.
    """
    # Deliberate omissions are not differences of the results; the record states them.
    overrides = (*workflow.overrides, *plan.options.selection.options)
    workflow = dataclasses.replace(workflow, overrides=overrides)
    results = outcome.results
    embedded = _embedded_types(plan, embed=embed)
    cells = tuple(
        recorded_cell(
            RecordedCell(
                status="skipped",
                address=cell.address,
                step=cell.step,
                assignment=dict(cell.assignment),
                repeat=cell.repeat,
                params=dict(cell.params),
                params_set=dict(cell.params_set),
            ),
            results[cell.address],
            store,
            sources=_sources(cell),
            embedded=embedded,
            cached_from=outcome.cached.get(cell.address, ""),
        )
        for cell in (item.cell for item in plan.cells)
        if cell.address in results
    )
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
    """Write the record of a run again with every product and every input file in it.

    Args:
        run: the run.
        path: the new record; its folder exists.
        store: holds the products that the run's record names by digest only.
        inputs: `NAME=PATH`, each as after `--input`; other files are searched by content.

    Returns:
        The run, with the new record.

    Raises:
        InputError: an input file is missing.
        ChangedInputsError: an input file was changed.
        ArgumentError: a product is in neither record nor store.
        StoreError: the disk cannot be written.
        InvalidArgumentsError: `inputs` names no input of the workflow.
    """
    _check_products(run, store)
    with embedded_inputs(run, path.parent) as laid_out:
        files = _input_files(run, store.file_digests(), inputs, laid_out.extracted)
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
    return read_run(path)


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


def _published(outcome: RunOutcome, store: Store) -> dict[str, dict[str, Mapping[Path, str]]]:
    return {
        address: {port: store.published_files(ref.digest) for port, ref in result.outputs.items()}
        for address, result in outcome.results.items()
    }


def _check_products(run: Run, store: Store) -> None:
    missing = [
        f"{address}.{port}"
        for address, cell in run.cells.items()
        for port, output in cell.outputs.items()
        if not output.embedded and store.product_file(output.digest) is None
    ]
    if missing:
        raise ArgumentError(
            f"neither the record {run.path} nor the store {store.folder} has "
            f"{first_few(missing)}: name the store of the run with --store, or replay the run"
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
        raise ChangedInputsError(search.problems)
    if search.problems:
        raise MissingInputsError(search.problems)
    return {
        file.sha256: place
        for entry in record.inputs
        for file, place in zip(entry.files, search.paths[entry.name], strict=True)
    }
