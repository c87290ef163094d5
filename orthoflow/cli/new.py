"""`orthoflow new`: write a first workflow for given files."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from orthoflow.cli.commands import EXIT_GOOD, Command, json_option
from orthoflow.cli.tables import echo, echo_json
from orthoflow.errors import ArgumentError

if TYPE_CHECKING:
    from orthoflow.workflow.draft import Draft, Recipe

_RECIPES: Final = ("photos-on-scan", "direct", "plan")


@click.command(cls=Command)
@click.argument(
    "files", metavar="FILE...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    default=Path("workflow.yaml"),
    show_default=True,
    metavar="FILE",
    help="Workflow file to write; an existing file is not changed.",
)
@click.option(
    "--recipe",
    type=click.Choice(_RECIPES),
    help="Shipped recipe to use.  [default: photos-on-scan if there are photos, else direct]",
)
@json_option
def new(files: tuple[Path, ...], output: Path, *, recipe: Recipe | None, as_json: bool) -> int:
    """Inspect each FILE, or the files in a folder, and write a workflow with comments for them.

    Scans, photos, calibrations, check points, manually measured ties, and cameras and orthoimages
    from other programs are recognised by their content. The result is a shipped workflow with these
    files as inputs, to be edited as needed.
    """
    from orthoflow.cli.progress import working_on

    if output.exists():
        raise ArgumentError(f"{output} already exists: choose another name with -o")
    with working_on("inspecting the files"):
        from orthoflow.workflow.draft import draft_workflow, recognised

        draft = draft_workflow(recognised(files), output, recipe)
    _write(output, draft.text)
    if as_json:
        echo_json(
            {
                "file": str(output),
                "recipe": draft.recipe,
                "inputs": dict(draft.inputs),
                "left_out": list(draft.left_out),
                "advice": list(draft.advice),
            }
        )
    else:
        _print(draft, output)
    return EXIT_GOOD


def _write(output: Path, text: str) -> None:
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with output.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except OSError as error:
        raise ArgumentError(f"cannot write {output}: {error.strerror}") from error


def _print(draft: Draft, output: Path) -> None:
    for name, text in draft.inputs.items():
        echo(f"{name}: {text}")
    for text in draft.left_out:
        echo(f"not used: {text}")
    for text in draft.advice:
        echo(f"note: {text}")
    name = shlex.quote(str(output))
    echo(
        f"wrote {output}, based on the recipe {draft.recipe}",
        "",
        f"next: orthoflow check {name}",
        f"      orthoflow run {name} --set wall.gsd_m=0.02    # a coarse first run",
    )
