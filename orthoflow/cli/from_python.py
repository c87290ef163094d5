"""`orthoflow.run`: the command `run` as a function."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from orthoflow.cli.commands import DEFAULT_STORE, Changes
from orthoflow.cli.run import prepared
from orthoflow.cli.run import run as command
from orthoflow.errors import ArgumentError, did_you_mean

if TYPE_CHECKING:
    from orthoflow.report.notebooks import OpenedRun


def run(
    workflow: str | Path,
    *,
    # Any: whatever a parameter may be.
    set: Mapping[str, Any] | None = None,
    inputs: Mapping[str, str | Path | Sequence[str | Path]] | None = None,
    datasets: str | Path | Mapping[str, Mapping[str, Any]] = "",
    only_data: str | Sequence[str] = (),
    output: str | Path | None = None,
    store: str | Path = DEFAULT_STORE,
    **options: Any,
) -> OpenedRun:
    """Run a workflow, as `orthoflow run` does, and open what came out.

    Progress goes to standard error as the command's does; in a notebook it is one output.
    A step that fails leaves a run whose `record.status` is `failed`; results that are stored are
    not computed again.

    Args:
        workflow: a file, or the name of a shipped one.
        set: parameters by `step.parameter` or `step.variant.parameter`; `{"sweep": [...]}` makes a
            variant of each value; arrays are as good as lists.
        inputs: files by name of the input.
        datasets: a table of datasets, a CSV file; or what a workflow would state,
            `{"hall": {"scan": "hall.e57", "set": {"wall.gsd_m": 0.005}}}`, with a path or a
            list of paths, from the working directory.
        only_data: of these datasets only.
        output: folder of the run; `runs/<name>-<run id>` without one.
        store: folder of stored results.
        **options: the command's `jobs`, `executor`, `scheduler`, `retries` and `embed`; `only`,
            `from_`, `until` and `force`, a step or several; `set_files`, one or several YAML files
            of `step.parameter: value`, which `set` overrides.

    Raises:
        WorkflowError: something is wrong with the workflow, or with what was set; lists all of it.
        InputError: files are missing.
        ArgumentError: the folder holds a finished run, or an option is none.
    """
    several = {
        "sets": [f"{name}={_json(f'set.{name}', value)}" for name, value in (set or {}).items()],
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
        elif value is not None:
            words += [f"{flag}={one}" for one in _listed(value)]
    try:
        chosen = command.make_context("orthoflow.run", [*words, "--", os.fspath(workflow)]).params
    except click.ClickException as error:
        raise ArgumentError(f"orthoflow.run: {error.format_message()}") from error
    if isinstance(datasets, Mapping):
        chosen["datasets"] = json.loads(_json("datasets", datasets))
    changes = Changes(**{item.name: chosen.pop(item.name) for item in fields(Changes)})
    del chosen["json_log"]
    with prepared(changes=changes, **chosen) as call:
        _, made = call.make()
    from orthoflow.report.notebooks import open_run

    return open_run(made.path)


# Any below: of whoever calls.
def _listed(value: Any) -> list[Any]:
    is_many = hasattr(value, "__iter__") and not isinstance(value, str | os.PathLike)
    return list(value) if is_many else [value]


def _json(where: str, value: Any) -> str:
    try:
        return json.dumps(value, default=_plain)
    except (TypeError, ValueError) as error:
        raise ArgumentError(
            f"orthoflow.run: {where}: expected a path, text, number, list or mapping: {error}"
        ) from error


def _plain(value: Any) -> Any:
    """Return an array or a number of whatever library as Python's own, and a path as text."""
    return value.tolist() if callable(getattr(value, "tolist", None)) else os.fspath(value)
