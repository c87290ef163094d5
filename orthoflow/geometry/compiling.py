"""The one way to compile: what numba is told is told here.

Numba wraps every function for callers in Python and in C. Where a scene's tables are among the
arguments, the wrappers take as long to compile as the function itself; what only kernels call
needs neither.

Numba keeps kernels, but not its own functions: each process that compiles a kernel compiles those
that it calls. An array put into a part of another (`part[2:] = array`) calls forty, for a sentence
about shapes: kernels put numbers, one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, TypeVar, cast

import numba
from numba.core import event, sigutils, types
from numba.core.compiler_lock import global_compiler_lock
from numba.core.errors import TypingError

from orthoflow.geometry.kept_kernels import KeptKernels
from orthoflow.geometry.kernel_news import tell

_Kernel = TypeVar("_Kernel", bound=Callable[..., object])

_UNWRAPPED: Final = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def compiled(function: _Kernel) -> _Kernel:
    """Compile a kernel that Python calls; it lets other threads run.

    Threads come from `geometry.threads`, not from numba's own loops: those take seconds more to
    compile.
    """
    # The second of the wrappers, for callers in C, nobody needs.
    return cast("_Kernel", _kept(function, nogil=True, no_cfunc_wrapper=True))


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Put a function of a few instructions into each kernel that calls it."""
    return cast("Callable[..., Any]", _kept(function, inline="always"))


def interpreted(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Give an inlined function as Python runs it, for a few single calls."""
    return cast("Callable[..., Any]", kernel.py_func)  # type: ignore[attr-defined]


def kernel_part(function: _Kernel) -> _Kernel:
    """Compile a function that only kernels call, when one that does is compiled."""
    return cast("_Kernel", _kept(function, **_UNWRAPPED))


def typed_kernel_part(signature: str) -> Callable[[_Kernel], _Kernel]:
    """Compile a function that only kernels call for one signature, when it is loaded.

    Without one, each constant that it is called with would compile a version of its own.
    """

    def compile_part(function: _Kernel) -> _Kernel:
        kernel = _kept(function, **_UNWRAPPED)
        kernel.compile(signature)
        kernel.disable_compile()
        return cast("_Kernel", kernel)

    return compile_part


# Any: numba's kernels have no types.
def _kept(function: Callable[..., Any], **options: object) -> Any:
    """Make a kernel whose compiled code is kept between processes."""
    # Divisions do not stop at 0: lanes of a vector can fill.
    kernel = numba.njit(error_model="numpy", **options)(function)  # type: ignore[call-overload]  # the stubs leave options out
    # Where nothing can be kept, no home and a program that only others may change, it is compiled
    # in each process.
    with suppress(RuntimeError):
        _keep(kernel, KeptKernels(kernel))
    _give_constants_no_version(kernel)
    return kernel


def _keep(kernel: Any, kept: KeptKernels) -> None:
    """Let a kernel be loaded where it is kept, and else be compiled by one process alone."""
    kernel._cache = kept  # noqa: SLF001 - numba has no other door for it
    compile_it = kernel.compile

    def compile_once(signature: Any) -> object:
        # The compiler's lock first: who holds it never waits for a thread of this process.
        with global_compiler_lock:
            arguments, _ = sigutils.normalize_signature(signature)  # type: ignore[no-untyped-call]
            if tuple(arguments) in kernel.overloads or kept.holds(signature, kernel.targetctx):
                return compile_it(signature)
            with kept.alone():
                return compile_it(signature)

    kernel.compile = compile_once


def _give_constants_no_version(kernel: Any) -> None:
    """Let kernels call one version with all whole numbers, whichever are constants.

    Numba would compile one for each constant, and one for the 0 that a counter begins with, which
    nothing calls then.
    """
    template_for = kernel.get_call_template

    def template_for_any(args: tuple[Any, ...], kws: dict[str, Any]) -> object:
        try:
            named = dict(zip(kws, map(types.unliteral, kws.values()), strict=True))
            return template_for(tuple(map(types.unliteral, args)), named)
        except TypingError:
            # A tuple whose members differ in type is indexed by constants alone.
            return template_for(args, kws)

    kernel.get_call_template = template_for_any


class _Compilation(event.Listener):
    """Hears from numba which kernel is compiled; one that needs others waits for these.

    The compiler's own lock lets one thread compile at a time.
    """

    def __init__(self) -> None:
        self._depth = 0
        self._n_begun = 0

    def on_start(self, event: event.Event) -> None:
        """Say what is compiled, and how many were in this process.

        How many there will be nobody knows: what a step needs hangs on its data.
        """
        kernel = event.data["dispatcher"]
        self._depth += 1
        self._n_begun += 1
        # What numba makes within a function of ours, or of its own, is all called alike.
        name = kernel.py_func.__qualname__.partition(".")[0]
        tell(f"compiling {name} ({self._n_begun} so far)")

    def on_end(self, event: event.Event) -> None:
        """Say that it is there."""
        self._depth -= 1
        if self._depth == 0:
            tell("")


event.register("numba:compile", _Compilation())  # type: ignore[no-untyped-call]
