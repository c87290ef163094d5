"""One product as one HDF5 group, the same in the store and in the record."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import h5py
import numpy as np
from numpy.typing import NDArray

from orthoflow_provenance.blocks import block_indices, little_endian
from orthoflow_provenance.digests import canonical_json, check_storable, payload_digest
from orthoflow_provenance.encoding import (
    check_name,
    int_attribute,
    read_json,
    reading,
    set_attributes,
    text_attribute,
    write_text,
)
from orthoflow_provenance.errors import RecordFormatError
from orthoflow_provenance.model import (
    PRODUCT_FORMAT,
    PRODUCT_FORMAT_VERSION,
    JsonValue,
    PayloadLike,
)
from orthoflow_provenance.safe import check_format, safe_open
from orthoflow_provenance.sinks import create_file, create_group

PRODUCT_GROUP: Final = "product"

_CHUNK_BYTES: Final = 1 << 20
# Smaller arrays gain nothing from compression or mapping.
_SMALL_BYTES: Final = 4096


@dataclass(frozen=True, kw_only=True)
class StoredPayload:
    """A product as it was read; fulfils `PayloadLike`.

    Attributes:
        type_name: name of the product type.
        encoding_version: version of the type's layout.
        metadata: JSON; holds everything that is not an array.
        arrays: name -> array, read-only; mapped ones are views of a `numpy.memmap`.
        mapped: stored contiguous and uncompressed.
        digest: digest that was stored with the product; `payload_digest` says whether it is true.
    """

    type_name: str
    encoding_version: int
    metadata: Mapping[str, JsonValue]
    arrays: Mapping[str, NDArray[np.generic]]
    mapped: bool
    digest: str


def write_product_file(path: Path, payload: PayloadLike) -> str:
    """Write one product into a file of its own and bring it to the disk.

    The digest is computed in other threads while the arrays are written. Nothing is copied except
    arrays that are not contiguous, block by block.

    Returns:
        The product's digest.

    Raises:
        RecordFormatError: the payload has names or types that the format does not know.
        OSError: the file cannot be written, e.g. because the disk is full; it is removed.
    """
    _check_payload(payload)
    with ThreadPoolExecutor(max_workers=1) as thread:
        digest = thread.submit(payload_digest, payload)
        with create_file(path) as file:
            set_attributes(
                file, {"format": PRODUCT_FORMAT, "format_version": PRODUCT_FORMAT_VERSION}
            )
            group = create_group(file, PRODUCT_GROUP)
            _write_content(group, payload)
            set_attributes(group, {"digest": digest.result()})
    return digest.result()


def read_product_file(path: Path, *, map_arrays: bool = True) -> StoredPayload:
    """Read what `write_product_file` wrote.

    Args:
        path: the file; it must stay in place while mapped arrays are in use.
        map_arrays: memory-map the arrays of mapped products instead of loading them.

    Raises:
        RecordFormatError: the file is damaged, of another format or a newer one.
        OSError: the file cannot be opened.
    """
    with safe_open(path) as file:
        check_format(file, PRODUCT_FORMAT, PRODUCT_FORMAT_VERSION)
        return read_payload(open_group(file, PRODUCT_GROUP), map_arrays=map_arrays)


def read_product_metadata(path: Path) -> Mapping[str, JsonValue]:
    """Read what `write_product_file` wrote, without the arrays.

    Raises:
        RecordFormatError: the file is damaged, of another format or a newer one.
        OSError: the file cannot be opened.
    """
    with safe_open(path) as file:
        check_format(file, PRODUCT_FORMAT, PRODUCT_FORMAT_VERSION)
        return read_json(open_group(file, PRODUCT_GROUP), "metadata")


def read_payload(group: h5py.Group, *, map_arrays: bool) -> StoredPayload:
    """Read a product from its group in a file that `safe_open` opened.

    Raises:
        RecordFormatError: the group is damaged or incomplete.
    """
    arrays: dict[str, NDArray[np.generic]] = {}
    for name, dataset in array_datasets(group):
        with reading(dataset.name):
            arrays[name] = _read_array(dataset, is_mapping=map_arrays)
    return StoredPayload(
        type_name=text_attribute(group, "type"),
        encoding_version=int_attribute(group, "encoding_version"),
        metadata=read_json(group, "metadata"),
        arrays=arrays,
        mapped=bool(int_attribute(group, "mapped")),
        digest=text_attribute(group, "digest"),
    )


def array_datasets(group: h5py.Group) -> Iterator[tuple[str, h5py.Dataset]]:
    """Give a product's arrays with their names, sorted, without reading them.

    Raises:
        RecordFormatError: the group is damaged.
    """
    yield from _datasets_below(open_group(group, "arrays"), "")


def open_group(parent: h5py.Group, name: str) -> h5py.Group:
    """Open a sub-group.

    Raises:
        RecordFormatError: there is none of that name.
    """
    with reading(f"{parent.name.rstrip('/')}/{name}"):
        found = parent.get(name)
    if not isinstance(found, h5py.Group):
        raise RecordFormatError(f"{parent.name} lacks the group {name}")
    return found


def _check_payload(payload: PayloadLike) -> None:
    check_name(payload.type_name, "the product type")
    names = sorted(payload.arrays)
    for name in names:
        for part in name.split("/"):
            check_name(part, "the array")
        check_storable(payload.arrays[name].dtype)
    for name in names:
        parents = name.split("/")
        for depth in range(1, len(parents)):
            if "/".join(parents[:depth]) in payload.arrays:
                raise RecordFormatError(
                    f"the array {name} cannot lie below {'/'.join(parents[:depth])}, which is an "
                    "array itself"
                )


def _write_content(group: h5py.Group, payload: PayloadLike) -> None:
    """Write all but the digest."""
    set_attributes(
        group,
        {
            "type": payload.type_name,
            "encoding_version": payload.encoding_version,
            "mapped": int(payload.mapped),
        },
    )
    write_text(group, "metadata", canonical_json(payload.metadata))
    root = create_group(group, "arrays")
    for name in sorted(payload.arrays):
        parent = root
        *folders, last = name.split("/")
        for folder in folders:
            parent = parent[folder] if folder in parent else create_group(parent, folder)
        _write_array(parent, last, payload.arrays[name], is_mapped=payload.mapped)


def _write_array(
    group: h5py.Group, name: str, array: NDArray[np.generic], *, is_mapped: bool
) -> None:
    dtype = little_endian(array.dtype)
    if is_mapped or array.nbytes < _SMALL_BYTES or array.ndim == 0:
        dataset = _create_contiguous(group, name, array.shape, dtype)
    else:
        dataset = group.create_dataset(
            name,
            shape=array.shape,
            dtype=dtype,
            chunks=_chunk_shape(array.shape, dtype.itemsize),
            compression="gzip",
            compression_opts=1,
            shuffle=True,
            fletcher32=True,
            track_times=False,
        )
    if array.size == 0:
        return
    if array.flags.c_contiguous:
        dataset.write_direct(np.asarray(array))
        return
    for index in block_indices(array.shape, dtype.itemsize):
        dataset[index] = array[index]


def _create_contiguous(
    group: h5py.Group, name: str, shape: tuple[int, ...], dtype: np.dtype[np.generic]
) -> h5py.Dataset:
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_layout(h5py.h5d.CONTIGUOUS)
    properties.set_obj_track_times(False)
    # Early: the offset exists as soon as the dataset does. Never: no pass of zeros before the data.
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    properties.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    space = h5py.h5s.create_simple(shape) if shape else h5py.h5s.create(h5py.h5s.SCALAR)
    kind = h5py.h5t.py_create(dtype, logical=True)
    return h5py.Dataset(
        h5py.h5d.create(group.id, name.encode("utf-8"), kind, space, dcpl=properties)
    )


def _chunk_shape(shape: tuple[int, ...], itemsize: int) -> tuple[int, ...]:
    """Cut along the first axis first: chunks are runs of whole rows of about a megabyte."""
    chunk = list(shape)
    for axis in range(len(chunk)):
        others = itemsize * math.prod(chunk) // chunk[axis]
        chunk[axis] = min(chunk[axis], max(1, _CHUNK_BYTES // others))
    return tuple(chunk)


def _read_array(dataset: h5py.Dataset, *, is_mapping: bool) -> NDArray[np.generic]:
    offset = dataset.id.get_offset()
    is_mappable = (
        is_mapping
        and offset is not None
        and dataset.nbytes >= _SMALL_BYTES
        and dataset.dtype.isnative
        # Misaligned arrays, which other writers may leave, are slower than a copy.
        and offset % dataset.dtype.itemsize == 0
    )
    if is_mappable:
        path = Path(dataset.file.filename)
        if offset + dataset.nbytes > path.stat().st_size:
            raise RecordFormatError(f"{dataset.name} reaches beyond the end of {path.name}")
        mapped = np.memmap(path, dtype=dataset.dtype, mode="r", offset=offset, shape=dataset.shape)
        return mapped.view(np.ndarray)
    array: NDArray[np.generic] = np.empty(dataset.shape, dtype=dataset.dtype)
    if array.size:
        dataset.read_direct(array)
    array.flags.writeable = False
    return array


def _datasets_below(group: h5py.Group, prefix: str) -> Iterator[tuple[str, h5py.Dataset]]:
    with reading(group.name):
        children = [(name, group[name]) for name in sorted(group)]
    for name, child in children:
        if isinstance(child, h5py.Dataset):
            yield prefix + name, child
        elif isinstance(child, h5py.Group):
            yield from _datasets_below(child, f"{prefix}{name}/")
