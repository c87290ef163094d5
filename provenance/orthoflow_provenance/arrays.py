"""Products as named arrays: digests, HDF5 groups, and differences between products.

The digest of a product does not depend on the way in which the product is stored.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

from orthoflow_provenance.document import (
    DIGEST_PREFIX,
    FORMAT_VERSION,
    PRODUCT_FORMAT,
    JsonValue,
    PayloadLike,
    RecordFormatError,
    canonical_json,
    parse_json,
    sha256_text,
)
from orthoflow_provenance.hdf5 import (
    create_file,
    create_group,
    fixed_text,
    int_attribute,
    open_group,
    read_text,
    reading,
    safe_open,
    set_attributes,
    text_attribute,
    write_array,
)
from orthoflow_provenance.paths import check_name

PRODUCT_GROUP: Final = "product"
_BLOCK_BYTES: Final = 8 << 20
_CHUNK_BYTES: Final = 1 << 20
# Smaller arrays are neither compressed nor memory-mapped, because this would save nothing.
_SMALL_BYTES: Final = 4096
_EXACT: Final = 0.0
_ALONE: Final = "it exists in only one of the products"
# Tolerance for floats in the metadata, whose last digits depend on the versions of numerical
# libraries.
_STATED_SHARE: Final = 1e-6
_UNITS: Final = ("mm", "m", "px", "deg")

Tolerances: TypeAlias = Mapping[str, tuple[float, str]]


@dataclass(frozen=True, kw_only=True)
class StoredPayload:
    """A product read from a file; implements `PayloadLike`.

    Attributes:
        type_name: name of the product type.
        encoding_version: version of the type's encoding.
        metadata: JSON object with everything that is not an array.
        arrays: read-only arrays by name; memory-mapped arrays are views of a `numpy.memmap`.
        mapped: whether arrays are stored contiguously and uncompressed.
        digest: digest stored with the product; compare it with `payload_digest`.
    """

    type_name: str
    encoding_version: int
    metadata: Mapping[str, JsonValue]
    arrays: Mapping[str, NDArray[np.generic]]
    mapped: bool
    digest: str


@dataclass(frozen=True, kw_only=True)
class ArrayDifference:
    """An array or a metadata value that differs between two products.

    Attributes:
        name: name of the array, or path of the metadata value.
        largest: largest absolute difference in `unit`; infinite if values cannot be subtracted,
            because shapes or types differ, a value is missing, or only one of two numbers is NaN.
        limit: largest allowed difference.
        unit: unit of `largest` and `limit`.
        n_values: number of values that differ by more than the limit.
        problem: description of the difference, one sentence.
    """

    name: str
    largest: float
    limit: float
    unit: str
    n_values: int
    problem: str


def payload_digest(payload: PayloadLike) -> str:
    """Return the digest of the type, encoding version, metadata and arrays of a product.

    The digest of an array covers its dtype, shape and bytes. Arrays are hashed in threads;
    memory-mapped arrays are not copied.

    Returns:
        `sha256:`, followed by 64 hexadecimal digits.

    Raises:
        RecordFormatError: the metadata cannot be represented as JSON, or the type of an array is
            not part of the format.
    """

    def fingerprint(name: str) -> list[JsonValue]:
        array = payload.arrays[name]
        check_storable(array.dtype)
        wanted = array.dtype.newbyteorder("<")
        content = np.ascontiguousarray(array, dtype=wanted).reshape(-1).view(np.uint8)
        return [wanted.str, [*array.shape], hashlib.sha256(content.data).hexdigest()]

    # Start with the largest array; otherwise, one thread might still hash it when all others have
    # finished.
    names = sorted(payload.arrays, key=lambda name: -payload.arrays[name].nbytes)
    with ThreadPoolExecutor() as threads:
        fingerprints = dict(zip(names, threads.map(fingerprint, names), strict=True))
    content = {
        "what": "orthoflow/product",
        "v": 1,
        "type": payload.type_name,
        "encoding_version": payload.encoding_version,
        "metadata": payload.metadata,
        "arrays": fingerprints,
    }
    return DIGEST_PREFIX + sha256_text(canonical_json(content))


def check_storable(dtype: np.dtype[np.generic]) -> None:
    """Check that the type of an array is part of the format.

    Raises:
        RecordFormatError: the type is not bool, an integer of up to 8 bytes, or a float of 2, 4 or
            8 bytes.
    """
    is_float = dtype.kind == "f" and dtype.itemsize in (2, 4, 8)
    if not (dtype.kind in "biu" or is_float):
        raise RecordFormatError(
            f"an array of type {dtype} cannot be stored; only bool, integers and floats of 2, 4 "
            "or 8 bytes are supported"
        )


def write_product_file(path: Path, payload: PayloadLike) -> str:
    """Write a product to a separate file, and sync the file to disk.

    The digest is computed in other threads while the arrays are written. Arrays are copied only if
    they are not contiguous.

    Returns:
        The digest of the product.

    Raises:
        RecordFormatError: the product has names or types that are not part of the format.
        OSError: the file cannot be written, for example because the disk is full. In this case, the
            incomplete file is removed.
    """
    _check_payload(payload)
    with ThreadPoolExecutor(max_workers=1) as thread:
        digest = thread.submit(payload_digest, payload)
        with create_file(path) as file:
            set_attributes(file, format=PRODUCT_FORMAT, format_version=FORMAT_VERSION)
            group = create_group(file, PRODUCT_GROUP)
            _write_content(group, payload)
            set_attributes(group, digest=digest.result())
    return digest.result()


def read_product_file(path: Path) -> StoredPayload:
    """Read a file written by `write_product_file`.

    Args:
        path: the file; it must not be moved or changed while its memory-mapped arrays are in use.

    Raises:
        RecordFormatError: the file is damaged, or has another format or a newer version of the
            format.
        OSError: the file cannot be opened.
    """
    with safe_open(path, PRODUCT_FORMAT) as file:
        return read_payload(open_group(file, PRODUCT_GROUP))


def read_payload(group: h5py.Group) -> StoredPayload:
    """Read a product from its group in a file opened with `safe_open`.

    Raises:
        RecordFormatError: the group is damaged or incomplete.
    """
    arrays: dict[str, NDArray[np.generic]] = {}
    for name, dataset in array_datasets(group):
        with reading(dataset.name):
            arrays[name] = _read_array(dataset)
    return StoredPayload(
        type_name=text_attribute(group, "type"),
        encoding_version=int_attribute(group, "encoding_version"),
        metadata=_metadata(group),
        arrays=arrays,
        mapped=bool(int_attribute(group, "mapped")),
        digest=text_attribute(group, "digest"),
    )


def array_datasets(group: h5py.Group) -> Iterator[tuple[str, h5py.Dataset]]:
    """Yield the names and datasets of a product's arrays, sorted by name, without reading the data.

    Raises:
        RecordFormatError: the group is damaged.
    """
    pending = [("", open_group(group, "arrays"))]
    while pending:
        name, item = pending.pop()
        if isinstance(item, h5py.Dataset):
            yield name, item
            continue
        with reading(item.name):
            children = [(f"{name}/{child}".lstrip("/"), item[child]) for child in sorted(item)]
        pending += reversed(children)


def measure_payloads(
    left: PayloadLike, right: PayloadLike, tolerances: Tolerances
) -> tuple[ArrayDifference, ...]:
    """Compare two products, reading arrays block by block.

    Args:
        left: the first product.
        right: the second product.
        tolerances: limit and unit of a field, by the name of the field. The name of a field is the
            last part of an array's name or of the path of a metadata value that is not a number,
            such as `depth_m` in `walls/0/depth_m`. Other fields must be equal, except that floats
            in the metadata may differ by a millionth of the larger value, or by 1e-6 if it is below
            1. NaN equals NaN.

    Returns:
        All differences, sorted by name, including those within the limits; empty if the products
        are equal.
    """
    if (left.type_name, left.encoding_version) != (right.type_name, right.encoding_version):
        problem = (
            f"the products are {left.type_name} version {left.encoding_version} and "
            f"{right.type_name} version {right.encoding_version}"
        )
        return (_unlike("type", (_EXACT, "1"), problem),)
    differences: list[ArrayDifference] = []
    for name in sorted(left.arrays.keys() | right.arrays.keys()):
        tolerance = _tolerance(name, tolerances)
        if name not in left.arrays or name not in right.arrays:
            differences.append(_unlike(name, tolerance, _ALONE))
        else:
            differences += _array_differences(
                name, left.arrays[name], right.arrays[name], tolerance
            )
    differences += _json_differences("", dict(left.metadata), dict(right.metadata), tolerances)
    return tuple(differences)


def _metadata(group: h5py.Group) -> dict[str, JsonValue]:
    value = parse_json(read_text(group, "metadata"), f"{group.name}/metadata")
    if not isinstance(value, dict):
        raise RecordFormatError(f"{group.name}/metadata must contain a JSON object")
    return value


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
                    f"the array {name} cannot be inside {'/'.join(parents[:depth])}, which is "
                    "itself an array"
                )


def _write_content(group: h5py.Group, payload: PayloadLike) -> None:
    set_attributes(
        group,
        type=payload.type_name,
        encoding_version=payload.encoding_version,
        mapped=int(payload.mapped),
    )
    write_array(group, "metadata", fixed_text(canonical_json(payload.metadata)))
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
    dtype = array.dtype.newbyteorder("<")
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
    if array.size:
        dataset.write_direct(np.asarray(array, order="C"))


def _create_contiguous(
    group: h5py.Group, name: str, shape: tuple[int, ...], dtype: np.dtype[np.generic]
) -> h5py.Dataset:
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_layout(h5py.h5d.CONTIGUOUS)
    properties.set_obj_track_times(False)
    # With early allocation, the offset in the file is known when the dataset has been created.
    # Without fill values, HDF5 writes no zeros before the data.
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    properties.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    space = h5py.h5s.create_simple(shape) if shape else h5py.h5s.create(h5py.h5s.SCALAR)
    kind = h5py.h5t.py_create(dtype, logical=True)
    return h5py.Dataset(
        h5py.h5d.create(group.id, name.encode("utf-8"), kind, space, dcpl=properties)
    )


def _chunk_shape(shape: tuple[int, ...], itemsize: int) -> tuple[int, ...]:
    """Return the shape of a chunk of about 1 MB, which contains whole rows if possible."""
    chunk = list(shape)
    for axis in range(len(chunk)):
        others = itemsize * math.prod(chunk) // chunk[axis]
        chunk[axis] = min(chunk[axis], max(1, _CHUNK_BYTES // others))
    return tuple(chunk)


def _read_array(dataset: h5py.Dataset) -> NDArray[np.generic]:
    offset = dataset.id.get_offset()
    is_mappable = (
        offset is not None
        and dataset.nbytes >= _SMALL_BYTES
        and dataset.dtype.isnative
        # Copy misaligned arrays, which other programs may write, because computing with them is
        # slower than copying.
        and offset % dataset.dtype.itemsize == 0
    )
    if is_mappable:
        path = Path(dataset.file.filename)
        if offset + dataset.nbytes > path.stat().st_size:
            raise RecordFormatError(f"{dataset.name} extends beyond the end of {path.name}")
        mapped = np.memmap(path, dtype=dataset.dtype, mode="r", offset=offset, shape=dataset.shape)
        return mapped.view(np.ndarray)
    array: NDArray[np.generic] = np.empty(dataset.shape, dtype=dataset.dtype)
    if array.size:
        dataset.read_direct(array)
    array.flags.writeable = False
    return array


def _array_differences(
    name: str,
    left: NDArray[np.generic],
    right: NDArray[np.generic],
    tolerance: tuple[float, str],
) -> Iterator[ArrayDifference]:
    if left.shape != right.shape or left.dtype != right.dtype:
        problem = f"{left.dtype} of shape {left.shape} versus {right.dtype} of shape {right.shape}"
        yield _unlike(name, tolerance, problem)
        return
    limit, unit = tolerance
    largest, n_values = 0.0, 0
    ours, theirs = left.reshape(-1), right.reshape(-1)
    step = _BLOCK_BYTES // left.dtype.itemsize
    for start in range(0, left.size, step):
        block = slice(start, start + step)
        distances = _distances(ours[block], theirs[block])
        largest = max(largest, float(distances.max()))
        n_values += int(np.count_nonzero(distances > limit))
    if largest:
        problem = (
            f"{n_values} of {left.size} values differ by more than {_amount(limit, unit)}, the "
            f"largest by {largest:g}"
        )
        yield ArrayDifference(
            name=name,
            largest=largest,
            limit=limit,
            unit=unit,
            n_values=n_values,
            problem=problem,
        )


def _distances(left: NDArray[np.generic], right: NDArray[np.generic]) -> NDArray[np.float64]:
    """Return absolute differences without overflow; infinite where only one value is NaN."""
    if left.dtype.kind in "iu" and left.dtype.itemsize == 8:
        # Compare exactly: above 2^53, different integers may convert to the same float64.
        larger, smaller = np.maximum(left, right), np.minimum(left, right)
        gaps: NDArray[np.uint64] = larger.view(np.uint64) - smaller.view(np.uint64)
        return gaps.astype(np.float64)
    a, b = left.astype(np.float64), right.astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        distances = np.abs(a - b)
    distances[np.isnan(a) != np.isnan(b)] = math.inf
    is_same = (a == b) | (np.isnan(a) & np.isnan(b))
    return np.where(is_same, 0.0, distances)


def _json_differences(
    name: str, left: JsonValue, right: JsonValue, tolerances: Tolerances
) -> Iterator[ArrayDifference]:
    tolerance = _tolerance(name, tolerances)
    if isinstance(left, dict) and isinstance(right, dict):
        for key in sorted(left.keys() | right.keys()):
            place = f"{name}/{key}".lstrip("/")
            if key not in left or key not in right:
                yield _unlike(place, tolerance, _ALONE)
            else:
                yield from _json_differences(place, left[key], right[key], tolerances)
    elif isinstance(left, list) and isinstance(right, list) and len(left) == len(right):
        for index, (a, b) in enumerate(zip(left, right, strict=True)):
            yield from _json_differences(f"{name}/{index}", a, b, tolerances)
    elif _is_number(left) and _is_number(right):
        one, other = float(str(left)), float(str(right))
        limit, unit = tolerance
        if _field(name) not in tolerances and float in (type(left), type(right)):
            limit = _STATED_SHARE * max(1.0, abs(one), abs(other))
        if one != other:
            yield ArrayDifference(
                name=name,
                largest=abs(one - other),
                limit=limit,
                unit=unit,
                n_values=int(abs(one - other) > limit),
                problem=f"{one:g} versus {other:g}; the limit is {_amount(limit, unit)}",
            )
    elif left != right or type(left) is not type(right):
        yield _unlike(name, tolerance, f"{left!r:.60} versus {right!r:.60}")


def _is_number(value: JsonValue) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _tolerance(name: str, tolerances: Tolerances) -> tuple[float, str]:
    field = _field(name)
    suffix = field.rpartition("_")[2]
    return tolerances.get(field, (_EXACT, suffix if suffix in _UNITS else "1"))


def _field(name: str) -> str:
    """Return the last part of a name that is not a number, such as `depth_m`."""
    parts = (part for part in reversed(name.split("/")) if not part.isdigit())
    return next(parts, "")


def _amount(value: float, unit: str) -> str:
    return f"{value:g}" if unit == "1" else f"{value:g} {unit}"


def _unlike(name: str, tolerance: tuple[float, str], problem: str) -> ArrayDifference:
    limit, unit = tolerance
    return ArrayDifference(
        name=name, largest=math.inf, limit=limit, unit=unit, n_values=1, problem=problem
    )
