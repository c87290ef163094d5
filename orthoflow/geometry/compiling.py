"""The one way to compile: what numba is told is told here.

Numba wraps every function for callers in Python and in C. Where a scene's tables are among the
arguments, the wrappers take as long to compile as the function itself; what only kernels call
needs neither.

Numba keeps kernels, but not its own functions: each process that compiles a kernel compiles those
that it calls. An array put into a part of another (`part[2:] = array`) calls forty, for a sentence
about shapes: kernels put numbers, one by one.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numba
from numba.core import event, types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher
from numba.core.errors import TypingError

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
    """Return an inlined function as Python runs it, for a few single calls."""
    return cast("Callable[..., Any]", getattr(kernel, "py_func", kernel))


def kernel_part(function: _Kernel) -> _Kernel:
    """Compile a function that only kernels call, when one that does is compiled."""
    return cast("_Kernel", _kept(function, **_UNWRAPPED))


def typed_kernel_part(signature: str) -> Callable[[_Kernel], _Kernel]:
    """Compile a function that only kernels call for one signature, when it is loaded.

    Without one, each constant that it is called with would compile a version of its own.
    """

    def compile_part(function: _Kernel) -> _Kernel:
        kernel = _kept(function, **_UNWRAPPED)
        if isinstance(kernel, Dispatcher):
            kernel.compile(signature)
            kernel.disable_compile()
        return cast("_Kernel", kernel)

    return compile_part


# Any: numba's kernels have no types.
def _kept(function: Callable[..., Any], **options: object) -> Any:
    """Make a kernel whose compiled code is kept between processes."""
    # Divisions do not stop at 0: lanes of a vector can fill.
    kernel = numba.njit(error_model="numpy", **options)(function)  # type: ignore[call-overload]  # the stubs leave options out
    if not isinstance(kernel, Dispatcher):
        # NUMBA_DISABLE_JIT: Python runs it.
        return kernel
    # Where nothing can be kept, no home and a program that only others may change, it is compiled
    # in each process.
    with suppress(RuntimeError):
        vars(kernel)["_cache"] = _KernelCache(function)  # numba has no public name for it
    _give_constants_no_version(kernel)
    return kernel


class _KernelCache(FunctionCache):
    """Numba's cache of a function, for processes that compile at the same time."""

    def __init__(self, function: Callable[..., object]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._cache_file = _KernelFiles(
            cache_path=self._cache_path,
            filename_base=self._impl.filename_base,
            source_stamp=self._impl.locator.get_source_stamp(),
        )  # type: ignore[no-untyped-call]


class _KernelFiles(IndexDataCacheFile):
    """Index and versions of a kernel.

    Numba numbers the files of versions, and two processes that compile two versions at once take
    one number for both: the index of one then names the code of the other. Here no two files have
    one name. A file that was cut off by a power failure is as good as none.
    """

    def save(self, key: object, data: object) -> None:
        # A full disk costs the next process some seconds, and not this one its result.
        with suppress(OSError):
            super().save(key, data)  # type: ignore[no-untyped-call]

    def _data_name(self, number: int) -> str:
        return f"{Path(self._index_path).stem}.{number}-{uuid.uuid4().hex[:12]}.nbc"

    def _load_index(self) -> dict[Any, str]:
        try:
            return cast("dict[Any, str]", super()._load_index())  # type: ignore[no-untyped-call]
        except Exception:  # noqa: BLE001 - whatever unpickling half a file raises
            return {}

    def _load_data(self, name: str) -> Any:
        try:
            return super()._load_data(name)  # type: ignore[no-untyped-call]
        except Exception:  # noqa: BLE001 - as above
            return None


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
        """State what is compiled, and how many were in this process.

        How many there will be nobody knows: what a step needs hangs on its data.
        """
        kernel = event.data["dispatcher"]
        self._depth += 1
        self._n_begun += 1
        # What numba makes within a function of ours, or of its own, is all called alike.
        name = kernel.py_func.__qualname__.partition(".")[0]
        tell(f"compiling {name} ({self._n_begun} so far)")

    def on_end(self, event: event.Event) -> None:
        """State that it is there."""
        self._depth -= 1
        if self._depth == 0:
            tell("")


event.register("numba:compile", _Compilation())  # type: ignore[no-untyped-call]
