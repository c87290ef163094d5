"""Digests of logical content: the same product has the same digest however it is stored."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow_provenance.blocks import byte_blocks, little_endian
from orthoflow_provenance.errors import RecordFormatError
from orthoflow_provenance.model import JsonValue, PayloadLike

PREFIX: Final = "sha256:"


@dataclass(frozen=True, kw_only=True)
class ArrayFingerprint:
    """An array without its values.

    Attributes:
        dtype: numpy's code of the little-endian type, e.g. `<f4`, `|u1`, `|b1`.
        shape: length of every axis.
        sha256: digest of the bytes, little-endian and in C order; 64 hexadecimal digits.
    """

    dtype: str
    shape: tuple[int, ...]
    sha256: str


def canonical_json(value: object) -> str:
    """Write a JSON value in the one way that digests are made of.

    Keys sorted by code point, no white space, no escapes beyond JSON's own, the shortest digits
    that give the same float. `1`, `1.0` and `-0.0` stay apart, as do `true` and `1`.

    Raises:
        RecordFormatError: the value holds NaN, infinity, keys that are not text, half a surrogate
            pair, or anything that is not JSON.

    >>> canonical_json({"b": 1.0, "a": [True, None, "é"]})
    '{"a":[true,null,"é"],"b":1.0}'
    """
    text = json.dumps(
        _plain(value, ""),
        sort_keys=True,
        ensure_ascii=False,
        allow_nan=False,
        separators=(",", ":"),
    )
    try:
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        raise RecordFormatError(
            f"text must be valid Unicode to be stored, got half a surrogate pair ({error})"
        ) from error
    return text


def sha256_text(text: str) -> str:
    """Digest of a text's UTF-8 bytes, 64 hexadecimal digits."""
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def array_fingerprint(array: NDArray[np.generic]) -> ArrayFingerprint:
    """Digest one array without copying it when it is contiguous.

    Raises:
        RecordFormatError: the type is none that can be stored.
    """
    check_storable(array.dtype)
    digest = hashlib.sha256()
    for block in byte_blocks(array):
        digest.update(block.data)
    return ArrayFingerprint(
        dtype=little_endian(array.dtype).str, shape=array.shape, sha256=digest.hexdigest()
    )


def payload_digest(payload: PayloadLike) -> str:
    """Digest a product: type, encoding version, metadata, and every array's type, shape and bytes.

    Arrays are digested in threads, streaming, so memory-mapped ones are never loaded as a whole.

    Returns:
        `sha256:` and 64 hexadecimal digits.

    Raises:
        RecordFormatError: the metadata are not JSON or an array's type cannot be stored.
    """
    # Largest first, so that no thread is left alone with a long tail.
    names = sorted(payload.arrays, key=lambda name: -payload.arrays[name].nbytes)
    with ThreadPoolExecutor(max_workers=usable_cores()) as threads:
        prints = threads.map(lambda name: array_fingerprint(payload.arrays[name]), names)
        fingerprints = dict(zip(names, prints, strict=True))
    return digest_of_parts(
        payload.type_name, payload.encoding_version, payload.metadata, fingerprints
    )


def digest_of_parts(
    type_name: str,
    encoding_version: int,
    metadata: Mapping[str, JsonValue],
    arrays: Mapping[str, ArrayFingerprint],
) -> str:
    """Digest a product whose arrays have been digested before; see `payload_digest`."""
    content = {
        "what": "orthoflow/product",
        "v": 1,
        "type": type_name,
        "encoding_version": encoding_version,
        "metadata": metadata,
        "arrays": {
            name: [print_.dtype, list(print_.shape), print_.sha256]
            for name, print_ in arrays.items()
        },
    }
    return PREFIX + sha256_text(canonical_json(content))


def check_storable(dtype: np.dtype[np.generic]) -> None:
    """Refuse array types that the format does not know.

    Raises:
        RecordFormatError: the type is not bool, an integer of up to 8 bytes, or a float of 2, 4 or
            8 bytes.
    """
    is_float = dtype.kind == "f" and dtype.itemsize in (2, 4, 8)
    if not (dtype.kind in "biu" or is_float):
        raise RecordFormatError(
            f"an array of type {dtype} cannot be stored, only bool, integers and floats of 2, 4 or "
            "8 bytes can"
        )


def usable_cores() -> int:
    """Count the processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _plain(value: object, place: str) -> JsonValue:
    """Copy a value as plain JSON types, so that subclasses cannot print themselves differently."""
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise RecordFormatError(f"JSON needs finite numbers, got {value} at {place or 'root'}")
        return float(value)
    if isinstance(value, str):
        return str(value)
    if isinstance(value, list | tuple):
        return [_plain(item, f"{place}/{index}") for index, item in enumerate(value)]
    if isinstance(value, Mapping):
        return {_key(key, place): _plain(item, f"{place}/{key}") for key, item in value.items()}
    raise RecordFormatError(
        f"JSON knows no {type(value).__name__}, got one at {place or 'root'}: store numbers, text, "
        "lists or mappings"
    )


def _key(key: object, place: str) -> str:
    if not isinstance(key, str):
        raise RecordFormatError(
            f"keys of a JSON object must be text, got {key!r} at {place or 'root'}"
        )
    return str(key)
