"""`orthoflow.run`: the command `run` as a function."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

from orthoflow.cli.commands import DEFAULT_STORE, Changes
from orthoflow.cli.run import prepared
from orthoflow.errors import ArgumentError
from orthoflow.files.documents import mistakes
from orthoflow.files.yaml_positions import path_text

if TYPE_CHECKING:
    from orthoflow.report.notebooks import OpenedRun

_WORD: Final = re.compile(r"-?[A-Za-z][A-Za-z0-9_.-]*")
# What YAML of one version or another takes for something else.
_NO_WORDS: Final = frozenset(("true", "false", "null", "yes", "no", "on", "off", "y", "n"))


# Any below: of whoever calls.
def _plain(value: Any) -> Any:
    """Return what a workflow file would hold of a value: paths as texts, any sequence as a list."""
    # Arrays and their numbers, of whatever library.
    value = value.tolist() if callable(getattr(value, "tolist", None)) else value
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _json(value: Any) -> Any:
    value = _plain(value)
    try:
        json.dumps(value)
    except (TypeError, ValueError) as error:
        raise ValueError("expected a path, a text, a number, a list or a mapping") from error
    return value


def _several(value: Any) -> Any:
    """One path or name or many, as texts."""
    if isinstance(value, str | os.PathLike):
        return (os.fspath(value),)
    is_many = hasattr(value, "__iter__") and not isinstance(value, Mapping)
    return tuple(map(_plain, value)) if is_many else value


_Text = Annotated[str, BeforeValidator(_plain)]
_Texts = Annotated[tuple[str, ...], BeforeValidator(_several)]
_Value = Annotated[Any, BeforeValidator(_json)]
_Whole = Annotated[
    int,
    BeforeValidator(lambda n: int(n) if isinstance(n, Integral) and not isinstance(n, bool) else n),
]


class _Arguments(BaseModel):
    """What `run` takes, see there."""

    model_config = ConfigDict(extra="forbid", strict=True)

    workflow: _Text
    set: dict[str, _Value] = {}
    inputs: dict[str, _Texts] = {}
    datasets: _Text | dict[str, _Value] = ""
    only_data: _Texts = ()
    set_files: _Texts = ()
    output: _Text | None = None
    store: _Text = str(DEFAULT_STORE)
    embed: bool = False
    jobs: _Whole = 1
    executor: str = "local"
    scheduler: str = ""
    retries: _Whole = 2
    cores: _Whole | None = None
    only: _Texts = ()
    from_: _Texts = ()
    until: _Texts = ()
    force: _Texts = ()


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
    named = {"datasets": datasets, "only_data": only_data, "output": output, "store": store}
    given = {"workflow": workflow, "set": set or {}, "inputs": inputs or {}, **named, **options}
    try:
        known = _Arguments.model_validate(given)
    except ValidationError as error:
        loc, message, _ = next(mistakes(error, _Arguments, given))
        raise ArgumentError(f"orthoflow.run: {path_text(loc)}: {message}") from error
    changes = Changes(
        sets=tuple(f"{name}={_spelt(value)}" for name, value in known.set.items()),
        set_files=known.set_files,
        inputs=tuple(f"{name}={path}" for name, paths in known.inputs.items() for path in paths),
        datasets=known.datasets,
        only_data=known.only_data,
    )
    of_changes = {"workflow", "set", "set_files", "inputs", "datasets", "only_data"}
    choices = known.model_dump(exclude=of_changes | {"output", "store", "embed"})
    folder = None if known.output is None else Path(known.output)
    with prepared(
        known.workflow, changes, folder, Path(known.store), embed=known.embed, **choices
    ) as call:
        _, made = call.make()
    from orthoflow.report.notebooks import open_run

    return open_run(made.path)


# Any: JSON.
def _spelt(value: Any) -> str:
    """A value as one writes it behind `--set`: words without quotes."""
    is_word = isinstance(value, str) and _WORD.fullmatch(value)
    return str(value) if is_word and str(value).lower() not in _NO_WORDS else json.dumps(value)
