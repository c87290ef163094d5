"""Base class of all products, which convert to and from named arrays and JSON."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import ClassVar, Final, Literal, Self, TypeAlias, Union

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError, ProductError

JsonValue: TypeAlias = bool | int | float | str | list["JsonValue"] | dict[str, "JsonValue"] | None
Array: TypeAlias = NDArray[np.generic]
Unit = Literal["m", "px", "grey", "deg", "1"]

_ARRAY: Final = "$array"
# Larger arrays of all product types are memory-mapped.
LARGE_BYTES: Final = 1 << 30
# Errors that the checks of a product may raise for inconsistent values.
_NO_SENSE: Final = (
    *(AttributeError, IndexError, KeyError),
    *(TypeError, ValueError, GeometryError),
)


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """Maximum difference at which two values of a field count as equal.

    Attributes:
        limit: largest absolute difference, in `unit`.
        unit: metres, pixels, grey levels, degrees, or 1 for numbers without a unit.
    """

    limit: float
    unit: Unit


@dataclass(frozen=True, kw_only=True)
class Payload:
    """A product in the form used by the store, records and comparisons.

    Attributes:
        type_name: name of the product type, e.g. `planes`.
        encoding_version: version of the fields, incremented when they change.
        metadata: JSON with all values that are not arrays.
        arrays: arrays by name; `/` in a name separates levels, as in `walls/0/depth_m`.
        mapped: whether arrays are stored contiguously and uncompressed, so that readers can
            memory-map them.
    """

    type_name: str
    encoding_version: int
    metadata: Mapping[str, JsonValue]
    arrays: Mapping[str, Array]
    mapped: bool = False


class Product:
    """Base class of product types; these are frozen dataclasses.

    Fields may be numpy arrays, bytes, JSON values, members of an `IntEnum`, other dataclasses, and
    tuples of these; optional fields may also be None.

    Attributes:
        type_name: name in workflows, the store and records; must never change.
        encoding_version: version of the fields, incremented when they change.
        mapped: whether all arrays are memory-mapped, for products as large as a scan; arrays of
            more than 1 GiB always are.
        embedded: whether records contain the arrays instead of only their digests.
        tolerances: permitted differences in replays, by field name; all other fields must be equal.
    """

    type_name: ClassVar[str]
    encoding_version: ClassVar[int] = 1
    mapped: ClassVar[bool] = False
    embedded: ClassVar[bool] = True
    tolerances: ClassVar[Mapping[str, Tolerance]] = {}

    def to_payload(self) -> Payload:
        """Return the product as named arrays and JSON, without copying arrays."""
        arrays: dict[str, Array] = {}
        metadata = _encode_fields(self, "", arrays)
        return Payload(
            type_name=self.type_name,
            encoding_version=self.encoding_version,
            metadata=metadata,
            arrays=arrays,
            mapped=self.mapped or sum(array.nbytes for array in arrays.values()) > LARGE_BYTES,
        )

    def check_against(self, others: Mapping[str, Product]) -> None:
        """Check the product against the other products of its step when the step ends.

        Subclasses whose fields refer to other products override this method.

        Args:
            others: inputs and other outputs of the step, by port.

        Raises:
            ProductError: the product contradicts another one, or has invalid values.
        """

    @classmethod
    def from_payload(cls, payload: Payload) -> Self:
        """Create a product from the result of `to_payload`, without copying arrays.

        Raises:
            ProductError: the payload has a different type or version, or is incomplete.
        """
        if payload.type_name != cls.type_name:
            raise ProductError(f"expected a {cls.type_name} product, got {payload.type_name}")
        if payload.encoding_version != cls.encoding_version:
            raise ProductError(
                f"{cls.type_name} has encoding version {payload.encoding_version}, but this "
                f"version of orthoflow reads {cls.encoding_version}: use the version that wrote it"
            )
        return typing.cast("Self", _decode_fields(cls, "", payload.metadata, payload.arrays))


def require_shapes(what: str, wanted: Mapping[str, tuple[Array | None, tuple[int, ...]]]) -> None:
    """Require that arrays have the expected shapes; arrays that are None are ignored.

    Raises:
        ProductError: an array has an unexpected shape.
    """
    for name, (array, shape) in wanted.items():
        if array is not None and np.shape(array) != shape:
            raise ProductError(f"{what}.{name} must have shape {shape}, got {np.shape(array)}")


def _encode_fields(owner: object, prefix: str, arrays: dict[str, Array]) -> dict[str, JsonValue]:
    encoded: dict[str, JsonValue] = {}
    for field in dataclasses.fields(typing.cast("typing.Any", owner)):
        value = getattr(owner, field.name)
        if value is not None:
            encoded[field.name] = _encode(value, prefix + field.name, arrays)
    return encoded


def _encode(value: object, name: str, arrays: dict[str, Array]) -> JsonValue:
    if isinstance(value, np.ndarray):
        arrays[name] = value
        return {_ARRAY: "numeric"}
    if isinstance(value, bytes):
        arrays[name] = np.frombuffer(value, dtype=np.uint8)
        return {_ARRAY: "bytes"}
    if dataclasses.is_dataclass(value):
        return _encode_fields(value, name + "/", arrays)
    if isinstance(value, tuple | list):
        return [_encode(item, f"{name}/{index}", arrays) for index, item in enumerate(value)]
    if isinstance(value, Mapping):
        return {str(key): _encode(item, f"{name}/{key}", arrays) for key, item in value.items()}
    return _json_scalar(value, name)


def _json_scalar(value: object, name: str) -> JsonValue:
    if isinstance(value, np.bool_ | np.integer | np.floating):
        value = value.item()
    if isinstance(value, IntEnum):
        value = int(value)
    if isinstance(value, float) and not math.isfinite(value):
        raise ProductError(f"{name} must be finite to be stored as JSON, got {value}")
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ProductError(f"{name} is a {type(value).__name__}, which a product cannot store")


def _decode_fields(
    cls: type, prefix: str, metadata: Mapping[str, JsonValue], arrays: Mapping[str, Array]
) -> object:
    hints = _hints(cls)
    values: dict[str, object] = {}
    for field in dataclasses.fields(cls):
        if field.name in metadata:
            name = prefix + field.name
            values[field.name] = _decode(hints[field.name], metadata[field.name], name, arrays)
    lacking = [field.name for field in dataclasses.fields(cls) if _is_lacking(field, values)]
    if lacking:
        raise ProductError(
            f"a stored {cls.__name__} lacks fields: {', '.join(lacking)}; new fields need a "
            "default or a new encoding_version of the product"
        )
    try:
        return cls(**values)
    except ProductError:
        raise
    except _NO_SENSE as error:
        # IndexError: a product may use an array before it checks the number of its dimensions.
        raise ProductError(f"a stored {cls.__name__} is inconsistent: {error}") from error


def _is_lacking(field: dataclasses.Field[object], values: Mapping[str, object]) -> bool:
    no_default = field.default is dataclasses.MISSING is field.default_factory
    return field.init and no_default and field.name not in values


@cache
def _hints(cls: type) -> dict[str, object]:
    return typing.get_type_hints(cls)


def _decode(hint: object, stored: JsonValue, name: str, arrays: Mapping[str, Array]) -> object:
    if isinstance(stored, dict) and _ARRAY in stored:
        if name not in arrays:
            raise ProductError(f"the stored product lacks the array {name}")
        array = arrays[name]
        value = array.tobytes() if stored[_ARRAY] == "bytes" else array
        return _of_kind(hint, value, name)
    for candidate in _alternatives(hint):
        if _may_be(candidate, stored, hint) and isinstance(stored, dict):
            return _decode_fields(typing.cast("type", candidate), name + "/", stored, arrays)
        if typing.get_origin(candidate) is tuple and isinstance(stored, list):
            items = typing.get_args(candidate)
            if items[-1] is not Ellipsis and len(items) != len(stored):
                raise ProductError(
                    f"the stored {name} must have {len(items)} entries, got {len(stored)}"
                )
            return tuple(
                _decode(
                    items[0] if items[-1] is Ellipsis else items[i], item, f"{name}/{i}", arrays
                )
                for i, item in enumerate(stored)
            )
        if isinstance(candidate, type) and issubclass(candidate, IntEnum) and type(stored) is int:
            return _member(candidate, stored, name)
    return _of_kind(hint, stored, name)


def _may_be(candidate: object, stored: JsonValue, hint: object) -> bool:
    """Return whether a value fits a dataclass: it is the only candidate, or has all fields."""
    if not dataclasses.is_dataclass(candidate) or not isinstance(stored, dict):
        return False
    is_only = sum(map(dataclasses.is_dataclass, _alternatives(hint))) == 1
    return is_only or set(stored) <= {field.name for field in dataclasses.fields(candidate)}


def _member(kind: type[IntEnum], stored: int, name: str) -> IntEnum:
    try:
        return kind(stored)
    except ValueError as error:
        raise ProductError(f"the stored {name} must be a {kind.__name__}, got {stored}") from error


def _of_kind(hint: object, value: object, name: str) -> object:
    if isinstance(value, float) and not math.isfinite(value):
        raise ProductError(f"the stored {name} must be finite, got {value}")
    kinds = _kinds(hint)
    if kinds is None or (isinstance(value, kinds) and (bool in kinds or value is not True)):
        return value
    wanted = " or ".join(kind.__name__ for kind in kinds)
    raise ProductError(f"the stored {name} must be {wanted}, got {type(value).__name__}")


@cache
def _kinds(hint: object) -> tuple[type, ...] | None:
    """Return the types allowed for a field; None if all are."""
    found: list[type] = []
    for candidate in _alternatives(hint):
        origin = typing.get_origin(candidate) or candidate
        if origin is Literal:
            found += {type(value) for value in typing.get_args(candidate)}
        elif origin is float:
            found += [float, int]
        elif isinstance(origin, type) and origin is not object:
            found.append(dict if issubclass(origin, Mapping) else origin)
        else:
            return None
    return tuple(found)


def _alternatives(hint: object) -> Iterator[object]:
    if typing.get_origin(hint) in (Union, types.UnionType):
        yield from typing.get_args(hint)
    else:
        yield hint
