"""Options of `orthoflow export` that say what is drawn."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

# Any: click decorates functions of any parameters.
_Decorated = TypeVar("_Decorated", bound=Callable[..., Any])


def drawing_options(command: _Decorated) -> _Decorated:
    """Add `--scale --paper --grid --title-block --beside`."""
    for option in (
        click.option(
            "--beside",
            multiple=True,
            type=click.Choice(["depth", "intensity"]),
            help="sheet: show depth as contours, or the laser intensity, beside the orthoimage; "
            "may be given twice.",
        ),
        click.option(
            "--title-block",
            type=click.Path(path_type=Path, dir_okay=False),
            metavar="FILE",
            help="sheet: YAML file with any of project, title, site, client, organisation, author, "
            "checked_by, date, drawing, revision, note.",
        ),
        click.option(
            "--grid",
            "grid_m",
            type=click.FloatRange(min=0.0),
            metavar="METRES",
            help="sheet: distance of the crosses with coordinates, 0 for none; without it about "
            "2 cm on the paper.",
        ),
        click.option(
            "--paper",
            metavar="PAPER",
            help="sheet: A0 to A4, or width x height in mm as 700x500; A3 without it. It is turned "
            "where that saves sheets.",
        ),
        click.option(
            "--scale",
            type=click.IntRange(min=1, max=100_000),
            metavar="N",
            help="sheet: draw at 1:N; without it the largest usual scale at which each wall fits "
            "onto one sheet.",
        ),
    ):
        command = option(command)
    return command
