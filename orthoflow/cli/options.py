"""Arguments and options that several commands share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

if TYPE_CHECKING:
    from orthoflow.catalog.catalog import Catalog
    from orthoflow.products.product import JsonValue
    from orthoflow.workflow.model import (
        Workflow,
    )

# Any: click decorates functions as well as commands.
_Decorated = TypeVar("_Decorated", bound=Callable[..., Any] | click.Command)

DEFAULT_STORE: Final = Path(".orthoflow")


@dataclass(frozen=True, kw_only=True)
class Changes:
    """What the command line puts in the place of what a workflow file says."""

    sets: tuple[str, ...]
    inputs: tuple[str, ...]
    datasets: str | Mapping[str, JsonValue]
    only_data: tuple[str, ...]
    set_files: tuple[str, ...] = ()

    def load(self, workflow: str, catalog: Catalog) -> Workflow:
        """Load the workflow with these changes, see `load_workflow` for what may be wrong."""
        from orthoflow.workflow.document import load_workflow

        return load_workflow(workflow, catalog, also_files=True, **vars(self))


def workflow_arguments(run: Callable[..., int]) -> Callable[..., int]:
    """Add the workflow and `changes` to it: `WORKFLOW --set --set-file --input --datasets ...`."""

    # Any: the command's parameters, whose types click has checked.
    @wraps(run)
    def command(**given: Any) -> int:
        changes = Changes(**{item.name: given.pop(item.name) for item in fields(Changes)})
        return run(changes=changes, **given)

    command = click.option(
        "--only-data",
        "only_data",
        multiple=True,
        metavar="NAMES",
        help="Run on these of the datasets, with commas between their names.",
    )(command)
    command = click.option(
        "--datasets",
        default="",
        metavar="FILE",
        help="Run on each dataset of a CSV file: the column name, and a column per input.",
    )(command)
    command = input_option(command)
    command = click.option(
        "--set-file",
        "set_files",
        multiple=True,
        metavar="FILE",
        help="Change the parameters that a YAML file names: step.parameter: value.",
    )(command)
    command = click.option(
        "--set",
        "sets",
        multiple=True,
        metavar="STEP.PARAM=VALUE",
        help="Change a parameter, e.g. wall.gsd_m=0.002 or plane.ransac.tolerance_m=0.05.",
    )(command)
    return click.argument("workflow", metavar="WORKFLOW")(command)


def input_option(command: _Decorated) -> _Decorated:
    """Add `--input`."""
    return click.option(
        "--input",
        "inputs",
        multiple=True,
        metavar="NAME=PATH",
        help="Give an input: a file, a folder or a quoted glob, relative to the current folder.",
    )(command)


def selection_options(command: _Decorated) -> _Decorated:
    """Add the options that choose steps: `--only --from --until --force`."""
    for name, parameter, text in [
        ("--force", "force", "Run this step although its result is stored."),
        ("--until", "until", "Run this step and what it needs."),
        ("--from", "from_", "Run this step and what follows; what it needs must be stored."),
        ("--only", "only", "Run this step alone; what it needs must be stored."),
    ]:
        command = click.option(
            name, parameter, metavar="STEP", multiple=True, help=f"{text} Repeatable."
        )(command)
    return command


def output_option(name: str) -> Callable[[_Decorated], _Decorated]:
    """Add `-o`; `name` is the folder's name where none is given."""
    return click.option(
        "-o",
        "--output",
        type=click.Path(path_type=Path, file_okay=False),
        metavar="RUNDIR",
        help=f"Folder of this run.  [default: runs/{name}]",
    )


def execution_options(command: _Decorated) -> _Decorated:
    """Add how steps run: `--jobs --executor --scheduler --retries`."""
    command = click.option(
        "--retries",
        type=int,
        default=2,
        show_default=True,
        metavar="N",
        help="With dask: try a step again so often whose worker was lost.",
    )(command)
    command = click.option(
        "--scheduler",
        default="",
        metavar="ADDRESS",
        help="With dask: the cluster's scheduler, tcp://HOST:PORT; without it, N workers here.",
    )(command)
    command = click.option(
        "--executor",
        type=click.Choice(["local", "inline", "dask"]),
        default="local",
        help="A process per step, all in this one (for debugging; a step's memory then holds what "
        "earlier ones left, too), or on the workers of dask.",
    )(command)
    return click.option(
        "--jobs", type=int, default=1, metavar="N", help="Steps that run at the same time."
    )(command)


def store_option(command: _Decorated) -> _Decorated:
    """Add `--store`."""
    return click.option(
        "--store",
        type=click.Path(path_type=Path, file_okay=False),
        default=DEFAULT_STORE,
        show_default=True,
        metavar="DIR",
        help="Folder of stored results.",
    )(command)


def json_option(command: _Decorated) -> _Decorated:
    """Add `--json`."""
    return click.option("--json", "as_json", is_flag=True, help="Print JSON.")(command)
