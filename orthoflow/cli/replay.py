"""`orthoflow replay`: repeat a run from its record and measure the differences."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from orthoflow.cli.commands import (
    DEFAULT_STORE,
    EXIT_GOOD,
    EXIT_RECORD_DIFFERS,
    RecordCommand,
    echo_error,
    execution_options,
    input_option,
    json_option,
    output_option,
)
from orthoflow.cli.run import executed
from orthoflow.cli.tables import (
    ROWS_MOST,
    counted,
    echo,
    echo_distances,
    echo_json,
    echo_table,
)
from orthoflow.errors import CancelledStepError, ClusterError

if TYPE_CHECKING:
    from orthoflow.records.replay import ReplayedMetric

_NOTHING: Final = "-"
# Verdict -> reason why the values of a metric differ.
_CAUSES: Final = {
    "different": "unknown: the products of its step are identical",
    "code changed": "the code of a method on which it depends has changed",
    "products": "the products of its step differ",
    "not in the record": "not in the record",
    "rounding": "rounding",
}


@click.command(cls=RecordCommand)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@input_option
@output_option("<name>-replay-<run id>")
@click.option(
    "--store",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Folder of stored results; by default an empty one, so that everything is recomputed.",
)
@execution_options
@json_option
def replay(
    run: Path,
    inputs: Sequence[str],
    output: Path | None,
    store: Path | None,
    *,
    as_json: bool,
    # These options belong to `RunOptions`; click has checked their types.
    **choices: Any,
) -> int:
    """Repeat RUN, a run folder or its run.h5, from its record and its input files.

    Workflow, parameters and seeds are taken from the record. Inputs that are not in the record are
    located by their content. Files at the paths given with --input may have any name. Without
    --input, the files are looked for where the store in .orthoflow last found them, and at the
    paths in the workflow, relative to the working directory and to the run. Missing and changed
    files are reported before anything runs.

    The output states for every product whether it is identical, equal within the tolerance of its
    type, or different. It also lists the metrics that differ, apart from times and memory. The exit
    code is 3 if a product differs, or if a metric differs (a count by any amount, other numbers by
    more than a millionth) in a step whose products are identical or whose method's code has
    changed. It is also 3 if the run cannot be repeated because an input or the record was changed,
    or a method has another version; it is 2 if an input is not found, and 4 if methods are missing.
    """
    from orthoflow.catalog.discovery import discover_catalog
    from orthoflow.engine.journal import new_run_folder, new_run_id
    from orthoflow.engine.plan import RunOptions
    from orthoflow.engine.store import Store, stores_at
    from orthoflow.records.compare import RunProducts, product_distances
    from orthoflow.records.inputs import embedded_inputs
    from orthoflow.records.open import open_run
    from orthoflow.records.replay import DIFFERING, plan_replay, replayed_metrics
    from orthoflow.records.runs import REPORT_FILE
    from orthoflow.report import write_report

    options, catalog = RunOptions(**choices), discover_catalog()
    original = open_run(run)
    run_id = new_run_id()
    folder = output or new_run_folder(f"{original.record.name}-replay", run_id)
    with (
        _store_folder(store, folder) as store_folder,
        embedded_inputs(original, folder.parent) as placed,
    ):
        opened = Store(store_folder)
        planned = plan_replay(
            original,
            catalog,
            opened,
            options,
            inputs=inputs,
            placed=placed,
            earlier=stores_at(DEFAULT_STORE),
        )
        with opened.in_use():
            for note in planned.notes:
                echo(f"note: {note}", err=as_json)
            _, made = executed(
                planned.plan,
                planned.workflow,
                opened,
                folder,
                run_id,
                report=lambda made, _: write_report([made], folder / REPORT_FILE),
            )
            distances = product_distances(
                RunProducts(run=original, stores=stores_at(DEFAULT_STORE)),
                RunProducts(run=made, stores=(opened,)),
                [address for address in original.cells if address in made.cells],
                catalog,
            )
    metrics = replayed_metrics(original, made, distances, planned.changed_methods)
    differs = any(item.verdict == "different" for item in distances) or any(
        item.verdict in DIFFERING for item in metrics
    )
    if as_json:
        echo_json(
            {
                "record": str(original.path),
                "replay": str(made.path),
                "ok": not differs,
                "notes": list(planned.notes),
                "products": [dataclasses.asdict(item) for item in distances],
                "metrics": [dataclasses.asdict(item) for item in metrics],
            }
        )
    else:
        echo()
        echo_distances(distances)
        _print_metrics(metrics)
        echo(f"record of the replay: {made.path}", f"report: {folder / REPORT_FILE}")
    if differs:
        echo_error(f"error: the replay of {original.path} differs from the record (see above)")
    return EXIT_RECORD_DIFFERS if differs else EXIT_GOOD


@contextmanager
def _store_folder(given: Path | None, folder: Path) -> Iterator[Path]:
    if given is not None:
        yield given
        return
    fresh = folder.with_name(f"{folder.name}.store")
    is_new = not fresh.parent.exists()
    fresh.mkdir(parents=True, exist_ok=True)
    try:
        yield fresh
    except (CancelledStepError, ClusterError, KeyboardInterrupt):
        # Keep the store: if the same command is called again, it uses the finished results.
        raise
    except BaseException:
        shutil.rmtree(fresh, ignore_errors=True)
        if is_new:
            # Remove the parent folder, such as `runs`, too if it is empty.
            with contextlib.suppress(OSError):
                fresh.parent.rmdir()
        raise
    shutil.rmtree(fresh, ignore_errors=True)


def _print_metrics(metrics: Sequence[ReplayedMetric]) -> None:
    moved = [item for item in metrics if item.verdict != "same"]
    echo_table(
        ("metric", "recorded", "replayed", "cause"),
        [
            (
                f"{item.cell}.{item.metric}",
                *(
                    _NOTHING if value is None else f"{value!r} {unit}".rstrip()
                    for value, unit in (
                        (item.recorded, item.recorded_unit),
                        (item.replayed, item.replayed_unit),
                    )
                ),
                _CAUSES[item.verdict],
            )
            for item in moved[:ROWS_MOST]
        ],
    )
    echo(f"{counted(len(metrics), 'metric')} (times not counted): {len(moved)} differ")
