"""The folder `products/`: files of a run that people open in other programs."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

from orthoflow_provenance.model import PublishedFile, RecordedCell

from orthoflow.engine.durability import writing_to
from orthoflow.engine.file_digests import file_sha256
from orthoflow.engine.run_folder import cell_file_name
from orthoflow.geometry.threads import in_order
from orthoflow.records.metrics import cell_metrics, write_metrics_csv

PRODUCTS_FOLDER: Final = "products"
METRICS_FILE: Final = "metrics.csv"


def publish_products(
    run_folder: Path,
    cells: Iterable[RecordedCell],
    files_of: Mapping[str, Mapping[str, tuple[Path, ...]]],
) -> tuple[PublishedFile, ...]:
    """Fill `products/` of a run folder; an older one, left by an interrupted run, is replaced.

    Args:
        run_folder: existing folder.
        cells: all cells of the run.
        files_of: address -> output port -> files in the store.

    Returns:
        What is there now, sorted by path.

    Raises:
        StoreError: a file cannot be copied, e.g. because the disk is full.
    """
    target = run_folder / PRODUCTS_FOLDER
    cells = tuple(cells)
    with writing_to(target):
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True, exist_ok=True)
        for cell in cells:
            if cell.status == "ok":
                _publish_cell(target / cell_file_name(cell.address), cell, files_of)
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


def _publish_cell(
    folder: Path, cell: RecordedCell, files_of: Mapping[str, Mapping[str, tuple[Path, ...]]]
) -> None:
    folder.mkdir()
    for port, files in files_of.get(cell.address, {}).items():
        for file in files:
            # Two outputs of one type publish equal names: the port tells them apart.
            name = file.name if not (folder / file.name).exists() else f"{port}_{file.name}"
            # A copy, not a hard link: who edits a product must not change the store.
            shutil.copyfile(file, folder / name)
    write_metrics_csv(folder / METRICS_FILE, cell_metrics(cell))


def published_files(run_folder: Path, address: str) -> tuple[Path, ...]:
    """Files of one cell below `products/`, wall 2 before wall 10; empty when there are none."""
    folder = run_folder / PRODUCTS_FOLDER / cell_file_name(address)
    if not folder.is_dir():
        return ()
    files = (path for path in folder.iterdir() if path.is_file())
    return tuple(sorted(files, key=lambda path: _by_number(path.name)))


def _by_number(name: str) -> tuple[tuple[str, int], ...]:
    """Sort key that takes numbers in a name as numbers."""
    return tuple((text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", name))
