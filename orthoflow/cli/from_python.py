"""`orthoflow.run`, which is the command `orthoflow run` as a Python function."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from orthoflow.cli.commands import DEFAULT_STORE, Changes
from orthoflow.cli.run import run as command
from orthoflow.cli.run import run_workflow
from orthoflow.errors import ArgumentError, did_you_mean

if TYPE_CHECKING:
    from orthoflow.report.notebooks import OpenedRun


def run(
    workflow: str | Path,
    *,
    # Parameters may have values of any type.
    set: Mapping[str, Any] | None = None,
    inputs: Mapping[str, str | Path | Sequence[str | Path]] | None = None,
    datasets: str | Path | Mapping[str, Mapping[str, Any]] = "",
    only_data: str | Sequence[str] = (),
    output: str | Path | None = None,
    store: str | Path = DEFAULT_STORE,
    **options: Any,
) -> OpenedRun:
    """Run a workflow, as `orthoflow run` does, and open the finished run.

    Progress is written to standard error. If a step fails, no exception is raised, but
    `record.status` of the run is `failed`. Stored results are not recomputed.

    Args:
        workflow: path of a workflow file, or name of a shipped workflow.
        set: `step.parameter` or `step.variant.parameter` -> value. The value `{"sweep": [...]}`
            creates a variant for each item. Arrays may be used instead of lists.
        inputs: name of the input -> file or files.
        datasets: path of a CSV file with a table of datasets, or a mapping as in a workflow, such
            as `{"hall": {"scan": "hall.e57", "set": {"wall.gsd_m": 0.005}}}`. Paths in the mapping
            are relative to the working directory.
        only_data: names of the datasets to run; empty for all.
        output: run folder; `runs/<name>-<run id>` if None.
        store: folder of the store.
        **options: options of the command: `jobs`, `executor`, `scheduler`, `retries` and `embed`;
        `only`, `from_`, `until` and `force`, with one or more steps; `set_files`, one or more YAML
        files of `step.parameter: value`, which `set` overrides.

    Raises:
        WorkflowError: the workflow or a setting is invalid; the message lists all problems.
        InputError: files are missing.
        ArgumentError: the folder contains a finished run, or an option is invalid.
    """
    several = {
        "sets": [f"{name}={json_of(f'set.{name}', value)}" for name, value in (set or {}).items()],
        "inputs": [
            f"{name}={path}" for name, paths in (inputs or {}).items() for path in _listed(paths)
        ],
        "datasets": "" if isinstance(datasets, Mapping) else datasets,
    }
    given = {"only_data": only_data, "output": output, "store": store, **several, **options}
    known = {str(one.name): one for one in command.params if isinstance(one, click.Option)}
    words: list[str] = []
    for name, value in given.items():
        if name not in known:
            raise ArgumentError(
                f"orthoflow.run: there is no option {name}{did_you_mean(name, known)}"
            )
        flag = known[name].opts[-1]
        if isinstance(value, bool) and known[name].is_flag:
            words += [flag] if value else []
        elif value not in (None, ""):
            words += [f"{flag}={one}" for one in _listed(value)]
    try:
        context = command.make_context("orthoflow run", [*words, "--", os.fspath(workflow)])
    except click.ClickException as error:
        raise ArgumentError(f"orthoflow.run: {error.format_message()}") from error
    chosen = dict(context.params)
    if isinstance(datasets, Mapping):
        chosen["datasets"] = json.loads(json_of("datasets", datasets))
    changes = Changes(**{item.name: chosen.pop(item.name) for item in fields(Changes)})
    # If the run is interrupted, its report shows the command in this context.
    with context:
        _, made = run_workflow(changes=changes, **chosen)
    from orthoflow.report.notebooks import open_run

    return open_run(made.path)


# In the following functions, `Any` is the type of values from the caller.
def _listed(value: Any) -> list[Any]:
    is_many = hasattr(value, "__iter__") and not isinstance(value, str | os.PathLike)
    return list(value) if is_many else [value]


def json_of(where: str, value: Any) -> str:
    """Return a value as JSON, with arrays, NumPy numbers and paths as a workflow has them.

    Raises:
        ArgumentError: the value at `where` has another type.
    """
    try:
        return json.dumps(value, default=_plain)
    except (TypeError, ValueError) as error:
        raise ArgumentError(
            f"orthoflow.run: {where}: expected a path, text, number, list or mapping: {error}"
        ) from error


def _plain(value: Any) -> Any:
    """Convert arrays and numbers of libraries to lists and numbers, and paths to strings."""
    return value.tolist() if callable(getattr(value, "tolist", None)) else os.fspath(value)
