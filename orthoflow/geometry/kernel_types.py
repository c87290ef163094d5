"""Types of kernels' arguments as JSON, so that a kernel can be compiled before it is called."""

from __future__ import annotations

import importlib
from typing import Any, Final, cast

import numpy as np
from numba.core import types
from numba.np import numpy_support

# A number (`float64`), an array (`const uint8 2 C`: type, dimensions, layout), `slice`, or a tuple:
# its class, empty for a plain one, then its members.
Text = str | list[Any]

_SLICE: Final = "slice"
_CONST: Final = "const "


def text_of(kind: types.Type) -> Text:
    """Write a type.

    Raises:
        TypeError: such a one has no short text.
    """
    if isinstance(kind, types.BaseTuple):
        named = getattr(kind, "instance_class", None)
        name = f"{named.__module__}:{named.__qualname__}" if named is not None else ""
        return [name, *map(text_of, kind)]  # type: ignore[call-overload]  # numba has no types
    if isinstance(kind, types.Array):
        if not kind.aligned:  # of records
            raise TypeError(f"an array of {kind.dtype} cannot be written")
        const = "" if kind.mutable else _CONST
        return f"{const}{_number(kind.dtype)} {kind.ndim} {kind.layout}"
    if kind == types.slice2_type:
        return _SLICE
    return _number(kind)


def type_of(text: Text) -> types.Type:
    """Read what `text_of` wrote.

    Raises:
        AttributeError, ImportError: a class of tuples is not there any more.
        LookupError, TypeError, ValueError: the text is none.
    """
    # Any: numba's types are made by functions without any.
    kind: Any
    if isinstance(text, list):
        name, *members = text
        module, _, attribute = name.partition(":")
        named = getattr(importlib.import_module(module), attribute) if name else None
        kind = types.BaseTuple.from_types(  # type: ignore[no-untyped-call]
            tuple(map(type_of, members)), named
        )
    elif text == _SLICE:
        kind = types.slice2_type
    else:
        number, *form = text.removeprefix(_CONST).split()
        kind = numpy_support.from_dtype(np.dtype(number))
        if form:
            n_dimensions, layout = form
            make: Any = types.Array
            kind = make(kind, int(n_dimensions), layout, readonly=text.startswith(_CONST))
    return cast("types.Type", kind)


def _number(kind: types.Type) -> str:
    # Raises what numba raises for types that numpy does not have.
    return str(numpy_support.as_dtype(kind))
