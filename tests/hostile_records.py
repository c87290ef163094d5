"""Records changed as an enemy would, with their seals and keys made again to fit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from orthoflow_provenance.digests import canonical_json, sha256_text
from orthoflow_provenance.encoding import (
    read_table,
    read_text,
    set_attributes,
    write_table,
    write_text,
)
from orthoflow_provenance.layout import PUBLISHED
from orthoflow_provenance.seal import SEAL_ATTRIBUTE, SEAL_DATASET, seal_file

from orthoflow.engine.file_digests import file_sha256

PNG = b"\x89PNG\r\n\x1a\n picture"
FILES = (("name", str), ("size_bytes", int), ("sha256", str))
PATHS = (("path", str), ("size_bytes", int), ("sha256", str))


def changed(run: Path, copy: Path, change: Callable[[h5py.File], object]) -> Path:
    """Copy a run folder, change its record, and seal that again."""
    shutil.copytree(run, copy, symlinks=True)
    path = copy / "run.h5"
    reseal(path, change)
    return copy


def reseal(path: Path, change: Callable[[h5py.File], object]) -> None:
    """Change a record and seal it again, as if it had been written so."""
    with h5py.File(path, "r+") as file:
        change(file)
        if SEAL_DATASET in file:
            del file[SEAL_DATASET]
        if SEAL_ATTRIBUTE in file.attrs:
            del file.attrs[SEAL_ATTRIBUTE]
        seal_file(file)


def add_figure(cell: h5py.Group, name: str, media_type: str = "image/png") -> None:
    figures = cell["figures"]
    figure = figures.create_dataset(f"{len(figures):04}", data=np.frombuffer(PNG, np.uint8))
    set_attributes(figure, {"name": name, "caption": "a caption", "media_type": media_type})


def set_text(group: h5py.Group, name: str, text: str) -> None:
    del group[name]
    write_text(group, name, text)


def set_attribute(group: h5py.Group, name: str, value: str | float) -> None:
    del group.attrs[name]
    set_attributes(group, {name: value})


def rename_files(file: h5py.File, entry: str, name: str) -> None:
    """Give the files of an input another name, everywhere a digest hangs on it."""
    group = file[f"inputs/{entry}"]
    rows = [(name, *row[1:]) for row in read_table(group, "files", FILES)]
    del group["files"]
    write_table(group, "files", FILES, rows)
    described = [dict(zip(("name", "size_bytes", "sha256"), row, strict=True)) for row in rows]
    digest = sha256_text(
        canonical_json({"files": described, "v": 1, "what": "orthoflow/files"})  # type: ignore[dict-item]
    )
    for cell in file["cells"].values():
        for port in cell["in"].values():
            if port.attrs["source"].decode() == f"inputs.{entry}":
                exchange_digest(cell, port, f"sha256:{digest}")


def exchange_digest(cell: h5py.Group, port: h5py.Group, digest: str) -> None:
    """Give an input of a cell another digest, and the cell the key that follows from it."""
    name = port.name.rpartition("/")[2]
    set_attribute(port, "digest", digest)
    inputs = json.loads(read_text(cell, "key_preimage"))["inputs"]
    rewrite_preimage(cell, inputs={**inputs, name: f"files@0:{digest}"})


def rewrite_preimage(cell: h5py.Group, **facts: object) -> None:
    """Let the preimage of a cell's key state other facts, and make the key anew."""
    preimage = {**json.loads(read_text(cell, "key_preimage")), **facts}
    exchange_preimage(cell, canonical_json(preimage))  # type: ignore[arg-type]


def exchange_preimage(cell: h5py.Group, text: str) -> None:
    """Give a cell any text as the preimage of its key, and the key that follows from it."""
    set_text(cell, "key_preimage", text)
    set_attribute(cell, "key", sha256_text(text))


def name_published(file: h5py.File, *paths: str) -> None:
    """Let a record name other files as published."""
    rows = [(path, 0, "0" * 64) for path in paths]
    del file[PUBLISHED]
    write_table(file, PUBLISHED, PATHS, rows)


def publish_again(run: Path) -> None:
    """Let the record of a run name the published files as they are now."""

    def name(file: h5py.File) -> None:
        rows = [
            (path, (run / path).stat().st_size, file_sha256(run / path))
            for path, _, _ in read_table(file, PUBLISHED, PATHS)
        ]
        del file[PUBLISHED]
        write_table(file, PUBLISHED, PATHS, rows)

    reseal(run / "run.h5", name)
