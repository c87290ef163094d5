"""`orthoflow plugins new`: the first files of a plugin."""

from __future__ import annotations

from pathlib import Path

import click

from orthoflow.cli.failures import EXIT_GOOD
from orthoflow.cli.options import Command, json_option
from orthoflow.cli.tables import echo_json


@click.command("new", cls=Command)
@click.argument("name", metavar="NAME")
@click.option("--kind", required=True, metavar="KIND", help="Kind of the method, e.g. plane.")
@click.option(
    "--folder",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    default=Path(),
    help="Where the folder NAME is made; the current one unless given.",
)
@click.option("--author", default="The authors", help="For pyproject, licence and citation.")
@click.option("--licence", default="MIT", show_default=True, help="SPDX expression.")
@click.option("--citation", default="", help="Where the method comes from: DOI, title or URL.")
@json_option
def plugins_new(name: str, *, as_json: bool, folder: Path, **said: str) -> int:
    """Write a plugin NAME that installs, works and passes its tests at once, e.g. my-detector.

    `orthoflow plugins list` names the kinds. The method does something simple; put your own in its
    place.
    """
    from orthoflow.catalog import discover_catalog
    from orthoflow.scaffold import Project, write_project

    project = Project(name=name, **said)
    written = write_project(project, folder, discover_catalog())
    if as_json:
        echo_json({"method": project.method_id, "files": [str(path) for path in written]})
        return EXIT_GOOD
    for path in written:
        click.echo(f"wrote {path}")
    click.echo(
        f"\nnext: cd {name}, python -m pip install -e '.[test]', python -m pytest; "
        f"then write {project.package}/method.py"
    )
    return EXIT_GOOD
