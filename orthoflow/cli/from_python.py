"""`orthoflow.run`: the command `run` as a function."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from inspect import signature
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from orthoflow.catalog.wording import did_you_mean
from orthoflow.cli.commands import DEFAULT_STORE, Changes
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
_WHOLE: Final = ("jobs", "retries", "cores")
_SHORT: Final = 60
_FORM_OF_SET: Final = "a mapping of step.parameter to a value, such as {'wall.gsd_m': 0.005}"
_FORM_OF_INPUTS: Final = (
    "a mapping of the name of an input to a path or a list of paths, such as {'scan': 'hall.e57'}"
)
_FORM_OF_DATASETS: Final = (
    "the path of a CSV file, or a mapping such as {'hall': {'scan': 'hall.e57'}}"
)
_WORKFLOW: Final = "a file, or the name of a shipped workflow"
_PATHS: Final = "a path or a list of paths"


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
    changes = Changes(
        sets=tuple(
            f"{name}={_spelt(_as_json(value, f'set[{name!r}]'))}"
            for name, value in _named(set, "set", _FORM_OF_SET).items()
        ),
        set_files=_several(options.pop("set_files", ()), "set_files"),
        inputs=tuple(
            f"{name}={path}"
            for name, value in _named(inputs, "inputs", _FORM_OF_INPUTS).items()
            for path in _several(value, f"inputs[{name!r}]")
        ),
        datasets=_datasets(datasets),
        only_data=_several(only_data, "only_data", "the name of a dataset or a list of them"),
    )
    embed = options.pop("embed", False)
    if not isinstance(embed, bool):
        raise _wrong("embed", "True or False", embed)
    _refuse_unknown(options)
    for name in _WHOLE:
        if name in options and not _is_whole(options[name]):
            raise _wrong(name, "a whole number", options[name])
    # One step is as good as a list of one.
    steps = "the name of a step or a list of them"
    options |= {name: _several(options[name], name, steps) for name in _OF_STEPS if name in options}
    folder = None if output is None else _path(output, "output")
    text, stored = str(_path(workflow, "workflow", _WORKFLOW)), _path(store, "store")
    with prepared(text, changes, folder, stored, embed=embed, **options) as call:
        made = call.make()
    from orthoflow.report.notebooks import open_run

    return open_run(made.run.path)


def _spelt(value: JsonValue) -> str:
    """A value as one writes it behind `--set`: words without quotes."""
    is_word = isinstance(value, str) and _WORD.fullmatch(value)
    return str(value) if is_word and str(value).lower() not in _NO_WORDS else json.dumps(value)


# Any below: of whoever calls.
def _named(given: Any, name: str, form: str) -> Mapping[str, Any]:
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise _wrong(name, form, given)
    return given


def _datasets(given: Any) -> str | Mapping[str, JsonValue]:
    if isinstance(given, Mapping):
        return {str(name): _as_json(item, f"datasets[{name!r}]") for name, item in given.items()}
    if isinstance(given, str | PathLike):
        return str(given)
    raise _wrong("datasets", _FORM_OF_DATASETS, given)


def _as_json(value: Any, where: str) -> JsonValue:
    """Return what a workflow file would hold of a value: paths as texts, any sequence as a list."""
    # Arrays and their numbers, of whatever library.
    value = value.tolist() if callable(getattr(value, "tolist", None)) else value
    if isinstance(value, Mapping):
        return {str(key): _as_json(item, f"{where}[{key!r}]") for key, item in value.items()}
    if isinstance(value, str | bool | int | float | None):
        return value
    if isinstance(value, PathLike):
        return str(value)
    if isinstance(value, Sequence):
        return [_as_json(item, f"{where}[{index}]") for index, item in enumerate(value)]
    raise _wrong(where, "a path, a text, a number, a list or a mapping", value)


def _is_whole(value: object) -> bool:
    return isinstance(value, Integral | None) and not isinstance(value, bool)


def _wrong(name: str, form: str, got: object) -> ArgumentError:
    text = repr(got)
    if len(text) > _SHORT or "\n" in text:
        text = f"an object of class {type(got).__name__}"
    return ArgumentError(f"{name} must be {form}, got {text}")


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


def _path(given: Any, name: str, form: str = "a path") -> Path:
    if isinstance(given, str | PathLike):
        return Path(given)
    raise _wrong(name, form, given)


def _several(given: Any, name: str, form: str = _PATHS) -> tuple[str, ...]:
    """One path or name or many, as texts."""
    if isinstance(given, str | PathLike):
        return (str(given),)
    many = tuple(given) if isinstance(given, Iterable) and not isinstance(given, Mapping) else None
    if many is None or not all(isinstance(one, str | PathLike) for one in many):
        raise _wrong(name, form, given)
    return tuple(map(str, many))
