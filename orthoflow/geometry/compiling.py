"""Compilation of kernels by numba, with the same options for all kernels.

For each function, numba compiles wrappers for callers in Python and in C. If the arguments include
the tables of a scene, compiling the wrappers takes as long as compiling the function. Functions
that only kernels call need no wrappers.

Numba caches kernels, but not its own functions, so each process that compiles a kernel also
compiles the numba functions called by it. The assignment of an array to a slice (`part[2:] =
array`) makes numba compile forty of its functions just for an error message about shapes, so
kernels assign single elements instead.
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

# Maximum number of files in the cache, each about 40 kB. One version of orthoflow has about 400
# files.
_MAX_FILES: Final = 8000


def compiled(function: _Kernel) -> _Kernel:
    """Compile a kernel that is called from Python and releases the GIL.

    Threads are started by `geometry.threads`; numba's parallel loops would take seconds longer to
    compile.
    """
    # A wrapper for callers in C is not needed.
    return cast("_Kernel", _kept(function, nogil=True, no_cfunc_wrapper=True))


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Inline a short function into the kernels that call it."""
    return cast("Callable[..., Any]", _kept(function, inline="always"))


def interpreted(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Return the Python version of an inlined function, for occasional calls."""
    return cast("Callable[..., Any]", getattr(kernel, "py_func", kernel))


def kernel_part(function: _Kernel) -> _Kernel:
    """Mark a function that only kernels call; it is compiled together with these kernels."""
    return cast("_Kernel", _kept(function, no_cpython_wrapper=True, no_cfunc_wrapper=True))


# The type is Any, because numba has no types for kernels.
def _kept(function: Callable[..., Any], **options: object) -> Any:
    """Return a kernel whose compiled code is cached between processes."""
    # Divisions by zero must not raise exceptions, because this would prevent vectorisation.
    kernel = numba.njit(error_model="numpy", **options)(function)  # type: ignore[call-overload]  # the stubs leave options out
    if not isinstance(kernel, Dispatcher):
        # With NUMBA_DISABLE_JIT, the function runs in Python.
        return kernel
    # If there is no writable folder for the cache, each process compiles its kernels.
    with suppress(RuntimeError):
        # Numba has no public attribute for the cache.
        vars(kernel)["_cache"] = _KernelCache(function)  # type: ignore[no-untyped-call]
    _give_constants_no_version(kernel)
    return kernel


class _KernelCache(FunctionCache):
    """Cache of compiled code whose file names depend on all code that a kernel uses.

    Numba itself checks only the file that contains a kernel, not the functions that the kernel
    calls in other files. Here, file names contain a digest of the kernel, all functions that it
    calls, and the constants used in them. Thus, only kernels affected by an edit are recompiled,
    independently of the folder of a checkout, and several versions of the code can share a cache.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        self._open_files()
        return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save compiled code; if the disk is full, the next process compiles it again."""
        self._open_files()
        with suppress(OSError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]

    def _save_overload(self, sig: Any, data: Any) -> None:
        if self._impl.check_cachable(data):
            key = self._index_key(sig, data.codegen)
            self._cache_file.save(key, self._impl.reduce(data))  # type: ignore[no-untyped-call]

    def _open_files(self) -> None:
        """Return the cache files, opened at the first call because callees may be defined later."""
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
    """Files with the index and the compiled versions of a kernel.

    Numba numbers the files of compiled versions. If two processes compile different versions at the
    same time, both may use the same number, and an index may refer to the code of the wrong
    version. Here, all file names are unique. A file truncated by a power failure is ignored.
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
    """Return the SHA-256 of everything except argument types that affects the compiled code.

    This includes the bytecode and the constants of the function and of all functions that it calls,
    and the values of module constants used in them.
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
    """Return the code of a function and its nested functions, and the values of their globals."""
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
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}".encode() + value.tobytes()
    if isinstance(value, type):
        fields = getattr(value, "_fields", ())
        return f"{value.__module__}.{value.__qualname__}{fields}".encode()
    if isinstance(value, int | float | complex | str | bytes | None):
        return repr(value).encode()
    # Use only the names of objects from libraries; the digest includes the version of numba and the
    # platform.
    return str(getattr(value, "__name__", type(value).__name__)).encode()


def _all_code(code: CodeType) -> Iterator[CodeType]:
    yield code
    for value in code.co_consts:
        if isinstance(value, CodeType):
            yield from _all_code(value)


def _field_names(type_: object) -> tuple[object, ...]:
    """Return the field names of named tuples in types, because numba compares only field types."""
    if isinstance(type_, types.NamedTuple | types.NamedUniTuple):
        fields = type_.instance_class._fields
        return (fields, *map(_field_names, type_.types))
    inner = type_ if isinstance(type_, tuple) else getattr(type_, "types", ())
    return tuple(map(_field_names, inner))


def _give_constants_no_version(kernel: Any) -> None:
    """Make kernels call the same version of a function for constant and variable integers.

    Otherwise, numba would compile a version for each constant, and an unused version for a counter
    whose initial value is 0.
    """
    template_for = kernel.get_call_template

    def template_for_any(args: tuple[Any, ...], kws: dict[str, Any]) -> object:
        try:
            named = dict(zip(kws, map(types.unliteral, kws.values()), strict=True))
            return template_for(tuple(map(types.unliteral, args)), named)
        except TypingError:
            # Keep constants in this case, because only constants can index a tuple with members of
            # different types.
            return template_for(args, kws)

    kernel.get_call_template = template_for_any


class _Compilation(event.Listener):
    """Reports which kernel is being compiled, including kernels that other kernels call.

    Numba's compiler lock ensures that only one thread compiles at a time.
    """

    def __init__(self) -> None:
        self._depth = 0
        self._n_begun = 0

    def on_start(self, event: event.Event) -> None:
        """Report the kernel being compiled, and the number compiled so far in this process.

        The total is unknown, because it depends on the data.
        """
        kernel = event.data["dispatcher"]
        self._depth += 1
        self._n_begun += 1
        # Functions that numba generates have no informative names.
        name = kernel.py_func.__qualname__.partition(".")[0]
        report_compiling(f"compiling {name} ({self._n_begun} so far)")

    def on_end(self, event: event.Event) -> None:
        self._depth -= 1
        if self._depth == 0:
            report_compiling("")


event.register("numba:compile", _Compilation())  # type: ignore[no-untyped-call]
