"""Compilation of kernels by numba, with the same options everywhere.

Numba wraps every function for callers in Python and in C. If a scene's tables are among the
arguments, the wrappers take as long to compile as the function itself; functions that only kernels
call need neither.

Numba caches kernels, but not its own functions: each process that compiles a kernel compiles those
that it calls. Assigning an array to a slice of another (`part[2:] = array`) calls forty of them for
an error message about shapes, so kernels assign single numbers.
"""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, Final, TypeVar, cast

import numba
import numpy as np
from numba.core import config, event, types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher
from numba.core.errors import TypingError

from orthoflow.geometry.compile_events import report_compiling

_Kernel = TypeVar("_Kernel", bound=Callable[..., object])

# Some 40 kB each; the code of one version has about 400.
_MAX_FILES: Final = 8000
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
        # Numba has no public name for it.
        vars(kernel)["_cache"] = _KernelCache(function)  # type: ignore[no-untyped-call]
    _give_constants_no_version(kernel)
    return kernel


class _KernelCache(FunctionCache):
    """Numba's cache of a function, found by the content of all that it calls.

    Numba itself looks at the file of a kernel alone, and not at what the kernel calls in others.
    Here the name of the files has the digest of the kernel, of all functions that it calls and of
    the constants that these use. So an edit compiles what it changes and nothing else, wherever a
    checkout lies, and several versions of the code share a folder.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return what is kept for argument types, or None."""
        self._open_files()
        return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep compiled code; a full disk costs the next process seconds and nothing else."""
        self._open_files()
        with suppress(OSError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]

    def _save_overload(self, sig: Any, data: Any) -> None:
        if self._impl.check_cachable(data):
            key = self._index_key(sig, data.codegen)
            self._cache_file.save(key, self._impl.reduce(data))  # type: ignore[no-untyped-call]

    def _open_files(self) -> None:
        """Find the files; at the first call, since what a kernel calls may stand below it."""
        if not isinstance(self._cache_file, _KernelFiles):
            root = cast("str", vars(config)["CACHE_DIR"])
            folder = Path(root, "kernels") if root else Path(self._cache_path)
            with suppress(OSError):
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            name = f"{self._py_func.__module__}.{self._py_func.__qualname__}"
            digest = content_digest(self._py_func)
            self._cache_file = _KernelFiles(
                cache_path=str(folder),
                filename_base=f"{name.replace('<', '').replace('>', '')}-{digest[:32]}",
                source_stamp=digest,
            )  # type: ignore[no-untyped-call]

    def _index_key(self, sig: Any, codegen: Any) -> tuple[object, ...]:
        return (*super()._index_key(sig, codegen), _field_names(sig))  # type: ignore[no-untyped-call]


class _KernelFiles(IndexDataCacheFile):
    """Index and versions of a kernel.

    Numba numbers the files of versions, and two processes that compile two versions at once take
    one number for both: the index of one then names the code of the other. Here no two files have
    one name. A file that was cut off by a power failure is as good as none.
    """

    def _save_index(self, overloads: dict[Any, str]) -> None:
        super()._save_index(overloads)  # type: ignore[no-untyped-call]
        files = sorted(Path(self._cache_path).iterdir(), key=lambda path: path.lstat().st_mtime)
        if len(files) > _MAX_FILES:
            for old in files[: _MAX_FILES // 2]:
                old.unlink(missing_ok=True)

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


def content_digest(function: FunctionType) -> str:
    """Return the SHA-256 of all that decides the compiled code of a function but argument types.

    That is its bytecode and constants, and those of each function that it calls, with the values of
    the module constants that these read.
    """
    digest = hashlib.sha256()
    seen: set[int] = set()

    def add(value: object) -> None:
        if isinstance(value, Dispatcher):
            digest.update(repr(sorted(value.targetoptions.items())).encode())
            value = value.py_func
        if not isinstance(value, FunctionType | tuple):
            digest.update(_described(value))
        elif isinstance(value, tuple):
            digest.update(f"{len(value)} values".encode())
            for item in value:
                add(item)
        elif id(value) not in seen:
            seen.add(id(value))
            add(_decisive(value))

    add(function)
    return digest.hexdigest()


def _decisive(function: FunctionType) -> tuple[object, ...]:
    """Code of a function and of those inside it, and what the names in it stand for."""
    cells = tuple(cell.cell_contents for cell in function.__closure__ or ())
    found: list[object] = [function.__defaults__, cells]
    for code in _all_code(function.__code__):
        constants = tuple(value for value in code.co_consts if not isinstance(value, CodeType))
        found += [code.co_code, constants, code.co_names, code.co_varnames, code.co_freevars]
        for name in code.co_names:
            value = function.__globals__.get(name)
            found.append(value)
            if isinstance(value, ModuleType):
                found += [getattr(value, inner, None) for inner in code.co_names]
    return tuple(found)


def _described(value: object) -> bytes:
    """Bytes that stand for a value which is no function."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}".encode() + value.tobytes()
    if isinstance(value, type):
        fields = getattr(value, "_fields", ())
        return f"{value.__module__}.{value.__qualname__}{fields}".encode()
    if isinstance(value, int | float | complex | str | bytes | None):
        return repr(value).encode()
    # Of libraries, whose versions numba's own and the platform stand for.
    return str(getattr(value, "__name__", type(value).__name__)).encode()


def _all_code(code: CodeType) -> Iterator[CodeType]:
    """Yield the code of a function and of those that are defined in it."""
    yield code
    for value in code.co_consts:
        if isinstance(value, CodeType):
            yield from _all_code(value)


def _field_names(type_: object) -> tuple[object, ...]:
    """Names of the fields of all named tuples among types: numba compares their types alone."""
    if isinstance(type_, types.NamedTuple | types.NamedUniTuple):
        fields = type_.instance_class._fields
        return (fields, *map(_field_names, type_.types))
    inner = type_ if isinstance(type_, tuple) else getattr(type_, "types", ())
    return tuple(map(_field_names, inner))


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
    """Reports which kernel is being compiled; one that needs others waits for these.

    The compiler's own lock lets one thread compile at a time.
    """

    def __init__(self) -> None:
        self._depth = 0
        self._n_begun = 0

    def on_start(self, event: event.Event) -> None:
        """Report what is compiled, and how many kernels were compiled in this process.

        The total is unknown, because it depends on the data of a step.
        """
        kernel = event.data["dispatcher"]
        self._depth += 1
        self._n_begun += 1
        # What numba makes within a function of ours, or of its own, is all called alike.
        name = kernel.py_func.__qualname__.partition(".")[0]
        report_compiling(f"compiling {name} ({self._n_begun} so far)")

    def on_end(self, event: event.Event) -> None:
        """Report that all is compiled."""
        self._depth -= 1
        if self._depth == 0:
            report_compiling("")


event.register("numba:compile", _Compilation())  # type: ignore[no-untyped-call]
