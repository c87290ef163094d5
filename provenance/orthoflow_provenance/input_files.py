"""Input files inside a record: put in as they are, and taken out again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, Final, TypeAlias

import h5py
import numpy as np

from orthoflow_provenance import layout
from orthoflow_provenance.encoding import dataset_of, reading
from orthoflow_provenance.errors import InputFileError, RecordFormatError
from orthoflow_provenance.inner_files import create_below, path_below
from orthoflow_provenance.model import RecordedFile, RecordedInput
from orthoflow_provenance.payloads import open_group
from orthoflow_provenance.safe import safe_open
from orthoflow_provenance.sinks import create_group

InputFile: TypeAlias = Callable[[str], Path | None]
_BLOCK_BYTES: Final = 16 << 20


def embed_files(group: h5py.Group, entry: RecordedInput, input_file: InputFile) -> None:
    """Copy the files of an input into its group, block by block.

    Args:
        group: of the input.
        entry: the input.
        input_file: SHA-256 -> a file with it, None when there is none.

    Raises:
        InputFileError: a file is not at hand, or is not the one that the entry describes.
        OSError: a file cannot be read.
    """
    contents = create_group(group, layout.INPUT_CONTENTS)
    for index, file in enumerate(entry.files):
        path = input_file(file.sha256)
        if path is None:
            raise InputFileError(
                f"the file {file.name} of the input {entry.name} is to be embedded, but there is "
                f"none with its SHA-256 {file.sha256[:12]}..."
            )
        _embed_file(contents, content_name(index), path, file)


def _embed_file(contents: h5py.Group, name: str, path: Path, file: RecordedFile) -> None:
    # Neither chunked nor packed: photos and scans are packed already, and digests guard the bytes.
    dataset = contents.create_dataset(name, shape=(file.size_bytes,), dtype=np.uint8)
    digest = hashlib.sha256()
    n_bytes = 0
    if not path.is_file():
        # A pipe in its place would be waited for.
        raise _is_another(path, file)
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK_BYTES):
            if n_bytes + len(block) > file.size_bytes:
                raise _is_another(path, file)
            dataset[n_bytes : n_bytes + len(block)] = np.frombuffer(block, dtype=np.uint8)
            digest.update(block)
            n_bytes += len(block)
    if n_bytes != file.size_bytes or digest.hexdigest() != file.sha256:
        raise _is_another(path, file)


def _is_another(path: Path, file: RecordedFile) -> InputFileError:
    return InputFileError(
        f"the input file {path.name} must have {file.size_bytes} bytes with the SHA-256 "
        f"{file.sha256[:12]}..., but it was changed since it was digested"
    )


def content_name(index: int) -> str:
    """Name of the dataset with the bytes of the file of that row.

    >>> content_name(7)
    '0007'
    """
    return f"{index:04}"


def has_contents(group: h5py.Group) -> bool:
    """Say whether the group of an input holds the bytes of its files."""
    with reading(group.name):
        return layout.INPUT_CONTENTS in group


def extract_files(
    path: Path, inputs: tuple[RecordedInput, ...], folder: Path
) -> Mapping[str, tuple[Path, ...]]:
    """Write the embedded input files of a record into a folder, under their names.

    Args:
        path: the record.
        inputs: of the record.
        folder: made when missing; each file gets a folder of its own, as names may come twice.

    Returns:
        Input -> files, in the order of the record; inputs that are not embedded are left out.

    Raises:
        RecordFormatError: a file is damaged, is not the one that the record describes, or has a
            name that cannot be that of a file.
        OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with safe_open(path) as opened:
        return {
            entry.name: tuple(_extracted(opened, entry, folder))
            for entry in inputs
            if entry.embedded
        }


def _extracted(opened: h5py.File, entry: RecordedInput, folder: Path) -> Iterator[Path]:
    contents = open_group(opened, f"{layout.INPUTS}/{entry.name}/{layout.INPUT_CONTENTS}")
    for index, file in enumerate(entry.files):
        name = content_name(index)
        dataset = dataset_of(contents, name)
        # Before anything is written: the record says how much room it takes.
        if dataset.dtype != np.uint8 or dataset.shape != (file.size_bytes,):
            raise RecordFormatError(
                f"{dataset.name} must be the {file.size_bytes} bytes of {file.name!r}, got "
                f"{dataset.dtype} {dataset.shape}"
            )
        inside = f"{entry.name}/{name}/{file.name}"
        with create_below(folder, inside) as stream:
            _extract(dataset, file, stream)
        yield path_below(folder, inside)


def _extract(dataset: h5py.Dataset, file: RecordedFile, stream: BinaryIO) -> None:
    digest = hashlib.sha256()
    for start in range(0, dataset.size, _BLOCK_BYTES):
        with reading(dataset.name):
            block = dataset[start : start + _BLOCK_BYTES].tobytes()
        digest.update(block)
        stream.write(block)
    if digest.hexdigest() != file.sha256:
        raise RecordFormatError(
            f"{dataset.name} has the SHA-256 {digest.hexdigest()}, the record says {file.sha256} "
            f"of {file.name!r}"
        )
