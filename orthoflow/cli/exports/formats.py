"""The table of formats of `orthoflow export`, and the check of options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

import click

from orthoflow.errors import ArgumentError

if TYPE_CHECKING:
    from orthoflow.cli.exports.choices import Choices
    from orthoflow.records.runs import Run


class Writer(Protocol):
    """Function that writes a format."""

    def __call__(self, run: Run, folder: Path, chosen: Choices, /) -> str:
        """Write to a folder and return a summary.

        The function creates the folder by `make_empty` when all checks have succeeded.
        """


@dataclass(frozen=True)
class Format:
    """One format of `--to`.

    Attributes:
        writer: import string `module:function` of a `Writer`, relative to `orthoflow.cli.exports`.
        summary: description of the written files, for the help.
        takes_rasters: whether the writer reads GeoTIFFs that the run published.
    """

    writer: str
    summary: str
    takes_rasters: bool = False

    def load(self) -> Writer:
        """Import the module and return the function."""
        module_name, _, function = self.writer.partition(":")
        writer: Writer = getattr(import_module(f"{__package__}.{module_name}"), function)
        return writer


FORMATS: Final[Mapping[str, Format]] = {
    "colmap": Format(
        "results:export_colmap",
        "the oriented photos with their lenses and ties as a COLMAP text model",
    ),
    "csv": Format(
        "results:export_csv",
        "tables of steps, metrics, parameters, inputs, products and environments",
    ),
    "dxf": Format(
        "drawings:export_dxf",
        "each wall in its own coordinates with its orthoimage to scale, and the room in 3D: "
        "planes, their intersections, outline, check points",
        takes_rasters=True,
    ),
    "figures": Format(
        "results:export_figures",
        "all figures, the plan of the photos and the curves of sweeps, for publication: "
        "--format pdf, svg or png",
    ),
    "tables": Format(
        "results:export_tables",
        "tables of results as CSV, LaTeX and Markdown, and the citations as BibTeX",
    ),
    "geojson": Format(
        "drawings:export_geojson",
        "outlines of walls and intersections of planes, in plan view and in the "
        "coordinates of each wall",
        takes_rasters=True,
    ),
    "layers": Format(
        "results:export_layers",
        "each photo projected onto each wall, as GeoTIFFs; from the store unless the run was "
        "made with --embed",
    ),
    "laz": Format(
        "clouds:export_laz",
        "the registered cloud as LAZ 1.4, with the colour, normal, plane, distance from the "
        "plane and scan of each point",
    ),
    "copc": Format(
        "clouds:export_copc",
        "the registered cloud as COPC (LAZ with an octree), from which viewers load only the "
        "visible part",
    ),
    "ply": Format(
        "clouds:export_ply",
        "the registered cloud as binary PLY with double-precision coordinates",
    ),
    "e57": Format(
        "clouds:export_e57",
        "the registered cloud as E57, with a pose for each scan",
    ),
    "gltf": Format(
        "viewers:export_gltf",
        "the walls of the room with their orthoimages as a 3D model, with a page to view it",
        takes_rasters=True,
    ),
    "tiles": Format(
        "viewers:export_tiles",
        "each orthoimage as Deep Zoom tiles, with a page for measuring that needs no server",
        takes_rasters=True,
    ),
    "plan": Format(
        "sections:export_plans",
        "a horizontal section of the room at --height above the floor, as DXF, SVG and PDF "
        "to scale",
        takes_rasters=True,
    ),
    "section": Format(
        "sections:export_sections",
        "a vertical section of the room through two points of the plan, in the same formats",
        takes_rasters=True,
    ),
    "elevation": Format(
        "sheets:export_elevations",
        "the walls of the room side by side at their heights on one sheet, as PDF",
        takes_rasters=True,
    ),
    "relief": Format(
        "drawings:export_relief",
        "a shaded relief of each wall, with contour lines and coloured depths",
        takes_rasters=True,
    ),
    "qgis": Format(
        "drawings:export_qgis",
        "a QGIS project with the walls side by side at their heights",
        takes_rasters=True,
    ),
    "iiif": Format(
        "viewers:export_iiif",
        "an IIIF manifest with the pictures of each wall as layers, and their tiles",
        takes_rasters=True,
    ),
    "prov": Format(
        "results:export_prov",
        ("W3C PROV-JSON: the origin of every product, with the methods and software that made it"),
    ),
    "stac": Format(
        "results:export_stac",
        "the orthoimages with a STAC item for each, and a collection",
        takes_rasters=True,
    ),
    "ro-crate": Format(
        "results:export_crate",
        "record, report and products as a Provenance Run Crate, for archives",
        takes_rasters=True,
    ),
    "sheet": Format(
        "sheets:export_sheets",
        "each wall to scale as PDF, with coordinates, title block, legend, accuracy and the "
        "seal of the record",
        takes_rasters=True,
    ),
}


class FormatOption(click.Option):
    """An option that applies only to some formats.

    Attributes:
        formats: names of the formats to which it applies.
    """

    # The types are `Any` because the arguments are passed on to click.
    def __init__(self, *args: Any, formats: Sequence[str], **more: Any) -> None:
        super().__init__(*args, **more)
        self.formats = formats


def _is_given(value: object) -> bool:
    # An option is given even if its value is 0, as in `--wall 0`; a flag that is not set is False.
    return value is not None and value is not False and value != ()


def check_choices(chosen: Choices, target: str | None, options: Sequence[FormatOption]) -> None:
    """Raise an error if an option does not apply to the format.

    Raises:
        ArgumentError: an option does not apply to the format, or no format is given.
    """
    mode = f"--to {target}" if target else "--split" if chosen.split else "--embed"
    if not (target or chosen.embed or chosen.split):
        raise ArgumentError(f"choose a format: --to {', '.join(FORMATS)}, or --embed or --split")
    refused = [
        option.opts[0]
        for option in options
        if target not in option.formats and _is_given(getattr(chosen, str(option.name)))
    ]
    if chosen.split and target:
        refused.append("--split")
    if chosen.embed and (chosen.split or target not in {None, "ro-crate"}):
        refused.append("--embed")
    if chosen.inputs and not chosen.embed:
        refused.append("--input")
    if refused:
        raise ArgumentError(
            f"{' and '.join(refused)} cannot be combined with {mode}; `orthoflow export --help` "
            "lists the options of each format"
        )
