"""The one way to compile: what numba is told is told here.

Numba wraps every function for callers in Python and in C. Where a scene's tables are among the
arguments, the wrappers take as long to compile as the function itself; what only kernels call
needs neither.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeVar, cast

import numba
from numba.core import event
from numba.core.dispatcher import Dispatcher

from orthoflow.geometry.kernel_news import tell

_Kernel = TypeVar("_Kernel", bound=Callable[..., object])

# Compiled code is kept between processes. Divisions do not stop at 0: lanes of a vector can fill.
_KEPT: Final = {"cache": True, "error_model": "numpy"}
_UNWRAPPED: Final = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def compiled(function: _Kernel) -> _Kernel:
    """Compile a kernel that Python calls; it lets other threads run.

    Threads come from `geometry.threads`, not from numba's own loops: those take seconds more to
    compile.
    """
    return cast("_Kernel", numba.njit(**_KEPT, nogil=True)(function))  # type: ignore[call-overload]  # the stubs leave options out


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Put a function of a few instructions into each kernel that calls it."""
    return cast("Callable[..., Any]", numba.njit(**_KEPT, inline="always")(function))  # type: ignore[call-overload]


def interpreted(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Give an inlined function as Python runs it, for a few single calls."""
    return cast("Callable[..., Any]", kernel.py_func)  # type: ignore[attr-defined]


def kernel_part(function: _Kernel) -> _Kernel:
    """Compile a function that only kernels call, when one that does is compiled."""
    return cast("_Kernel", numba.njit(**_KEPT, **_UNWRAPPED)(function))  # type: ignore[call-overload]


def typed_kernel_part(signature: str) -> Callable[[_Kernel], _Kernel]:
    """Compile a function that only kernels call for one signature, when it is loaded.

    Without one, each constant that it is called with would compile a version of its own.
    """

    def compile_part(function: _Kernel) -> _Kernel:
        compiler = numba.njit(signature, **_KEPT, **_UNWRAPPED)  # type: ignore[call-overload]
        return cast("_Kernel", compiler(function))

    return compile_part


class _Compilation(event.Listener):
    """Hears from numba which kernel is compiled; one that needs others waits for these.

    The compiler's own lock lets one thread compile at a time.
    """

    def __init__(self) -> None:
        self._depth = 0
        self._n_begun = 0
        self._n_needed = 0

    def on_start(self, event: event.Event) -> None:
        """Say what is compiled."""
        kernel = event.data["dispatcher"]
        if self._depth == 0:
            self._n_begun, self._n_needed = 0, len(_uncompiled(kernel, {}))
        self._depth += 1
        self._n_begun += 1
        n_needed = max(self._n_needed, self._n_begun)
        tell(f"compiling {self._n_begun} of {n_needed}: {kernel.py_func.__name__}")

    def on_end(self, event: event.Event) -> None:
        """Say that it is there."""
        self._depth -= 1
        if self._depth == 0:
            tell("")


def _uncompiled(kernel: Dispatcher, found: dict[Dispatcher, None]) -> dict[Dispatcher, None]:
    """A kernel and all that it calls, as far as nothing of them is compiled in this process."""
    if kernel in found or kernel.signatures or kernel.targetoptions.get("inline") == "always":
        return found
    found[kernel] = None
    for name in kernel.py_func.__code__.co_names:
        called = kernel.py_func.__globals__.get(name)
        if isinstance(called, Dispatcher):
            _uncompiled(called, found)
    return found


event.register("numba:compile", _Compilation())  # type: ignore[no-untyped-call]
