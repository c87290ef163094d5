"""Compiling the parts of kernels so that a first run waits as little as possible.

Numba wraps every function for callers in Python and in C. Where a scene's tables are among the
arguments, the wrappers take as long to compile as the function itself; what only kernels call
needs neither.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

_Kernel = TypeVar("_Kernel", bound=Callable[..., object])


def kernel_part(function: _Kernel) -> _Kernel:
    """Compile a function that only kernels call, when one that does is compiled."""
    options = {"cache": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    compiler = numba.njit(**options)  # type: ignore[call-overload]  # the stubs leave these out
    return cast("_Kernel", compiler(function))


def typed_kernel_part(signature: str) -> Callable[[_Kernel], _Kernel]:
    """Compile a function that only kernels call for one signature, when it is loaded.

    Without one, each constant that it is called with would compile a version of its own.
    """
    options = {"cache": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    compiler = numba.njit(  # type: ignore[call-overload]  # the stubs leave these out
        signature, **options
    )

    def compiled(function: _Kernel) -> _Kernel:
        return cast("_Kernel", compiler(function))

    return compiled
