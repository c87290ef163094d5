"""What compiled code holds besides the types of its arguments, as a digest.

The compiler puts the value of every global name into a kernel, a number, a table or another kernel,
and never asks again whether it is still so. A kernel whose contents have the same digest is the
same, wherever its lines stand and whatever else changed in its file or next door.
"""

from __future__ import annotations

import enum
import hashlib
from collections.abc import Iterator, Mapping
from functools import cache, singledispatch
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any, Final

import numpy as np
from numba.core import types
from numba.core.dispatcher import Dispatcher

_CONSTANTS: Final = (bool, int, float, complex, str, bytes, type(None), type(...))
# How kernels are compiled at all, and what this module asks.
_MAKERS: Final = ("compiling.py", "kept_kernels.py", "kernel_contents.py")


class UntellableError(TypeError):
    """A kernel holds something of which nobody knows when it is another one."""


def contents_digest(kernel: Dispatcher) -> str:
    """Digest of the code of a kernel, of all that it calls, and of all values that they name.

    Raises:
        UntellableError: it names something that is neither a constant, a kernel, a class nor a
            module.
    """
    digest = hashlib.sha256(_makers())
    for text in _told(kernel, []):
        digest.update(f"{len(text)}:{text}".encode())
    return digest.hexdigest()


# Any: numba's classes have no types.
def fields_of(signature: Any) -> tuple[object, ...]:
    """Names of the fields of all named tuples in a signature, in order.

    Two whose fields changed places have the same types.
    """
    if not isinstance(signature, types.BaseTuple | tuple | list):
        return ()
    inner: Any = signature
    return (getattr(inner, "fields", ()), *map(fields_of, inner))


@cache
def _makers() -> bytes:
    folder = Path(__file__).parent
    return b"".join(hashlib.sha256((folder / name).read_bytes()).digest() for name in _MAKERS)


# Any: whatever a kernel may name.
def _told(value: Any, seen: list[Dispatcher]) -> Iterator[str]:
    """Tell a value in texts that differ where it does; of kernels told before only which."""
    yield type(value).__name__
    yield from _inside(value, seen)


@singledispatch
def _inside(value: Any, seen: list[Dispatcher]) -> Iterator[str]:
    raise UntellableError(f"{type(value).__name__} {value!r}")


def _constant(value: Any, _: list[Dispatcher]) -> Iterator[str]:
    yield repr(value)


for _kind in _CONSTANTS:
    _inside.register(_kind, _constant)


@_inside.register
def _(value: Dispatcher, seen: list[Dispatcher]) -> Iterator[str]:
    if value in seen:
        yield str(seen.index(value))
        return
    seen.append(value)
    yield from _told(sorted(value.targetoptions.items()), seen)
    yield from _told(value.py_func, seen)


@_inside.register
def _(value: FunctionType, seen: list[Dispatcher]) -> Iterator[str]:
    yield from _told(value.__code__, seen)
    yield from _told([value.__defaults__, *(value.__kwdefaults__ or {}).items()], seen)
    yield from _told([cell.cell_contents for cell in value.__closure__ or ()], seen)
    yield from _told_of_names(value.__code__, value.__globals__, seen)


@_inside.register
def _(value: CodeType, seen: list[Dispatcher]) -> Iterator[str]:
    # Neither the file nor the lines.
    yield f"{value.co_name} {value.co_flags} {value.co_argcount} {value.co_posonlyargcount}"
    yield f"{value.co_kwonlyargcount} {value.co_code.hex()} {value.co_exceptiontable.hex()}"
    yield from _told([value.co_names, value.co_varnames, value.co_freevars], seen)
    yield from _told([value.co_cellvars, value.co_consts], seen)


@_inside.register
def _(value: tuple | list, seen: list[Dispatcher]) -> Iterator[str]:  # type: ignore[type-arg]
    yield f"{len(value)} {getattr(value, '_fields', '')}"
    for item in value:
        yield from _told(item, seen)


@_inside.register
def _(value: frozenset, _: list[Dispatcher]) -> Iterator[str]:  # type: ignore[type-arg]
    yield from sorted(map(repr, value))


@_inside.register
def _(value: np.ndarray | np.generic, _: list[Dispatcher]) -> Iterator[str]:
    yield f"{value.dtype} {value.shape} {value.strides} {value.tobytes().hex()}"


@_inside.register
def _(value: enum.Enum, _: list[Dispatcher]) -> Iterator[str]:
    yield f"{type(value).__module__} {value!r}"


@_inside.register
def _(value: ModuleType | BuiltinFunctionType | np.ufunc, _: list[Dispatcher]) -> Iterator[str]:
    yield value.__name__


@_inside.register
def _(value: np.dtype | types.Type, _: list[Dispatcher]) -> Iterator[str]:
    yield repr(value)


@_inside.register
def _(value: type, seen: list[Dispatcher]) -> Iterator[str]:
    yield f"{value.__module__}.{value.__qualname__}"
    if issubclass(value, enum.Enum):
        yield from (f"{member!r}" for member in value)
    elif issubclass(value, tuple) and hasattr(value, "_fields"):
        defaults: dict[str, object] = getattr(value, "_field_defaults", {})
        yield from _told([*value._fields, *defaults.items()], seen)


def _told_of_names(
    code: CodeType, names: Mapping[str, Any], seen: list[Dispatcher]
) -> Iterator[str]:
    """Tell what the names in a code mean, also those behind the name of a module of ours."""
    for name in code.co_names:
        if name not in names:
            continue
        yield name
        value = names[name]
        yield from _told(value, seen)
        if isinstance(value, ModuleType):
            for inner in code.co_names:
                item = vars(value).get(inner)
                if isinstance(item, (*_CONSTANTS, tuple, np.generic, Dispatcher, enum.Enum)):
                    yield inner
                    yield from _told(item, seen)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _told_of_names(constant, names, seen)
