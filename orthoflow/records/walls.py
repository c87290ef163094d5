"""Results of a run for each wall (rasters, accuracy and openings), and which walls to deliver."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from orthoflow_provenance.document import RecordedCell
from pydantic import TypeAdapter, ValidationError

from orthoflow.diagnostics import grouped, standing
from orthoflow.engine.journal import cell_file_name
from orthoflow.errors import ArgumentError, InputError, RecordError
from orthoflow.files.drawings.words import Phrase
from orthoflow.files.geotiff import RasterParts
from orthoflow.files.sidecars import placed_raster, read_sidecar, write_json
from orthoflow.files.wall_descriptions import ORTHO_FILE, WallDescription, described
from orthoflow.geometry import WallFrame
from orthoflow.products import (
    CheckPoints,
    Inspection,
    Opening,
    Openings,
    Planes,
    Walls,
)
from orthoflow.records.runs import (
    PRODUCTS_FOLDER,
    Run,
    published_files,
    require_unchanged,
    upstream_cells,
)

WALLS_FILE: Final = "walls.json"
_WALLS_LARGEST_BYTES: Final = 1 << 22
_DEPTH: Final = re.compile(r"(?:[a-z]+_)?wall_(\d{1,5})_depth\.tif")
_WALLS: Final = TypeAdapter(dict[str, tuple[WallDescription, ...]])


def delivered_walls(products: Path) -> tuple[WallDescription, ...]:
    """Read the `walls.json` of a run; empty if it is missing, unreadable or invalid."""
    path = products / WALLS_FILE
    try:
        if path.is_symlink() or path.stat().st_size > _WALLS_LARGEST_BYTES:
            return ()
        return _WALLS.validate_json(path.read_bytes()).get("walls", ())
    except (OSError, ValidationError):
        return ()


def add_errors(folder: Path, address: str, cells: Sequence[RecordedCell]) -> None:
    """Add the errors of a run that affect orthoimages to the sidecar files, as `errors`.

    These are the diagnostics of the cell and its upstream cells that have the severity `error` and
    do not concern a single wall. Errors that concern a single wall are omitted, because they reduce
    its covered share.

    Args:
        folder: folder with the published files of the cell.
        address: address of the cell.
        cells: cells of the run.
    """
    upstream = list(upstream_cells({cell.address: cell for cell in cells}, address))
    errors = [
        group.sentence
        for group in grouped(standing(upstream))
        if group.worst.severity == "error" and not group.worst.subject
    ]
    for path in folder.glob("*_ortho.json") if errors else ():
        # JSON values may have any type.
        content: dict[str, Any] = read_sidecar(path)
        write_json(path, content | {"errors": errors})


def write_walls_json(products: Path, cells: Sequence[RecordedCell]) -> None:
    """Write `walls.json` into the products folder of a run if there are orthoimages.

    If there are several combinations of variants, the last one is used, as for drawings.

    Args:
        products: folder with the files of all cells.
        cells: cells of the run, in order.
    """
    pictured = [
        cell
        for cell in cells
        if cell.status == "ok"
        and cell.inputs
        and any(output.type_name == "orthoimages" for output in cell.outputs.values())
    ]
    if not pictured:
        return
    walls = {}
    for number, path, sidecar in _with_sidecars(products, pictured[-1], ORTHO_FILE):
        image = path.relative_to(products).as_posix()
        walls[number] = described(path, sidecar).model_copy(update={"orthoimage": image})
    included = {
        int(other): number
        for cell in cells
        for number, _, sidecar in _with_sidecars(products, cell, _DEPTH)
        if number in walls and isinstance(others := sidecar.get("includes_walls"), list)
        for other in others
    }
    walls |= {
        number: WallDescription(
            number=number,
            name=f"wall {number}",
            kind="wall",
            recommended=False,
            reason=f"already included in wall {wall}",
        )
        for number, wall in included.items()
        if number not in walls
    }
    ranked = sorted(walls.values(), key=_rank)
    write_json(products / WALLS_FILE, {"walls": [wall.model_dump() for wall in ranked]})


def _with_sidecars(
    products: Path, cell: RecordedCell, pattern: re.Pattern[str]
) -> Iterator[tuple[int, Path, Mapping[str, object]]]:
    for path in sorted((products / cell_file_name(cell.address)).glob("*.json")):
        raster = path.with_suffix(".tif")
        if found := pattern.fullmatch(raster.name):
            try:
                yield int(found[1]), raster, read_sidecar(path)
            except InputError:
                continue


def _rank(wall: WallDescription) -> tuple[bool, float, int]:
    """Return a sort key: recommended walls first, then by descending covered area."""
    return not wall.recommended, -(wall.area_m2 or 0.0) * (wall.painted_share or 0.0), wall.number


_RASTER: Final = re.compile(r"(?:[a-z]+_)?wall_(\d{1,5})_(ortho|depth|intensity)\.tif")
# Accuracy statements on drawings: the names of two findings, the key of the phrase, and names of
# findings that may contain the number of items.
_ACCURACY: Final = (
    ("rmse_x_mm", "rmse_y_mm", "rmse", ("n_found", "n_pairs")),
    ("rmse_u_mm", "rmse_v_mm", "rmse", ()),
    ("patch_rmse_u_mm", "patch_rmse_v_mm", "patch_rmse", ("n_patches",)),
    ("rms_3d_mm", "max_3d_mm", "rms_3d", ("n_3d",)),
)
_COUNTED: Final = {
    "n_found": "n_check_points",
    "n_pairs": "n_pairs",
    "n_patches": "n_patches",
    "n_3d": "n_check_points",
}


@dataclass(frozen=True, kw_only=True)
class WallResult:
    """The results of a run for one wall.

    Attributes:
        number: number of the wall, as in the names of its files.
        name: name of the wall.
        about: description of the orthoimage; None if there is no orthoimage.
        plane_index: index of the plane in `planes.json`; None if unknown.
        frame: wall frame of the largest raster.
        rasters: `ortho`, `depth` or `intensity` -> GeoTIFF; missing rasters are omitted.
        accuracy: phrases on the expected error of the orthoimage, the noise of the plane, and the
            inspections, based only on data from this wall.
        colours: how the colours of the photos were changed; None if there is no orthoimage.
        intensity_source: `laser`, or `luminance` if the intensity was computed from the colours.
    """

    number: int
    name: str
    about: WallDescription | None
    plane_index: int | None
    frame: WallFrame
    rasters: dict[str, Path]
    accuracy: tuple[Phrase, ...]
    colours: Phrase | None
    intensity_source: str = "laser"


@dataclass(frozen=True, kw_only=True)
class UncountedPoints:
    """Reason why none of the check points of a run was used.

    Attributes:
        cell: address of the inspection that failed; empty if no inspection has check points as
            input.
        sentence: end of a sentence that states that the accuracy was not measured; contains the
            reason.
        phrase: phrase for drawings, without the reason, which cannot be translated.
    """

    cell: str
    sentence: str
    phrase: Phrase


@dataclass(frozen=True, kw_only=True)
class RoomResults:
    """The results of a run for the walls of a room.

    Attributes:
        address: address of the cell with the orthoimages or rasters.
        walls: walls with a raster, sorted by number.
        planes: all planes; None if the record has none.
        checkpoints: surveyed check points; None if there are none.
        inspections: address -> displacements that the inspection found in these orthoimages, with
            wall numbers.
        openings: openings in these walls, sorted by wall number, then from left to right.
    """

    address: str
    walls: tuple[WallResult, ...]
    planes: Planes | None
    checkpoints: CheckPoints | None
    inspections: dict[str, Inspection]
    openings: tuple[Opening, ...] = ()

    @property
    def crs(self) -> str | None:
        """Coordinate reference system of the scan; None if it has none."""
        return next((wall.frame.map_crs for wall in self.walls if wall.frame.map_crs), None)

    def openings_of(self, wall: WallResult) -> tuple[Opening, ...]:
        """Openings in one wall."""
        return tuple(opening for opening in self.openings if opening.wall == wall.number)


def uncounted_points(run: Run) -> UncountedPoints | None:
    """Determine why none of the check points of a run is used.

    Returns:
        None if there are no check points, or if an inspection used some.
    """
    looking = [
        (cell, given.source)
        for cell in run.cells.values()
        for given in cell.inputs.values()
        if given.type_name == CheckPoints.type_name
    ]
    # Only check points from files count, because the user did not provide those of a simulated
    # room.
    read = [name for name, cell in run.cells.items() if cell.method.startswith("read.")]
    sources = [source.rpartition(".")[0] for _, source in looking]
    place = _upstream_product(run, tuple(sources or read), CheckPoints.type_name)
    if place is None or any(cell.status == "ok" for cell, _ in looking):
        return None
    n_points = len(CheckPoints.from_payload(run.payload(*place)).names)
    were = "check point was" if n_points == 1 else "check points were"
    why = looking[0][0].error_message if looking else "no step used them"
    return UncountedPoints(
        cell=looking[0][0].address if looking else "",
        sentence=f"although {n_points} {were} given: {why}",
        phrase=Phrase(
            key="points_unusable" if looking else "points_unused", values={"count": f"{n_points:,}"}
        ),
    )


def room_results(run: Run, cell: str | None = None, wall: int | None = None) -> RoomResults:
    """Collect the results of a run for its walls.

    Args:
        run: a finished run, with the published files of its record.
        cell: address of the cell with orthoimages or wall rasters; by default the last cell that
            produced orthoimages, or the last that produced wall rasters if there are no
            orthoimages.
        wall: number of a single wall to return, in which case the files of other walls are not
            needed; if there is no such wall, all are returned.

    Raises:
        ArgumentError: there is no such cell, or there are no rasters.
        RecordError: a published file differs from the record, or an orthoimage is missing.
    """
    address = pictured_cell(run, cell)
    require_orthoimages(run, address, wall)
    upstream = tuple(cell.address for cell in run.upstream(address))
    files: dict[int, dict[str, Path]] = {}
    pictured = [
        name
        for name in upstream
        if {"orthoimages", "walls"} & {out.type_name for out in run.cells[name].outputs.values()}
    ]
    # Begin with the chosen cell, so that its files take precedence over those of upstream cells.
    for name in reversed(pictured):
        for path in published_files(run.folder, name):
            if found := _RASTER.fullmatch(path.name):
                files.setdefault(int(found[1]), {})[found[2]] = path
    if not files:
        raise ArgumentError(
            f"no rasters of walls were found for {run.path} in {run.products_folder}: pass the "
            "unmodified run folder"
        )
    planes = _upstream_product(run, upstream, "planes")
    points = _upstream_product(run, (*upstream, *run.cells), "checkpoints")
    # Rasters are created in the order of the planes, so an index into `Walls` is an index into this
    # list.
    numbers = sorted(
        {number for name in pictured for number, kind in _rasters(run, name) if kind == "depth"}
    )
    inspections = {
        name: _numbered(inspection, numbers or sorted(files))
        for name, inspection in _inspections(run, address)
    }
    kept = Planes.from_payload(run.payload(*planes)) if planes else None
    colours = colours_phrase(run, address)
    return RoomResults(
        address=address,
        walls=tuple(
            _with_inspections(run, result, tuple(accuracy_phrases(inspections, number)))
            for number in ([wall] if wall in files else sorted(files))
            for result in [_wall_result(run, number, files[number], kept, colours)]
        ),
        planes=kept,
        checkpoints=CheckPoints.from_payload(run.payload(*points)) if points else None,
        inspections=inspections,
        openings=_openings(run, upstream),
    )


def _rasters(run: Run, address: str) -> dict[tuple[int, str], str]:
    """Return (wall number, kind) -> path relative to the run folder, for the rasters of a cell."""
    folder = f"{PRODUCTS_FOLDER}/{cell_file_name(address)}/"
    return {
        (int(found[1]), found[2]): file.path
        for file in run.record.published
        if (found := _RASTER.fullmatch(file.path.removeprefix(folder)))
    }


def require_orthoimages(run: Run, address: str, wall: int | None) -> None:
    """Raise an error if a published orthoimage is missing.

    Otherwise, a raster of an upstream cell would be used instead.
    """
    for (number, kind), path in _rasters(run, address).items():
        is_wanted = kind == "ortho" and wall in {None, number}
        if is_wanted and not (run.folder / path).exists():
            raise RecordError(
                f"{path} is missing from {run.folder}, where the run published it: copy it back, "
                f"or recreate it with `orthoflow replay {shlex.quote(str(run.path))} -o NEW`"
            )


def _openings(run: Run, upstream: tuple[str, ...]) -> tuple[Opening, ...]:
    walls = {
        output.digest
        for address in upstream
        for output in run.cells[address].outputs.values()
        if output.type_name == Walls.type_name
    }
    found: tuple[Opening, ...] = ()
    for address, recorded in run.cells.items():
        if walls & {item.digest for item in recorded.inputs.values()}:
            for port, output in recorded.outputs.items():
                if output.type_name == Openings.type_name and output.embedded:
                    found = Openings.from_payload(run.payload(address, port)).openings
    return tuple(sorted(found, key=lambda opening: opening.wall))


def pictured_cell(run: Run, cell: str | None) -> str:
    """Return the address of the cell whose orthoimages, or else walls, are shown.

    Raises:
        ArgumentError: the run has none, or the named cell has none.
    """
    found = {
        name: [
            address
            for address, recorded in run.cells.items()
            if any(output.type_name == name for output in recorded.outputs.values())
        ]
        for name in ("orthoimages", "walls")
    }
    if cell is None:
        if not found["orthoimages"] and not found["walls"]:
            raise ArgumentError(
                run.with_failure(f"the run {run.record.run_id} has no orthoimages and no walls")
            )
        return (found["orthoimages"] or found["walls"])[-1]
    run.cell(cell)
    everything = [*found["orthoimages"], *found["walls"]]
    if cell not in everything:
        raise ArgumentError(
            f"the step {cell} has no orthoimages or walls; steps of this run that have them: "
            f"{', '.join(everything) or 'none'}"
        )
    return cell


def _upstream_product(
    run: Run, addresses: tuple[str, ...], type_name: str
) -> tuple[str, str] | None:
    for address in addresses:
        for port, output in run.cells[address].outputs.items():
            if output.type_name == type_name and output.embedded:
                return address, port
    return None


def _inspections(run: Run, address: str) -> Iterator[tuple[str, Inspection]]:
    shown = {output.digest for output in run.cells[address].outputs.values()}
    for name, recorded in run.cells.items():
        if shown & {item.digest for item in recorded.inputs.values()}:
            for port, output in recorded.outputs.items():
                if output.type_name == "inspection" and output.embedded:
                    yield name, Inspection.from_payload(run.payload(name, port))


def _numbered(inspection: Inspection, numbers: list[int]) -> Inspection:
    number_of = dict(enumerate(numbers))
    walls = [number_of.get(place, -1) for place in inspection.wall.tolist()]
    return replace(
        inspection,
        wall=np.array(walls, dtype=np.int32),
        findings=tuple(
            replace(item, wall=number_of.get(item.wall, -1)) for item in inspection.findings
        ),
    )


def _wall_result(
    run: Run,
    number: int,
    rasters: dict[str, Path],
    planes: Planes | None,
    colours: Phrase,
) -> WallResult:
    for path in rasters.values():
        require_unchanged(run, path, path.with_suffix(".json"))
    first = rasters[next(kind for kind in ("ortho", "depth", "intensity") if kind in rasters)]
    for kind, path in rasters.items():
        _check_kind(kind, path)
    frame, content = placed_raster(first)
    error = first.with_name(first.name.replace("_ortho.tif", "_error.tif"))
    about = read_sidecar(rasters["depth"].with_suffix(".json")) if "depth" in rasters else {}
    index = about.get("plane_index", number)
    known = planes is not None and isinstance(index, int) and 0 <= index < len(planes)
    plane_index = index if known and isinstance(index, int) else None
    description = described(first, content) if "ortho" in rasters else None
    phrase = [description.accuracy] if description and error.exists() else []
    if planes is not None and plane_index is not None:
        rms_mm = 1e3 * float(planes.rms_m[plane_index])
        count = f"{int(planes.n_points[plane_index]):,}"
        phrase.append(Phrase(key="plane_noise", values={"count": count, "rms": f"{rms_mm:.1f}"}))
    return WallResult(
        number=number,
        name=str(content.get("name") or f"wall {number}"),
        about=description,
        plane_index=plane_index,
        frame=frame,
        rasters=rasters,
        accuracy=tuple(phrase),
        colours=colours if "ortho" in rasters else None,
        intensity_source=str(about.get("intensity_source", "laser")),
    )


def _check_kind(kind: str, path: Path) -> None:
    with RasterParts(path) as raster:
        found = (raster.bands, raster.dtype)
    wanted = ((3, "uint8"), (3, "uint16")) if kind == "ortho" else ((1, "float32"),)
    if found not in wanted:
        raise RecordError(
            f"{path} must have {wanted[0][0]} bands of {' or '.join(name for _, name in wanted)}, "
            f"got {found[0]} of {found[1]}"
        )


def _with_inspections(run: Run, wall: WallResult, measured: tuple[Phrase, ...]) -> WallResult:
    if not measured and "ortho" in wall.rasters:
        uncounted = uncounted_points(run)
        if uncounted is not None:
            measured = (uncounted.phrase,)
        elif not {"expected_error", "not_checked"} & {phrase.key for phrase in wall.accuracy}:
            measured = (Phrase(key="unmeasured"),)
    return replace(wall, accuracy=(*wall.accuracy, *measured))


def accuracy_phrases(inspections: dict[str, Inspection], wall: int) -> Iterator[Phrase]:
    """Yield the measured accuracy of a wall, one phrase for each kind of inspection."""
    for inspection in inspections.values():
        own = {item.name: item.value for item in inspection.findings if item.wall == wall}
        for first, second, key, counts in _ACCURACY:
            if first in own and second in own:
                yield Phrase(
                    key=key,
                    values={"first": f"{own[first]:.1f}", "second": f"{own[second]:.1f}"},
                    asides=tuple(_of_how_many(own, counts)),
                )


def _of_how_many(values: Mapping[str, float], counts: tuple[str, ...]) -> Iterator[Phrase]:
    for name in counts:
        if name in values:
            yield Phrase(key=_COUNTED[name], values={"count": f"{values[name]:.0f}"})
            return


def colours_phrase(run: Run, address: str) -> Phrase:
    """Describe how the colours of photos or points were changed, according to the record."""
    cell = run.cells[address]
    whence = tuple(run.upstream(address))
    given = (one for before in whence for one in before.inputs.values())
    if all(one.type_name != "photos" for one in given):
        greys = (before.params.get("skip_below_grey") for before in whence)
        least = next((grey for grey in greys if grey), None)
        reported = {one.code for before in whence for one in before.diagnostics}
        if least or "black-points-left-out" in reported:
            return Phrase(key="colours_scan_dark", values={"least": least or 1})
        return Phrase(key="colours_scan")
    gains = cell.params.get("gains")
    if gains is None:
        return Phrase(key="colours_method", values={"method": cell.method})
    if gains == "none":
        return Phrase(key="colours_raw")
    if not any(metric.name == "gain_max" for metric in cell.metrics):
        return Phrase(key="colours_agree")
    return Phrase(key="colours_balanced")
