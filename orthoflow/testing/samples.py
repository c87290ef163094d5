"""Some numbers of a product, which tell whether it moved without keeping it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import JsonValue, Product
from orthoflow.products.product import Payload, Tolerance

_AT_MOST: Final = 32
# A cell on the rim of something falls to either side by the last bit of a number: one in so many.
_STRAY_SHARE: Final = 1 / 16
# As records are compared: what no tolerance is stated for may differ in its last digits.
_UNSTATED: Final = 1e-6
# Numbers in the metadata say something about a result, such as a median or a count. Without a
# processor's wide instructions one of ours moved by 3e-4, every array staying within its tolerance.
_METADATA_SHARE: Final = 1e-2
_DIGITS: Final = 9
_ROUNDING: Final = 10.0 ** (1 - _DIGITS)
# Odd, and no divisor of the sides of rasters: neighbouring samples fall far apart.
_STRIDE: Final = 2_654_435_761
_METADATA: Final = "metadata"


@dataclass(frozen=True, kw_only=True)
class Sample:
    """Numbers from an array.

    Attributes:
        shape: of the array.
        values: up to 32 of its values to nine digits, by a rule that knows the size only; None
            for NaN.
    """

    shape: Sequence[int]
    values: Sequence[float | None]


@dataclass(frozen=True, kw_only=True)
class _Limit:
    """How far two numbers may lie apart: an amount, and a share of the larger one."""

    amount: float
    share: float = 0.0


def sample_of(product: Product) -> dict[str, Sample]:
    """Give a sample of every array, and of the numbers in the metadata; bytes are left out.

    The bytes of a compressed picture all change when one pixel does.
    """
    payload = product.to_payload()
    samples = {
        name: _sample(np.asarray(array))
        for name, array in payload.arrays.items()
        if not _is_bytes(payload, name)
    }
    stated = np.array(list(_numbers(dict(payload.metadata))), dtype=np.float64)
    return {**samples, _METADATA: _sample(stated)}


def sample_problem(
    before: Mapping[str, Sample],
    after: Mapping[str, Sample],
    tolerances: Mapping[str, Tolerance],
    *,
    numbers_stated: bool = True,
) -> str:
    """Say what moved between two samples by more than a product's tolerances; empty for nothing.

    Args:
        before: of one product.
        after: of the other.
        tolerances: of its type.
        numbers_stated: the numbers in the metadata count as well, not only how many there are.
    """
    for name in sorted({*before, *after}):
        if name not in before or name not in after:
            return f"only one of them has {name}"
        old, new = before[name], after[name]
        if list(old.shape) != list(new.shape):
            return f"{name} had {list(old.shape)} values, now {list(new.shape)}"
        if name == _METADATA and not numbers_stated:
            continue
        limit = _limit(name, tolerances)
        n_apart = sum(_is_apart(a, b, limit) for a, b in zip(old.values, new.values, strict=True))
        if n_apart > _STRAY_SHARE * len(old.values):
            return f"{n_apart} of {len(old.values)} sampled values of {name} moved"
    return ""


def _sample(array: NDArray[np.generic]) -> Sample:
    flat = array.reshape(-1)
    n_values = min(flat.size, _AT_MOST)
    places = range(flat.size) if flat.size <= _AT_MOST else _places(flat.size)
    values = [float(flat[place]) for place in places][:n_values]
    return Sample(
        shape=list(array.shape),
        values=[float(f"{value:.{_DIGITS}g}") if np.isfinite(value) else None for value in values],
    )


def _places(size: int) -> list[int]:
    return [(index * _STRIDE) % size for index in range(1, _AT_MOST + 1)]


def _limit(name: str, tolerances: Mapping[str, Tolerance]) -> _Limit:
    if name == _METADATA:
        return _Limit(amount=_UNSTATED, share=_METADATA_SHARE)
    tolerance = tolerances.get(_field(name))
    if tolerance is None:
        return _Limit(amount=_UNSTATED, share=_UNSTATED)
    return _Limit(amount=tolerance.limit)


def _is_apart(before: float | None, after: float | None, limit: _Limit) -> bool:
    if before is None or after is None:
        return before is not after
    largest = max(abs(before), abs(after))
    return abs(after - before) > limit.amount + (limit.share + _ROUNDING) * largest


def _is_bytes(payload: Payload, name: str) -> bool:
    node: JsonValue = dict(payload.metadata)
    for part in name.split("/"):
        if isinstance(node, dict):
            node = node[part]
        elif isinstance(node, list):
            node = node[int(part)]
    return node == {"$array": "bytes"}


def _numbers(node: JsonValue) -> Iterator[float]:
    if isinstance(node, dict):
        for value in node.values():
            yield from _numbers(value)
    elif isinstance(node, list):
        for value in node:
            yield from _numbers(value)
    elif isinstance(node, int | float) and not isinstance(node, bool):
        yield float(node)


def _field(name: str) -> str:
    return name.rpartition("/")[2]
