"""`orthoflow.run`: the command `run` as a function."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from orthoflow.catalog.wording import did_you_mean
from orthoflow.cli.options import DEFAULT_STORE, Changes
from orthoflow.cli.run import prepared
from orthoflow.errors import ArgumentError

if TYPE_CHECKING:
    from orthoflow.products.product import JsonValue
    from orthoflow.report.notebooks import OpenedRun

# Options that are no fields of the engine's.
_POPPED: Final = ("set_files", "embed")
_WORD: Final = re.compile(r"-?[A-Za-z][A-Za-z0-9_.-]*")
# What YAML of one version or another takes for something else.
_NO_WORDS: Final = frozenset(("true", "false", "null", "yes", "no", "on", "off", "y", "n"))
_OF_STEPS: Final = ("only", "from_", "until", "force")


def run(
    workflow: str | Path,
    *,
    # Any: whatever a parameter may be.
    set: Mapping[str, Any] | None = None,
    inputs: Mapping[str, str | Path | Sequence[str | Path]] | None = None,
    datasets: str | Path | Mapping[str, Mapping[str, Any]] = "",
    only_data: Sequence[str] = (),
    output: str | Path | None = None,
    store: str | Path = DEFAULT_STORE,
    **options: Any,
) -> OpenedRun:
    """Run a workflow, as `orthoflow run` does, and open what came out.

    Progress goes to standard error as the command's does. A step that fails leaves a run whose
    `record.status` is `failed`; results that are stored are not computed again.

    Args:
        workflow: a file, or the name of a shipped one.
        set: parameters by `step.parameter` or `step.variant.parameter`; `{"sweep": [...]}` makes a
            variant of each value.
        inputs: files by name of the input.
        datasets: a table of datasets, a CSV file; or what a workflow would say of them, `{"hall":
            {"scan": "hall.e57", "set": {"wall.gsd_m": 0.005}}}`, with a path or a list of paths,
            from the working directory.
        only_data: of these datasets only.
        output: folder of the run; `runs/<name>-<run id>` without one.
        store: folder of stored results.
        **options: the command's `jobs`, `executor`, `scheduler`, `retries` and `embed`; `only`,
            `from_`, `until` and `force`, a step or several; `set_files`, one or several YAML files
            of `step.parameter: value`, before which goes what `set` says.

    Raises:
        WorkflowError: something is wrong with the workflow, or with what was set; says all of it.
        InputError: files are missing.
        ArgumentError: the folder holds a finished run, or an option is none.
    """
    given = [f"{name}={path}" for name, value in (inputs or {}).items() for path in _several(value)]
    changes = Changes(
        sets=tuple(f"{name}={_spelt(value)}" for name, value in (set or {}).items()),
        set_files=_several(options.pop("set_files", ())),
        inputs=tuple(given),
        datasets=_datasets(datasets),
        only_data=tuple(only_data),
    )
    embed = bool(options.pop("embed", False))
    _refuse_unknown(options)
    # One step is as good as a list of one.
    options |= {name: _several(options[name]) for name in _OF_STEPS if name in options}
    folder = None if output is None else Path(output)
    with prepared(str(workflow), changes, folder, Path(store), embed=embed, **options) as call:
        made = call.make()
    from orthoflow.report.notebooks import open_run

    return open_run(made.run.path)


# Any: whatever a parameter may be.
def _spelt(value: Any) -> str:
    """A value as one writes it behind `--set`: words without quotes."""
    is_word = isinstance(value, str) and _WORD.fullmatch(value)
    return str(value) if is_word and value.lower() not in _NO_WORDS else json.dumps(value)


# Any: whatever somebody calls a dataset.
def _datasets(given: str | Path | Mapping[str, Any]) -> str | Mapping[str, JsonValue]:
    if isinstance(given, Mapping):
        return {str(name): _said(said, f"datasets=[{name!r}]") for name, said in given.items()}
    return str(given)


# Any: likewise.
def _said(value: Any, where: str) -> JsonValue:
    """Give what a workflow file would hold of a value: paths as texts, any sequence as a list."""
    if isinstance(value, Mapping):
        return {str(key): _said(item, f"{where}[{key!r}]") for key, item in value.items()}
    if isinstance(value, str | bool | int | float | None):
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Sequence):
        return [_said(item, f"{where}[{index}]") for index, item in enumerate(value)]
    raise ArgumentError(
        f"{where} must be a path, a text, a number, a list or a mapping, got {value!r}"
    )


def _refuse_unknown(options: Mapping[str, object]) -> None:
    from orthoflow.engine.plan import RunOptions

    known = [*(field.name for field in fields(RunOptions)), *(signature(run).parameters), *_POPPED]
    known.remove("options")
    for name in options:
        if name not in known:
            raise ArgumentError(
                f"orthoflow.run takes no {name}{did_you_mean(name, known)}; it takes "
                f"{', '.join(known)}"
            )


def _several(paths: str | Path | Sequence[str | Path]) -> tuple[str, ...]:
    """One path or many, as texts."""
    return (str(paths),) if isinstance(paths, str | Path) else tuple(map(str, paths))
