"""Rasters of a record that travels alone, made anew of the products that it holds."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

from orthoflow.engine.file_digests import file_sha256
from orthoflow.engine.store import publish_into
from orthoflow.products import Orthoimages, Walls
from orthoflow.records.published import publish_products
from orthoflow.records.runs import Run

_TYPES: Final = frozenset((Orthoimages.type_name, Walls.type_name))


@contextmanager
def with_files(run: Run, tell: Callable[[str], None] = lambda _: None) -> Iterator[Run]:
    """Give a run that has the rasters that it published.

    Those beside the record are taken. Where none of its files is there, they are made of the walls
    and orthoimages that the record holds, in a folder that lasts as long as the block.

    Args:
        run: the run.
        tell: takes a sentence, where files are made.

    Raises:
        RecordError: the record is damaged.
        StoreError: the disk refuses.
    """
    published = run.record.published
    if not published or any((run.folder / file.path).exists() for file in published):
        yield run
        return
    with tempfile.TemporaryDirectory(prefix="orthoflow-") as name, run.held_open() as opened:
        scratch = Path(name)
        if not (files_of := _published(opened, scratch / "made")):
            yield run
            return
        folder = scratch / "run"
        folder.mkdir()
        made = publish_products(folder, run.record.cells, files_of)
        tell(
            f"{run.path} lies alone: its rasters are made anew of the products in it, and "
            "other files that were published are left out"
        )
        record = replace(run.record, published=made)
        yield replace(opened, record=record, files_folder=folder)


def _published(run: Run, folder: Path) -> dict[str, dict[str, dict[Path, str]]]:
    """Let the products of a record publish their files: address -> port -> file -> SHA-256."""
    from orthoflow.catalog.discovery import discover_catalog  # noqa: PLC0415 - loads plugins

    catalog = discover_catalog()
    found: dict[str, dict[str, dict[Path, str]]] = {}
    for address, cell in run.cells.items():
        for port, output in cell.outputs.items():
            if output.type_name not in _TYPES or not output.embedded:
                continue
            publish = catalog.publisher(output.type_name)
            if publish is None:
                continue
            own = folder / str(len(found)) / port
            publish_into(own, run.product(address, port), publish, output.digest)
            files = sorted(path for path in own.rglob("*") if path.is_file())
            found.setdefault(address, {})[port] = {path: file_sha256(path) for path in files}
    return found
