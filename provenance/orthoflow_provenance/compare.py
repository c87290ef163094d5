"""How far two products of one type lie apart, array by array, against stated limits."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow_provenance.blocks import block_indices
from orthoflow_provenance.model import JsonValue, PayloadLike

Tolerances: TypeAlias = Mapping[str, tuple[float, str]]

_EXACT: Final = 0.0
# Of numbers in the metadata, which say something about a product and are not the product itself:
# other versions of numerical libraries round their last digits in another way.
_STATED_SHARE: Final = 1e-6
_UNITS: Final = ("mm", "m", "px", "deg")


@dataclass(frozen=True, kw_only=True)
class ArrayDifference:
    """One array or metadata value in which two products differ.

    Attributes:
        name: name of the array, or path of the value in the metadata.
        largest: largest absolute difference of two numbers in `unit`; infinite where they cannot
            be subtracted (another shape or type, missing, NaN against a number).
        limit: largest difference that is allowed.
        unit: unit of both.
        n_values: how many values differ by more than the limit; 0 when the products agree here.
        problem: one sentence.
    """

    name: str
    largest: float
    limit: float
    unit: str
    n_values: int
    problem: str


def measure_payloads(
    left: PayloadLike, right: PayloadLike, tolerances: Tolerances
) -> tuple[ArrayDifference, ...]:
    """Measure how far two products lie apart; arrays are read block by block.

    Args:
        left: one product.
        right: the other.
        tolerances: field -> (limit, unit). A field is the last part of a name that is not a
            number: `depth_m` for the array `walls/0/depth_m`, and the same for numbers in the
            metadata. Fields not named must be equal, but for fractions in the metadata, which
            may differ by a millionth of the larger one, or by a millionth where that is below 1.
            NaN equals NaN.

    Returns:
        All differences, also those within the limits, by name; empty when the products are equal.
    """
    differences: list[ArrayDifference] = []
    if (left.type_name, left.encoding_version) != (right.type_name, right.encoding_version):
        problem = (
            f"the products are {left.type_name} version {left.encoding_version} and "
            f"{right.type_name} version {right.encoding_version}"
        )
        return (_unlike("type", (_EXACT, "1"), problem),)
    for name in sorted(left.arrays.keys() | right.arrays.keys()):
        tolerance = _tolerance(name, tolerances)
        if name not in left.arrays or name not in right.arrays:
            differences.append(_unlike(name, tolerance, "only one of the products has it"))
        else:
            differences += _array_differences(
                name, left.arrays[name], right.arrays[name], tolerance
            )
    differences += _json_differences("", dict(left.metadata), dict(right.metadata), tolerances)
    return tuple(differences)


def _array_differences(
    name: str,
    left: NDArray[np.generic],
    right: NDArray[np.generic],
    tolerance: tuple[float, str],
) -> Iterator[ArrayDifference]:
    if left.shape != right.shape or left.dtype != right.dtype:
        problem = f"{left.dtype} of shape {left.shape} against {right.dtype} of {right.shape}"
        yield _unlike(name, tolerance, problem)
        return
    limit, unit = tolerance
    largest, total, n_values = 0.0, 0.0, 0
    for index in block_indices(left.shape, left.dtype.itemsize):
        distances = _distances(np.ravel(left[index]), np.ravel(right[index]))
        largest = max(largest, float(distances.max()))
        total += float(distances[np.isfinite(distances)].sum())
        n_values += int(np.count_nonzero(distances > limit))
    if largest:
        problem = (
            f"{n_values} of {left.size} values differ by more than {_amount(limit, unit)}, the "
            f"largest by {largest:g}; the mean of all is {total / left.size:.3g}"
            if n_values
            else f"differs by {_amount(largest, unit)} at most, {limit:g} are allowed"
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
    """Absolute differences, infinite where only one value is NaN; of any type, without overflow."""
    if left.dtype.kind in "iu" and left.dtype.itemsize == 8:
        # Neighbours beyond 2^53 are one float64.
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
                yield _unlike(place, tolerance, "only one of the products has it")
            else:
                yield from _json_differences(place, left[key], right[key], tolerances)
    elif isinstance(left, list) and isinstance(right, list) and len(left) == len(right):
        for index, (a, b) in enumerate(zip(left, right, strict=True)):
            yield from _json_differences(f"{name}/{index}", a, b, tolerances)
    elif _is_number(left) and _is_number(right):
        stated = _stated_tolerance(name, left, right, tolerances)
        yield from _number_differences(name, float(str(left)), float(str(right)), stated)
    elif left != right or type(left) is not type(right):
        yield _unlike(name, tolerance, f"{left!r:.60} against {right!r:.60}")


def _number_differences(
    name: str, left: float, right: float, tolerance: tuple[float, str]
) -> Iterator[ArrayDifference]:
    limit, unit = tolerance
    distance = abs(left - right)
    if distance:
        yield ArrayDifference(
            name=name,
            largest=distance,
            limit=limit,
            unit=unit,
            n_values=int(distance > limit),
            problem=f"{left:g} against {right:g}, {_amount(limit, unit)} are allowed",
        )


def _is_number(value: JsonValue) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _tolerance(name: str, tolerances: Tolerances) -> tuple[float, str]:
    field = _field(name)
    return tolerances.get(field, (_EXACT, _unit(field)))


def _stated_tolerance(
    name: str, left: JsonValue, right: JsonValue, tolerances: Tolerances
) -> tuple[float, str]:
    limit, unit = _tolerance(name, tolerances)
    values = [value for value in (left, right) if isinstance(value, float)]
    if _field(name) in tolerances or not values:
        return limit, unit
    return _STATED_SHARE * max(1.0, *(abs(value) for value in values)), unit


def _field(name: str) -> str:
    """The last part of a name that is not a number."""
    parts = (part for part in reversed(name.split("/")) if not part.isdigit())
    return next(parts, "")


def _unit(field: str) -> str:
    """The unit that the name of a field ends in, 1 when it ends in none."""
    suffix = field.rpartition("_")[2]
    return suffix if suffix in _UNITS else "1"


def _amount(value: float, unit: str) -> str:
    return f"{value:g}" if unit == "1" else f"{value:g} {unit}"


def _unlike(name: str, tolerance: tuple[float, str], problem: str) -> ArrayDifference:
    limit, unit = tolerance
    return ArrayDifference(
        name=name, largest=math.inf, limit=limit, unit=unit, n_values=1, problem=problem
    )
