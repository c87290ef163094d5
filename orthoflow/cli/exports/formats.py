"""The formats of `orthoflow export`: one entry each, which help and refusals follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

from orthoflow.errors import ArgumentError

if TYPE_CHECKING:
    from orthoflow.cli.exports.choices import Choices
    from orthoflow.records.runs import Run


class Writer(Protocol):
    """Writes a format."""

    def __call__(self, run: Run, folder: Path, chosen: Choices, /) -> str:
        """Make a folder with `make_empty` once all is there, fill it, and say what was written."""


@dataclass(frozen=True, kw_only=True)
class Format:
    """One format of `--to`.

    Attributes:
        writer: import string `module:function` below `orthoflow.cli.exports`, of a `Writer`.
        summary: what it holds, for the help.
        options: the fields of `Choices` that belong to it.
        takes_rasters: it reads GeoTIFFs that the run published.
    """

    writer: str
    summary: str
    options: frozenset[str] = frozenset()
    takes_rasters: bool = False

    def load(self) -> Writer:
        """Import the module and give the function."""
        module_name, _, function = self.writer.partition(":")
        writer: Writer = getattr(import_module(f"{__package__}.{module_name}"), function)
        return writer


_CLOUD_OPTIONS: Final = frozenset({"cell", "colour", "wall", "box", "clean"})

_SECTION_OPTIONS: Final = frozenset(
    {"cell", "scale", "paper", "grid", "title_block", "dimensions", "language"}
)

FORMATS: Final[Mapping[str, Format]] = {
    "colmap": Format(
        writer="results:export_colmap",
        summary="the oriented photos with their lenses and ties as a text model that COLMAP opens",
        options=frozenset({"cell"}),
    ),
    "csv": Format(
        writer="results:export_csv",
        summary="tables of steps, metrics, parameters, inputs, products and environments",
    ),
    "dxf": Format(
        writer="drawings:export_dxf",
        summary="each wall in its own coordinates with its orthoimage to scale, and the room in "
        "space: planes, where they meet, outline, check points",
        options=frozenset({"cell", "wall"}),
        takes_rasters=True,
    ),
    "figures": Format(
        writer="results:export_figures",
        summary="all figures, the plan of the photos and the curves of sweeps, for publication: "
        "--format pdf, svg or png",
        options=frozenset({"cell", "figure_format"}),
    ),
    "tables": Format(
        writer="results:export_tables",
        summary="tables of results as CSV, LaTeX and Markdown, and the citations as BibTeX",
    ),
    "geojson": Format(
        writer="drawings:export_geojson",
        summary="outlines of walls and lines in which planes meet, from above and in the "
        "coordinates of each wall",
        options=frozenset({"cell", "wall"}),
        takes_rasters=True,
    ),
    "layers": Format(
        writer="results:export_layers",
        summary="the part of each photo on each wall, as GeoTIFFs, from the store unless "
        "the run was made with --embed",
        options=frozenset({"cell"}),
    ),
    "laz": Format(
        writer="clouds:export_laz",
        summary="the registered cloud as LAZ 1.4 with colours, normals, plane, deviation from it "
        "and scan of each point",
        options=_CLOUD_OPTIONS,
    ),
    "copc": Format(
        writer="clouds:export_copc",
        summary="the same as COPC, a LAZ with an octree: viewers load what they show",
        options=_CLOUD_OPTIONS,
    ),
    "ply": Format(
        writer="clouds:export_ply",
        summary="the same as binary PLY with double coordinates",
        options=_CLOUD_OPTIONS,
    ),
    "e57": Format(
        writer="clouds:export_e57",
        summary="the same as E57, one scan each with its pose",
        options=_CLOUD_OPTIONS,
    ),
    "gltf": Format(
        writer="viewers:export_gltf",
        summary="the walls of the room with their orthoimages as a model that browsers open, "
        "room.glb",
        options=frozenset({"cell", "wall", "relief"}),
        takes_rasters=True,
    ),
    "tiles": Format(
        writer="viewers:export_tiles",
        summary="each orthoimage as Deep Zoom tiles, with a page that measures on them without a "
        "server",
        options=frozenset({"cell", "wall"}),
        takes_rasters=True,
    ),
    "plan": Format(
        writer="sections:export_plans",
        summary=(
            "the room cut horizontally at --height above the floor, as DXF, SVG and PDF to scale"
        ),
        options=_SECTION_OPTIONS | {"heights_m"},
        takes_rasters=True,
    ),
    "section": Format(
        writer="sections:export_sections",
        summary="the room cut vertically through two points of the plan, likewise",
        options=_SECTION_OPTIONS | {"through"},
        takes_rasters=True,
    ),
    "elevation": Format(
        writer="sheets:export_elevations",
        summary="the walls of the room unfolded on one sheet, at their true heights, as PDF",
        options=frozenset({"cell", "scale", "paper", "title_block", "language"}),
        takes_rasters=True,
    ),
    "relief": Format(
        writer="drawings:export_relief",
        summary="each wall as shaded relief, with contour lines and depths in colour",
        options=frozenset({"cell", "wall", "light"}),
        takes_rasters=True,
    ),
    "qgis": Format(
        writer="drawings:export_qgis",
        summary="a QGIS project in which the walls stand side by side at their heights",
        options=frozenset({"cell"}),
        takes_rasters=True,
    ),
    "iiif": Format(
        writer="viewers:export_iiif",
        summary="an IIIF manifest with the pictures of each wall as layers, and their tiles",
        options=frozenset({"cell", "wall", "base_url"}),
        takes_rasters=True,
    ),
    "prov": Format(
        writer="results:export_prov",
        summary=(
            "W3C PROV-JSON: which products were derived from which, by which method of "
            "which software"
        ),
    ),
    "stac": Format(
        writer="results:export_stac",
        summary="the orthoimages with a STAC item beside each, and a collection",
        takes_rasters=True,
    ),
    "ro-crate": Format(
        writer="results:export_crate",
        summary="record, report and products as a Provenance Run Crate, for archives",
        options=frozenset({"license_text", "author"}),
        takes_rasters=True,
    ),
    "sheet": Format(
        writer="sheets:export_sheets",
        summary="each wall on paper in exact scale, as PDF, with coordinates, title block, "
        "legend, accuracy and the seal of the record",
        options=frozenset(
            {"cell", "scale", "paper", "wall", "grid", "units", "title_block", "beside", "language"}
        ),
        takes_rasters=True,
    ),
}


def check_choices(chosen: Choices, target: str | None, flags: Mapping[str, str]) -> None:
    """Refuse options that do not belong to the format.

    Args:
        chosen: the options.
        target: the format.
        flags: field of `Choices` -> the option as users write it, in the order of the help.

    Raises:
        ArgumentError: one does not, or no format is named.
    """
    if target is None and not chosen.embed and not chosen.split:
        raise ArgumentError(
            f"choose what to write: --to {listed(tuple(FORMATS))}, or --embed or --split"
        )
    said = f"--to {target}" if target else "--split" if chosen.split else "--embed"
    if chosen.split and (target or chosen.embed):
        raise ArgumentError(
            f"--split writes records of its own, so it cannot be combined with "
            f"{f'--to {target}' if target else '--embed'}: split first, then export each, as "
            f"orthoflow export RUN/datasets/NAME {f'--to {target}' if target else '--embed'}"
        )
    taken = FORMATS[target].options if target else ()
    for name, flag in flags.items():
        owners = [owner for owner, entry in FORMATS.items() if name in entry.options]
        if owners and name not in taken and _is_given(getattr(chosen, name)):
            raise ArgumentError(f"{flag} belongs to --to {listed(owners)}, not to {said}")
    if chosen.embed and target not in {None, "ro-crate"}:
        raise ArgumentError(f"{said} writes no record, so nothing can be embedded with --embed")
    if chosen.inputs and not chosen.embed:
        raise ArgumentError(f"--input belongs to --embed, not to {said}")


def listed(names: Sequence[str]) -> str:
    """Give names as a sentence has them: `a, b or c`."""
    return " or ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _is_given(value: object) -> bool:
    return value is not None and value is not False and value != ()
