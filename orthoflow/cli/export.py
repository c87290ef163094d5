"""`orthoflow export`: write the results of a run for other programs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

from orthoflow.cli.commands import RecordCommand, code_for, echo_error, input_option, store_option
from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.formats import FORMATS, Format, FormatOption, check_choices
from orthoflow.cli.exports.products import make_empty, store_of
from orthoflow.cli.tables import counted, echo
from orthoflow.errors import ArgumentError, RecordError

if TYPE_CHECKING:
    from orthoflow.records.runs import Run

_Command = TypeVar("_Command", bound=Callable[..., Any] | click.Command)
# This subfolder of the run folder contains one folder per format.
_EXPORT_FOLDER: Final = "export"


class _Scale(click.IntRange):
    """The denominator N of a scale, which the user enters as N or as 1:N."""

    # Click declares the value as `Any`.
    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        text: Any = value.replace(" ", "").removeprefix("1:") if isinstance(value, str) else value
        return int(super().convert(text, param, ctx))


_CLOUDS: Final = "laz copc ply e57"
_DRAWN: Final = "plan section elevation sheet"
_STEPWISE: Final = (
    f"colmap dxf figures geojson layers {_CLOUDS} gltf tiles {_DRAWN} relief qgis iiif"
)


# The type is `Any` because the arguments are passed on to click.
def _for(formats: str, *names: str, help: str, **more: Any) -> Callable[[_Command], _Command]:
    text = f"{formats.replace(' ', ', ')}: {help}"
    return click.option(*names, cls=FormatOption, formats=formats.split(), help=text, **more)


_HELP: Final = "\n\n".join(
    [
        "Write the results of RUN, a run folder or its run.h5, for other programs.",
        *(f"{name}: {entry.summary}." for name, entry in FORMATS.items()),
        (
            "--embed: only run.h5, which can be verified and replayed without any other file. "
            "Missing parts are taken from the store and from the input files, which are located "
            "by their content: at the paths given with --input, or where `replay` looks for them."
        ),
        (
            "--split: for a run on several datasets, a run folder for each dataset, with its "
            "record, report and products."
        ),
    ]
)


@click.command(cls=RecordCommand, help=_HELP)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.option("--to", "target", type=click.Choice(list(FORMATS)), help="Format to write.")
@click.option(
    "--embed",
    is_flag=True,
    help="Write a self-contained record with every product and input file; with --to ro-crate, it "
    "replaces the record in the crate.",
)
@click.option(
    "--split",
    is_flag=True,
    help="Write a run folder per dataset, with a record that can be verified and replayed alone.",
)
@input_option
@store_option
@_for(
    _STEPWISE,
    "--step",
    "--cell",
    "cell",
    metavar="ADDRESS",
    help="step whose results are written; by default the last one that has results of this type "
    "(figures: all steps).",
)
@_for(
    "ro-crate",
    "--license",
    "license_text",
    metavar="URL",
    help="license of the results, as URL or name.",
)
@_for(
    "ro-crate",
    "--author",
    metavar="NAME",
    help="author of the results: name, https://orcid.org/..., or both, name first.",
)
@_for(
    _DRAWN,
    "--scale",
    type=_Scale(min=1, max=100_000),
    metavar="N",
    help="scale 1:N (50 or 1:50); by default the largest standard scale at which each drawing "
    "fits on one sheet.",
)
@_for(
    _DRAWN,
    "--paper",
    metavar="PAPER",
    help="paper size: A0 to A4, an elongated size such as A3.1 (297 x 841 mm), or width x height "
    "in mm, such as 700x500; by default the smallest for each drawing (without --scale at most "
    "A3).",
)
@_for(
    "plan section sheet",
    "--grid",
    type=click.FloatRange(min=0.0),
    metavar="DISTANCE",
    help="spacing of grid crosses in the unit of --units (0: none); by default about 2 cm on the "
    "paper.",
)
@_for(
    "sheet",
    "--units",
    type=click.Choice(["m", "ft"]),
    help="unit of coordinates, heights and scale bar; m by default. With ft, the standard scales "
    "are 1:48 (1/4 inch to the foot) and so on.",
)
@_for(
    _DRAWN,
    "--title-block",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="YAML file with any of the fields project, title, site, client, organisation, author, "
    "checked_by, date, drawing, revision, note, logo, fields, revisions, layout (column or strip).",
)
@_for(
    "sheet",
    "--beside",
    multiple=True,
    type=click.Choice(["depth", "intensity"]),
    help="show depth contours or the laser intensity beside the orthoimage; repeatable.",
)
@_for(
    "plan",
    "--height",
    "heights_m",
    type=float,
    multiple=True,
    metavar="METRES",
    help="height of the cut above the floor in metres, 1.2 by default; repeatable.",
)
@_for(
    "section",
    "--through",
    multiple=True,
    metavar="X,Y,X,Y",
    help="two points of the plan, in metres in scan coordinates; the viewer sees the first point "
    "on the left; repeatable.",
)
@_for("plan section", "--dimensions", is_flag=True, help="write lengths next to the lines.")
@_for(
    _DRAWN,
    "--language",
    type=click.Choice(["en", "de", "fr", "pl", "es"]),
    help="language of labels; en by default.",
)
@_for(
    "relief",
    "--light",
    metavar="AZIMUTH,ALTITUDE",
    help="direction of the light in degrees: azimuth on the wall, clockwise from the top, and "
    "altitude above its plane; 315,25 (top left) by default.",
)
@_for(
    "iiif",
    "--base-url",
    metavar="URL",
    help="address at which the folder will be published, e.g. https://example.org/room; "
    "http://localhost:8000 by default.",
)
@_for(
    "figures",
    "--format",
    "figure_format",
    type=click.Choice(["pdf", "svg", "png"]),
    help="format of charts and drawings, png with 300 dpi; svg by default. With pdf, pictures "
    "are written as PDF pages; otherwise they are written as PNG.",
)
@_for(
    _CLOUDS,
    "--colour",
    type=click.Choice(["photos", "rgb", "intensity", "plane", "deviation"]),
    help="source of the points' colours: the oriented photos (grey if no photo shows the point), "
    "the colours of the scan, its intensity, the plane (one colour each), or the deviation from "
    "the plane (blue behind, red in front of it); by default the first of these that is available.",
)
@_for(
    f"{_CLOUDS} dxf geojson gltf tiles relief iiif sheet",
    "--wall",
    type=click.IntRange(min=0),
    metavar="K",
    help="only the wall with number K, as in file names; for clouds, only points in its raster.",
)
@_for(
    _CLOUDS,
    "--box",
    metavar="X,Y,Z,X,Y,Z",
    help="only points in the box between two corners, metres in scan coordinates.",
)
@_for(
    _CLOUDS,
    "--clean",
    is_flag=True,
    help="omit isolated points, with fewer than ten neighbours.",
)
@_for(
    "gltf",
    "--relief",
    is_flag=True,
    help="model the relief of walls from their depths instead of planes.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Output folder, new or empty; by default export/FORMAT in RUN (or export/embedded, "
    "export/datasets).",
)
def export(run: Path, target: str | None, output: Path | None, **choices: Any) -> int:
    """Write the results of a run for other programs, and return the exit code."""
    from orthoflow.cli.progress import working_on
    from orthoflow.engine.durability import whole_folder
    from orthoflow.records.open import open_run
    from orthoflow.records.runs import find_record, read_run
    from orthoflow.records.verify import broken_seal

    chosen = Choices(**choices)
    check_choices(chosen, target, format_options())
    # These formats copy the whole record or print its seal, so they need a finished one.
    hands_on = chosen.embed or chosen.split or target in ("ro-crate", "sheet")
    opened = read_run(find_record(run)) if hands_on else open_run(run)
    if not opened.is_finished:
        echo_error(f"note: {run} has not ended; only its results so far are exported")
    chosen = replace(chosen, store=store_of(opened, chosen.store))
    name = target or ("datasets" if chosen.split else "embedded")
    folder = output or _folder_inside(opened, *((_EXPORT_FOLDER,) if target else ()), name)
    _refuse_filled(folder)
    with opened.held_open() as held:
        finding = broken_seal(held, of_all=hands_on)
        if finding and hands_on:
            raise RecordError(f"{finding}; changed records are not exported: use an unchanged copy")
        with whole_folder(folder) as aside, working_on(f"writing {name}"):
            if target:
                summary = _export_to(FORMATS[target], held, aside, chosen)
            else:
                export_all = _export_split if chosen.split else _export_embedded
                summary = export_all(held, aside, chosen)
    echo(f"{name}: {folder}: {summary}")
    return code_for([finding], f"do not use the files in {folder}")


def format_options() -> list[FormatOption]:
    """Return the options that apply only to some formats."""
    return [option for option in export.params if isinstance(option, FormatOption)]


def _export_to(target: Format, run: Run, folder: Path, chosen: Choices) -> str:
    from orthoflow.files.geotiff import name_run
    from orthoflow.records.write import with_files

    if target.takes_rasters:
        with with_files(run, lambda note: echo_error(f"note: {note}")) as whole:
            summary = target.load()(whole, folder, chosen)
    else:
        summary = target.load()(run, folder, chosen)
    for path in folder.rglob("*"):
        if path.is_file():
            name_run(path, run.record.run_id)
    return summary


def _export_embedded(run: Run, folder: Path, chosen: Choices) -> str:
    from orthoflow.cli.exports.results import embedded

    make_empty(folder)
    record = embedded(run, folder, chosen)
    n_products = sum(len(cell.outputs) for cell in record.cells.values())
    n_files = sum(len(entry.files) for entry in record.record.inputs)
    return (
        f"{record.path.name} with {counted(n_products, 'product')} and "
        f"{counted(n_files, 'input file')}, seal sha256:{record.content_sha256}"
    )


def _export_split(run: Run, folder: Path, chosen: Choices) -> str:
    from orthoflow.engine.store import Store
    from orthoflow.records.runs import REPORT_FILE, parts_of, path_inside
    from orthoflow.records.write import write_part
    from orthoflow.report import write_page

    parts = parts_of(run)
    if not parts:
        raise ArgumentError(f"the run {run.record.run_id} has no datasets, so it cannot be split")
    make_empty(folder)
    for name, part in parts.items():
        written = write_part(part, path_inside(folder, name), Store(chosen.store))
        write_page(written, written.folder / REPORT_FILE)
    return f"{counted(len(parts), 'run folder')}: {', '.join(parts)}"


def _folder_inside(run: Run, *names: str) -> Path:
    folder = run.home_folder
    for name in names:
        folder /= name
        if folder.is_symlink():
            raise ArgumentError(
                f"{folder} is a link: choose another folder with -o, or remove the link"
            )
    return folder


def _refuse_filled(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ArgumentError(
            f"{folder} already exists and is not empty: choose another folder with -o, or remove it"
        )
