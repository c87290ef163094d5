"""Records changed as an enemy would, with what hangs on the change, keys and seal made to fit."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from orthoflow_provenance import record as module
from orthoflow_provenance.document import (
    RecordFormatError,
    canonical_json,
    from_json,
    sha256_text,
)
from orthoflow_provenance.hdf5 import fixed_text, write_array

from orthoflow.engine.file_digests import file_sha256

PNG = b"\x89PNG\r\n\x1a\n picture"


@dataclass
class Record:
    """The document of a record, to be changed, and the bytes that it names by digest."""

    document: Any
    files: dict[str, bytes] = field(default_factory=dict)

    def cell(self, address: str) -> Any:
        return next(cell for cell in self.document["cells"] if cell["address"] == address)

    def add_figure(self, address: str, name: str, media_type: str = "image/png") -> None:
        sha256 = hashlib.sha256(PNG).hexdigest()
        self.files[sha256] = PNG
        figure = {"name": name, "caption": "a caption", "media_type": media_type, "data": sha256}
        self.cell(address)["figures"].append(figure)

    def rewrite_preimage(self, address: str, **facts: object) -> None:
        """Let the preimage of a cell's key state other facts, and make the key anew."""
        preimage = {**json.loads(self.cell(address)["key_preimage"]), **facts}
        self.exchange_preimage(address, canonical_json(preimage))

    def exchange_preimage(self, address: str, text: str) -> None:
        """Give a cell any text as the preimage of its key, and the key that follows from it."""
        self.cell(address).update(key_preimage=text, key=sha256_text(text))

    def name_published(self, *paths: str) -> None:
        """Name other files as published."""
        self.document["published"] = [
            {"path": path, "size_bytes": 0, "sha256": "0" * 64} for path in paths
        ]


def changed(run: Path, copy: Path, change: Callable[[Record], object]) -> Path:
    """Copy a run folder, change its record, and seal that again."""
    shutil.copytree(run, copy, symlinks=True)
    reseal(copy / "run.h5", change)
    return copy


def reseal(path: Path, change: Callable[[Record], object]) -> None:
    """Change a record and seal it again, as if it had been written so."""
    with h5py.File(path, "r+") as file:
        record = Record(json.loads(file["document"][()]))
        change(record)
        text = json.dumps(record.document, indent=1)
        for sha256, data in record.files.items():
            if sha256 not in file["files"]:
                write_array(file["files"], sha256, np.frombuffer(data, np.uint8))
        rewrite(file, text)


def rewrite(file: h5py.File, text: str) -> None:
    """Give a record another document, with what repeats it where it can be, and a new seal."""
    try:
        read = from_json(text, lambda sha256: file[f"files/{sha256}"][()].tobytes())
        nodes = module.expected_nodes(read, text)
        for name in set(file) - {"products", "files"}:
            del file[name]
        for name in list(file.attrs):
            del file.attrs[name]
        for name, node in nodes.items():
            module.write_node(file, name, node)
    except (RecordFormatError, ValueError, KeyError, TypeError, RecursionError):
        # A document that no writer would write: nothing can repeat it.
        for name in {"document", "seal"} & set(file):
            del file[name]
        write_array(file, "document", fixed_text(text))
        file.attrs["content_sha256"] = fixed_text(sha256_text(text))
    seal(file)


def seal(file: h5py.File) -> None:
    """Seal a record as it is, and close it."""
    if "seal" in file:
        del file["seal"]
    offset = write_array(file, "seal", fixed_text("0" * 64)).id.get_offset()
    path = Path(file.filename)
    file.close()
    module.seal_file(path, offset)


def publish_again(run: Path) -> None:
    """Let the record of a run name the published files as they are now."""

    def name(record: Record) -> None:
        for file in record.document["published"]:
            path = run / file["path"]
            file.update(size_bytes=path.stat().st_size, sha256=file_sha256(path))

    reseal(run / "run.h5", name)
