"""The folder `products/`, `walls.json` with the walls to deliver, and metrics as rows."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Final

from orthoflow_provenance.document import PublishedFile, RecordedCell, cost_metrics
from orthoflow_provenance.paths import colliding, files_below, path_below

from orthoflow.engine.durability import writing_to
from orthoflow.engine.file_digests import file_sha256
from orthoflow.engine.journal import cell_file_name
from orthoflow.errors import InputError, StoreError
from orthoflow.files.sidecars import read_sidecar, write_json
from orthoflow.foreign_text import csv_text
from orthoflow.geometry.threads import in_order
from orthoflow.products import JsonValue, OrthoMask

# As of fractions in the metadata of products (SPEC 11.3): libraries round their last digits.
_ROUNDING: Final = 1e-6
_UNITLESS: Final = ("1", "yes/no")
_COLUMNS: Final = ("cell", "step", "method", "metric", "value", "unit")


@dataclass(frozen=True, kw_only=True)
class MetricRow:
    """One number of one cell.

    Attributes:
        cell: address of the cell.
        step: name of its step.
        method: method id.
        metric: name, with its unit at the end where it has one.
        value: finite number.
        unit: `mm`, `px`, `s`, ...; `1` for counts and shares.
        label: what its method calls it; empty where it declares nothing.
        better: which values are better, `lower`, `higher` or `one`; empty where none are.
        description: what else to know of it.
        headline: it is one of the numbers that say how good a result is.
        counted_by: metric of the same step that says how many items it sums up.
    """

    cell: str
    step: str
    method: str
    metric: str
    value: float
    unit: str
    label: str = ""
    better: str = ""
    description: str = ""
    headline: bool = False
    counted_by: str = ""

    @property
    def title(self) -> str:
        """Its label; its name where its method declares none."""
        return self.label or self.metric

    @property
    def titled(self) -> str:
        """Its title with the unit; counts, shares and what is yes or no stand alone."""
        return self.title if self.unit in _UNITLESS else f"{self.title} / {self.unit}"


def cell_metrics(cell: RecordedCell) -> tuple[MetricRow, ...]:
    """Give what the method reported and then what the engine measured (time and memory).

    Cells without a result have no rows: their cost is not comparable with that of a result.
    """
    if cell.status != "ok":
        return ()
    return tuple(
        MetricRow(
            cell=cell.address,
            step=cell.step,
            method=cell.method,
            metric=metric.name,
            value=metric.value,
            unit=metric.unit,
            label=metric.label,
            better=metric.better,
            description=metric.description,
            headline=metric.headline,
            counted_by=metric.counted_by,
        )
        for metric in (*cell.metrics, *cost_metrics(cell))
    )


def is_rounding(left: float, right: float) -> bool:
    """Whether two values of a metric are equal or differ by what libraries round.

    By a millionth of the larger one that is, or by a millionth where that is below 1; counts are
    never rounded.

    >>> is_rounding(0.84536087, 0.84536104), is_rounding(1.0, 1.00001), is_rounding(3e7, 3e7 + 1)
    (True, False, False)
    """
    is_counted = all(float(value).is_integer() for value in (left, right))
    return left == right or (
        not is_counted and math.isclose(left, right, rel_tol=_ROUNDING, abs_tol=_ROUNDING)
    )


def write_metrics_csv(path: Path, rows: Iterable[MetricRow]) -> None:
    """Write rows with a header; numbers with every digit that they have."""
    text = csv_text([_COLUMNS, *([getattr(row, name) for name in _COLUMNS] for row in rows)])
    path.write_text(text, encoding="utf-8", newline="")


WALLS_FILE: Final = "walls.json"
_ORTHO: Final = re.compile(r"(?:[a-z]+_)?wall_(\d{1,5})_ortho\.json")
_DEPTH: Final = re.compile(r"(?:[a-z]+_)?wall_(\d{1,5})_depth\.json")
# An image of which less is painted is no view of its wall.
_LEAST_PAINTED_SHARE: Final = 0.5


def write_walls_json(products: Path, cells: Sequence[RecordedCell]) -> None:
    """Write `walls.json` into the products of a run; nothing where it gave no orthoimages.

    Of several combinations the one that was run last counts, as for drawings.

    Args:
        products: folder in which the files of all cells lie.
        cells: of the run, in order.
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
    folder = products / cell_file_name(pictured[-1].address)
    images = {number: content for number, _, content in _sidecars(folder, _ORTHO)}
    paths = {number: path for number, path, _ in _sidecars(folder, _ORTHO)}
    walls: list[dict[str, JsonValue]] = []
    for number, content in images.items():
        image = paths[number].with_suffix(".tif").relative_to(products).as_posix()
        error = paths[number].with_name(paths[number].name.replace("_ortho.json", "_error.tif"))
        walls.append(_told(number, content, image, is_of_photos=error.exists()))
    walls += _included(products, cells, images)
    walls.sort(key=_rank)
    write_json(products / WALLS_FILE, {"walls": list(walls)})


def _sidecars(
    folder: Path, pattern: re.Pattern[str]
) -> Iterator[tuple[int, Path, dict[str, object]]]:
    for path in sorted(folder.glob("*.json")):
        if found := pattern.fullmatch(path.name):
            try:
                yield int(found[1]), path, read_sidecar(path)
            except InputError:
                continue


def _told(
    number: int, content: Mapping[str, object], image: str, *, is_of_photos: bool
) -> dict[str, JsonValue]:
    """What is said of one orthoimage."""
    counts = content.get("mask_counts")
    counts = counts if isinstance(counts, dict) else {}
    total = sum(counts.values()) or 1
    painted = float(counts.get(str(int(OrthoMask.PAINTED)), 0)) / total
    accuracy = content.get("accuracy")
    accuracy = accuracy if isinstance(accuracy, dict) else {}
    median = accuracy.get("expected_mm_median")
    reason = f"{painted:.0%} painted"
    if painted < _LEAST_PAINTED_SHARE:
        recommended, reason = False, f"only {reason}"
    elif is_of_photos and not accuracy.get("assessed"):
        recommended, reason = False, f"{reason}, accuracy not checked: no tie lies on this wall"
    else:
        recommended = True
        if isinstance(median, float) and math.isfinite(median):
            reason += f", expected error {median:.1f} mm"
    size_m2 = float(str(content.get("gsd_m", 0.0))) ** 2 * total
    return {
        "number": number,
        "name": str(content.get("name", f"wall {number}")),
        "kind": _kind(str(content.get("name", "wall"))),
        "recommended": recommended,
        "reason": reason,
        "area_m2": round(size_m2, 3),
        "painted_share": round(painted, 4),
        "expected_mm_median": median if isinstance(median, float) else None,
        "n_check_points": accuracy.get("n_check_points", 0),
        "orthoimage": image,
    }


def _included(
    products: Path, cells: Sequence[RecordedCell], images: Mapping[int, object]
) -> Iterator[dict[str, JsonValue]]:
    """Surfaces that a wall of these images shows already."""
    found: dict[int, int] = {}
    for cell in cells:
        for number, _, content in _sidecars(products / cell_file_name(cell.address), _DEPTH):
            included = content.get("includes_walls")
            if number in images and isinstance(included, list):
                found |= {int(other): number for other in included}
    for number, wall in found.items():
        if number not in images:
            yield {
                "number": number,
                "name": f"wall {number}",
                "kind": "wall",
                "recommended": False,
                "reason": f"already included in wall {wall}",
                "area_m2": None,
                "painted_share": None,
                "expected_mm_median": None,
                "n_check_points": 0,
                "orthoimage": None,
            }


def _kind(name: str) -> str:
    """The first word of a wall's name: wall, floor, ceiling, or what its method calls it."""
    return name.split(" ", maxsplit=1)[0] or "wall"


def _rank(wall: Mapping[str, JsonValue]) -> tuple[bool, float, int]:
    """Recommended ones first, of these the largest painted area."""
    area, share = wall["area_m2"], wall["painted_share"]
    painted = area * share if isinstance(area, float) and isinstance(share, float) else 0.0
    return not wall["recommended"], -painted, int(str(wall["number"]))


PRODUCTS_FOLDER: Final = "products"
METRICS_FILE: Final = "metrics.csv"


def publish_products(
    run_folder: Path,
    cells: Iterable[RecordedCell],
    files_of: Mapping[str, Mapping[str, Mapping[Path, str]]],
) -> tuple[PublishedFile, ...]:
    """Fill `products/` of a run folder; an older one, left by an interrupted run, is replaced.

    Args:
        run_folder: existing folder.
        cells: all cells of the run.
        files_of: address -> output port -> files in the store, and the SHA-256 that each must have.

    Returns:
        What is there now, sorted by path.

    Raises:
        StoreError: a file cannot be copied, e.g. because the disk is full, or is not what it must
            be.
    """
    target = run_folder / PRODUCTS_FOLDER
    cells = tuple(cells)
    expected: dict[Path, str] = {}
    with writing_to(target):
        if target.is_symlink():
            target.unlink()
        # What cannot be removed would be published as part of this run.
        with suppress(FileNotFoundError):
            shutil.rmtree(target)
        target.mkdir(parents=True, exist_ok=True)
        replaced = _replaced(cells)
        for cell in cells:
            if cell.status == "ok":
                folder = path_below(target, cell_file_name(cell.address))
                ports = files_of.get(cell.address, {})
                current = {
                    port: files
                    for port, files in ports.items()
                    if f"{cell.address}.{port}" not in replaced
                }
                expected |= _publish_cell(folder, cell, current)
        write_walls_json(target, cells)
        rows = [row for cell in cells for row in cell_metrics(cell)]
        write_metrics_csv(target / METRICS_FILE, rows)
        published = _digested(run_folder, target)
    for file in published:
        wanted = expected.get(run_folder / file.path, file.sha256)
        if file.sha256 != wanted:
            raise StoreError(f"{file.path} must have the digest {wanted}, got {file.sha256}")
    return published


def _digested(run_folder: Path, target: Path) -> tuple[PublishedFile, ...]:
    paths = sorted(path for path in target.rglob("*") if path.is_file())
    digests = list(in_order(file_sha256, paths))
    return tuple(
        PublishedFile(
            path=path.relative_to(run_folder).as_posix(),
            size_bytes=path.stat().st_size,
            sha256=digest,
        )
        for path, digest in zip(paths, digests, strict=True)
    )


def _replaced(cells: Iterable[RecordedCell]) -> set[str]:
    """Outputs, `address.port`, that a later cell takes and gives another of the same type for.

    Beside its successor, as planes whose sides are found anew, the first would contradict it. What
    was read from files stays.
    """
    made = {
        cell.address
        for cell in cells
        if any(not given.source.startswith("inputs.") for given in cell.inputs.values())
    }
    return {
        given.source
        for cell in cells
        if cell.status == "ok"
        for given in cell.inputs.values()
        for output in cell.outputs.values()
        if output.type_name == given.type_name
        and output.digest != given.digest
        and given.source.rpartition(".")[0] in made
    }


def _publish_cell(
    folder: Path, cell: RecordedCell, files_of: Mapping[str, Mapping[Path, str]]
) -> dict[Path, str]:
    """Copy the files of a cell, by port; give the SHA-256 that each copy must have."""
    folder.mkdir()
    expected: dict[Path, str] = {}
    taken = [METRICS_FILE]
    for port, files in files_of.items():
        for file, sha256 in files.items():
            # Two outputs of one type publish equal names: the port tells them apart.
            marks = chain(("", f"{port}_"), (f"{port}_{number}_" for number in count(2)))
            names = (f"{mark}{file.name}" for mark in marks)
            name = next(name for name in names if not colliding([*taken, name]))
            taken.append(name)
            # A copy, not a hard link: who edits a product must not change the store.
            copy = path_below(folder, name)
            shutil.copyfile(file, copy)
            expected[copy] = sha256
    write_metrics_csv(folder / METRICS_FILE, cell_metrics(cell))
    return expected


def published_files(run_folder: Path, address: str) -> tuple[Path, ...]:
    """Files of one cell below `products/`, wall 2 before wall 10; empty when there are none.

    Links are left out, whatever they lead to.
    """
    inside = f"{PRODUCTS_FOLDER}/{cell_file_name(address)}"
    names = sorted(files_below(run_folder, inside), key=_by_number)
    return tuple(path_below(run_folder, f"{inside}/{name}") for name in names)


def _by_number(name: str) -> tuple[tuple[str, int], ...]:
    """Sort key that takes numbers in a name as numbers."""
    return tuple((text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", name))
