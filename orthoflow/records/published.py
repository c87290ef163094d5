"""The folder `products/`, and metrics as rows."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Iterable, Mapping
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
from orthoflow.errors import StoreError
from orthoflow.files.geotiff import name_run
from orthoflow.geometry.threads import in_order
from orthoflow.records.deliverables import write_walls_json
from orthoflow.untrusted_text import csv_text

# As for fractions in the metadata of products (SPEC 11.3): libraries round their last digits.
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
        metric: name, ending in its unit if it has one.
        value: finite number.
        unit: `mm`, `px`, `s`, ...; `1` for counts and shares.
        label: label declared by its method; empty without one.
        better: which values are better, `lower`, `higher` or `one`; empty where none are.
        description: further explanation.
        headline: it is one of the numbers that state how good a result is.
        counted_by: metric of the same step with the number of items it summarises.
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
        """Its label; its name if its method declares none."""
        return self.label or self.metric

    @property
    def titled(self) -> str:
        """Its title with the unit; counts, shares and yes/no have none."""
        return self.title if self.unit in _UNITLESS else f"{self.title} / {self.unit}"


def cell_metrics(cell: RecordedCell) -> tuple[MetricRow, ...]:
    """Return what the method reported and then what the engine measured (time and memory).

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
    """Whether two values of a metric are equal or differ by rounding only.

    That is by a millionth of the larger one, or by a millionth if it is below 1; counts are never
    rounded.

    >>> is_rounding(0.84536087, 0.84536104), is_rounding(1.0, 1.00001), is_rounding(3e7, 3e7 + 1)
    (True, False, False)
    """
    is_counted = all(float(value).is_integer() for value in (left, right))
    return left == right or (
        not is_counted and math.isclose(left, right, rel_tol=_ROUNDING, abs_tol=_ROUNDING)
    )


def write_metrics_csv(path: Path, rows: Iterable[MetricRow]) -> None:
    """Write rows with a header; numbers with all digits."""
    text = csv_text([_COLUMNS, *([getattr(row, name) for name in _COLUMNS] for row in rows)])
    path.write_text(text, encoding="utf-8", newline="")


PRODUCTS_FOLDER: Final = "products"
METRICS_FILE: Final = "metrics.csv"


def publish_products(
    run_folder: Path,
    cells: Iterable[RecordedCell],
    files_of: Mapping[str, Mapping[str, Mapping[Path, str]]],
    run_id: str,
) -> tuple[PublishedFile, ...]:
    """Fill `products/` of a run folder; an older one of an interrupted run is replaced.

    Args:
        run_folder: existing folder.
        cells: all cells of the run.
        files_of: address -> output port -> files in the store, and the required SHA-256 of each.
        run_id: is inserted into the names of the coordinate systems of walls.

    Returns:
        The present files, sorted by path.

    Raises:
        StoreError: a file cannot be copied, e.g. because the disk is full, or differs from its
            digest.
    """
    target = run_folder / PRODUCTS_FOLDER
    cells = tuple(cells)
    with writing_to(target):
        if target.is_symlink():
            target.unlink()
        # A file that cannot be removed would be published as part of this run.
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
                _publish_cell(folder, cell, current, run_id)
        write_walls_json(target, cells)
        rows = [row for cell in cells for row in cell_metrics(cell)]
        write_metrics_csv(target / METRICS_FILE, rows)
        return _digested(run_folder, target)


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
    """Return outputs, `address.port`, that a later cell replaces by one of the same type.

    Beside its successor, e.g. planes whose sides were found later, the first would contradict it.
    Products read from files stay.
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
    folder: Path,
    cell: RecordedCell,
    files_of: Mapping[str, Mapping[Path, str]],
    run_id: str,
) -> None:
    """Copy the files of a cell, by port, and insert the run's name."""
    folder.mkdir()
    taken = [METRICS_FILE]
    for port, files in files_of.items():
        for file, sha256 in files.items():
            # Two outputs of one type publish equal names: the port tells them apart.
            marks = chain(("", f"{port}_"), (f"{port}_{number}_" for number in count(2)))
            names = (f"{mark}{file.name}" for mark in marks)
            name = next(name for name in names if not colliding([*taken, name]))
            taken.append(name)
            # A copy, not a hard link: editing a product must not change the store.
            copy = path_below(folder, name)
            shutil.copyfile(file, copy)
            if (found := file_sha256(copy)) != sha256:
                raise StoreError(f"{copy} must have the digest {sha256}, got {found}")
            name_run(copy, run_id)
    write_metrics_csv(folder / METRICS_FILE, cell_metrics(cell))


def published_files(run_folder: Path, address: str) -> tuple[Path, ...]:
    """Return files of one cell below `products/`, wall 2 before wall 10; empty without any.

    Links are ignored, whatever their target.
    """
    inside = f"{PRODUCTS_FOLDER}/{cell_file_name(address)}"
    names = sorted(files_below(run_folder, inside), key=_by_number)
    return tuple(path_below(run_folder, f"{inside}/{name}") for name in names)


def _by_number(name: str) -> tuple[tuple[str, int], ...]:
    """Return a sort key that treats numbers in a name as numbers."""
    return tuple((text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", name))
