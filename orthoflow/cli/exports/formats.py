"""The formats of `orthoflow export`: one entry each, which help and refusals follow."""

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
    """Writes a format."""

    def __call__(self, run: Run, folder: Path, chosen: Choices, /) -> str:
        """Make a folder with `make_empty` once all is there, fill it, and say what was written."""


@dataclass(frozen=True)
class Format:
    """One format of `--to`.

    Attributes:
        writer: import string `module:function` below `orthoflow.cli.exports`, of a `Writer`.
        summary: what it holds, for the help.
        takes_rasters: it reads GeoTIFFs that the run published.
    """

    writer: str
    summary: str
    takes_rasters: bool = False

    def load(self) -> Writer:
        """Import the module and give the function."""
        module_name, _, function = self.writer.partition(":")
        writer: Writer = getattr(import_module(f"{__package__}.{module_name}"), function)
        return writer


FORMATS: Final[Mapping[str, Format]] = {
    "colmap": Format(
        "results:export_colmap",
        "the oriented photos with their lenses and ties as a text model that COLMAP opens",
    ),
    "csv": Format(
        "results:export_csv",
        "tables of steps, metrics, parameters, inputs, products and environments",
    ),
    "dxf": Format(
        "drawings:export_dxf",
        "each wall in its own coordinates with its orthoimage to scale, and the room in "
        "space: planes, where they meet, outline, check points",
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
        "outlines of walls and lines in which planes meet, from above and in the "
        "coordinates of each wall",
        takes_rasters=True,
    ),
    "layers": Format(
        "results:export_layers",
        "the part of each photo on each wall, as GeoTIFFs, from the store unless "
        "the run was made with --embed",
    ),
    "laz": Format(
        "clouds:export_laz",
        "the registered cloud as LAZ 1.4 with colours, normals, plane, deviation from it "
        "and scan of each point",
    ),
    "copc": Format(
        "clouds:export_copc",
        "the same as COPC, a LAZ with an octree: viewers load what they show",
    ),
    "ply": Format(
        "clouds:export_ply",
        "the same as binary PLY with double coordinates",
    ),
    "e57": Format(
        "clouds:export_e57",
        "the same as E57, one scan each with its pose",
    ),
    "gltf": Format(
        "viewers:export_gltf",
        "the walls of the room with their orthoimages as a model that browsers open, room.glb",
        takes_rasters=True,
    ),
    "tiles": Format(
        "viewers:export_tiles",
        "each orthoimage as Deep Zoom tiles, with a page that measures on them without a server",
        takes_rasters=True,
    ),
    "plan": Format(
        "sections:export_plans",
        ("the room cut horizontally at --height above the floor, as DXF, SVG and PDF to scale"),
        takes_rasters=True,
    ),
    "section": Format(
        "sections:export_sections",
        "the room cut vertically through two points of the plan, likewise",
        takes_rasters=True,
    ),
    "elevation": Format(
        "sheets:export_elevations",
        "the walls of the room unfolded on one sheet, at their true heights, as PDF",
        takes_rasters=True,
    ),
    "relief": Format(
        "drawings:export_relief",
        "each wall as shaded relief, with contour lines and depths in colour",
        takes_rasters=True,
    ),
    "qgis": Format(
        "drawings:export_qgis",
        "a QGIS project in which the walls stand side by side at their heights",
        takes_rasters=True,
    ),
    "iiif": Format(
        "viewers:export_iiif",
        "an IIIF manifest with the pictures of each wall as layers, and their tiles",
        takes_rasters=True,
    ),
    "prov": Format(
        "results:export_prov",
        (
            "W3C PROV-JSON: which products were derived from which, by which method of "
            "which software"
        ),
    ),
    "stac": Format(
        "results:export_stac",
        "the orthoimages with a STAC item beside each, and a collection",
        takes_rasters=True,
    ),
    "ro-crate": Format(
        "results:export_crate",
        "record, report and products as a Provenance Run Crate, for archives",
        takes_rasters=True,
    ),
    "sheet": Format(
        "sheets:export_sheets",
        "each wall on paper in exact scale, as PDF, with coordinates, title block, "
        "legend, accuracy and the seal of the record",
        takes_rasters=True,
    ),
}


class FormatOption(click.Option):
    """An option that belongs to some formats only.

    Attributes:
        formats: those that it belongs to.
    """

    # Any: the arguments are click's.
    def __init__(self, *args: Any, formats: Sequence[str], **more: Any) -> None:
        super().__init__(*args, **more)
        self.formats = formats


def check_choices(chosen: Choices, target: str | None, options: Sequence[FormatOption]) -> None:
    """Refuse options that do not belong to the format.

    Raises:
        ArgumentError: one does not, or no format is named.
    """
    if target is None and not chosen.embed and not chosen.split:
        raise ArgumentError(
            f"choose what to write: --to {listed(tuple(FORMATS))}, or --embed or --split"
        )
    beside = f"--to {target}" if target else "--embed"
    if chosen.split and (target or chosen.embed):
        raise ArgumentError(
            f"--split writes records of its own, so it cannot be combined with {beside}: split "
            f"first, then export each, as orthoflow export RUN/datasets/NAME {beside}"
        )
    said = "--split" if chosen.split else beside
    for option in options:
        value = getattr(chosen, str(option.name))
        # A grid of 0 and wall 0 are given; a flag that nobody set is False.
        is_given = value is not None and value is not False and value != ()
        if is_given and target not in option.formats:
            owners = [name for name in FORMATS if name in option.formats]
            raise ArgumentError(f"{option.opts[0]} belongs to --to {listed(owners)}, not to {said}")
    if chosen.embed and target not in {None, "ro-crate"}:
        raise ArgumentError(f"{said} writes no record, so nothing can be embedded with --embed")
    if chosen.inputs and not chosen.embed:
        raise ArgumentError(f"--input belongs to --embed, not to {said}")


def listed(names: Sequence[str]) -> str:
    """Give names as a sentence has them: `a, b or c`."""
    return " or ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
