"""Arguments and options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import click

# Any: click decorates functions as well as commands.
_Decorated = TypeVar("_Decorated", bound=Callable[..., Any] | click.Command)

DEFAULT_STORE: Final = Path(".orthoflow")


def workflow_arguments(command: _Decorated) -> _Decorated:
    """Add the workflow and what changes it: `WORKFLOW --set --input`."""
    command = input_option(command)
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
    """Add how steps run: `--jobs --executor`."""
    command = click.option(
        "--executor",
        type=click.Choice(["local", "inline"]),
        default="local",
        help="A process per step, or all in this one (for debugging).",
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
