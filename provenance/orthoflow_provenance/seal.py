"""The seal: a digest per object and one over all of them, whatever HDF5 wrote the file."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

import h5py
import numpy as np
from numpy.typing import NDArray

from orthoflow_provenance.blocks import block_indices, byte_blocks, little_endian
from orthoflow_provenance.digests import (
    ArrayFingerprint,
    canonical_json,
    sha256_text,
)
from orthoflow_provenance.encoding import read_text, reading, set_attributes, write_text
from orthoflow_provenance.errors import RecordFormatError
from orthoflow_provenance.model import JsonValue

SEAL_DATASET: Final = "seal"
SEAL_ATTRIBUTE: Final = "content_sha256"
NOTES_GROUP: Final = "notes"


@dataclass(frozen=True, kw_only=True)
class ContentDigests:
    """Digests of everything under the seal.

    Attributes:
        objects: path -> digest of the object with its attributes.
        arrays: path -> fingerprint, for datasets that are arrays of numbers.
        unreadable: path -> why it could not be digested.
        left_out: paths of datasets larger than was asked for.
    """

    objects: Mapping[str, str] = field(default_factory=dict)
    arrays: Mapping[str, ArrayFingerprint] = field(default_factory=dict)
    unreadable: Mapping[str, str] = field(default_factory=dict)
    left_out: frozenset[str] = frozenset()


def seal_file(file: h5py.File) -> str:
    """Write the seal into a finished file.

    Returns:
        The content digest, 64 hexadecimal digits.

    Raises:
        RecordFormatError: what was just written cannot be read back.
    """
    contents = digest_contents(file)
    for place, problem in contents.unreadable.items():
        raise RecordFormatError(f"{place} was written but cannot be read back: {problem}")
    text = seal_text(contents.objects)
    write_text(file, SEAL_DATASET, text)
    content_sha256 = sha256_text(text)
    set_attributes(file, {SEAL_ATTRIBUTE: content_sha256})
    return content_sha256


def seal_text(objects: Mapping[str, str]) -> str:
    """Write digests one per line, `<digest>  <path>`, sorted by path."""
    return "".join(f"{objects[path]}  {path}\n" for path in sorted(objects))


def read_seal(file: h5py.File) -> dict[str, str]:
    """Read the seal's digests by path.

    Raises:
        RecordFormatError: the seal is missing or is not a list of digests.
    """
    sealed: dict[str, str] = {}
    for line in read_text(file, SEAL_DATASET).split("\n")[:-1]:
        digest, separator, path = line.partition("  ")
        if len(digest) != 64 or not separator or path in sealed:
            raise RecordFormatError(f"/{SEAL_DATASET} must list digests and paths, got {line!r}")
        sealed[path] = digest
    return sealed


def digest_contents(file: h5py.File, *, largest_bytes: float = math.inf) -> ContentDigests:
    """Digest every group and dataset of a file that `safe_open` opened, except the notes.

    Damaged places end up in `unreadable`; nothing is raised for them.

    Args:
        file: the record.
        largest_bytes: larger datasets are left out.
    """
    objects: dict[str, str] = {}
    arrays: dict[str, ArrayFingerprint] = {}
    unreadable: dict[str, str] = {}
    left_out: set[str] = set()
    for path, item in _objects(file, unreadable):
        try:
            with reading(path):
                if isinstance(item, h5py.Dataset) and item.nbytes > largest_bytes:
                    left_out.add(path)
                    continue
                data = _fingerprint(item) if isinstance(item, h5py.Dataset) else None
                objects[path] = _object_digest(item, path, data)
        except RecordFormatError as error:
            unreadable[path] = str(error)
            continue
        if data is not None and item.dtype.kind in "biuf":
            arrays[path] = data
    return ContentDigests(
        objects=objects, arrays=arrays, unreadable=unreadable, left_out=frozenset(left_out)
    )


def _objects(
    file: h5py.File, unreadable: dict[str, str]
) -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    pending: list[tuple[str, h5py.Group | h5py.Dataset]] = [("/", file)]
    while pending:
        path, item = pending.pop()
        yield path, item
        if isinstance(item, h5py.Dataset):
            continue
        try:
            with reading(path):
                for name in item:
                    if path == "/" and name in {SEAL_DATASET, NOTES_GROUP}:
                        continue
                    pending.append((f"{path.rstrip('/')}/{name}", item[name]))
        except RecordFormatError as error:
            unreadable[path] = str(error)


def _object_digest(
    item: h5py.Group | h5py.Dataset, path: str, data: ArrayFingerprint | None
) -> str:
    attributes: dict[str, JsonValue] = {
        name: _attribute_digest(item.attrs[name])
        for name in item.attrs
        if (path, name) != ("/", SEAL_ATTRIBUTE)
    }
    content: dict[str, JsonValue] = {"attributes": attributes}
    if data is not None:
        content["data"] = [data.dtype, list(data.shape), data.sha256]
    return sha256_text(canonical_json(content))


def _attribute_digest(value: object) -> JsonValue:
    array = np.asarray(value)
    return [_dtype_code(array.dtype), list(array.shape), _digest_blocks(iter([array]))]


def _fingerprint(dataset: h5py.Dataset) -> ArrayFingerprint:
    shape = tuple(dataset.shape)
    return ArrayFingerprint(
        dtype=_dtype_code(dataset.dtype), shape=shape, sha256=_digest_blocks(_values(dataset))
    )


def _values(dataset: h5py.Dataset) -> Iterator[NDArray[np.generic]]:
    if dataset.dtype.names is not None:
        # Column by column, so that padding between the columns has no say.
        table = dataset[()]
        yield from (np.asarray(table[title]) for title in dataset.dtype.names)
        return
    for index in block_indices(dataset.shape, dataset.dtype.itemsize):
        yield np.asarray(dataset[index], dtype=dataset.dtype)


def _digest_blocks(arrays: Iterator[NDArray[np.generic]]) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        for block in byte_blocks(array):
            digest.update(block.data)
    return digest.hexdigest()


def _dtype_code(dtype: np.dtype[np.generic]) -> str:
    if dtype.names is not None and dtype.fields is not None:
        columns = (f"{name}:{_dtype_code(dtype.fields[name][0])}" for name in dtype.names)
        return "{" + ",".join(columns) + "}"
    if dtype.kind == "S":
        return f"utf8[{dtype.itemsize}]"
    return little_endian(dtype).str
