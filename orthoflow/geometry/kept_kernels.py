"""Compiled kernels that are kept between processes, looked at before they are loaded.

What numba keeps are pickles, and to read one is to run it. Each file begins with the SHA-256 of the
rest here: one that was damaged, cut off or written by somebody else is as good as none, and its
kernel is compiled again. That finds damage, not an enemy, who can write a digest as well.

Numba asks whether the file of a kernel is as it was, and not what the kernel takes from others.
Here a kernel is known by what it holds besides the types of its arguments (`contents_digest`), and
by nothing else: files of several states of the code lie beside each other, and none is ever taken
for another. The compiler puts the value of every global name into a kernel, a number, a table or
another kernel, and never asks again whether it is still so. A kernel whose contents have the same
digest is the same, wherever its lines stand and whatever else changed in its file or next door.

Of two processes that need a kernel one compiles it, and the other waits and loads it.
"""

from __future__ import annotations

import enum
import hashlib
import io
import pickle
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from functools import cache, singledispatch
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any, BinaryIO, Final

import numpy as np
from numba.core import types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

from orthoflow.geometry.kernel_news import tell
from orthoflow.system import FileLock, file_lock

_DIGEST_BYTES: Final = 32
# Of an index's files, in their names.
CHECKED: Final = ".checked"
# So many digits of the digest of what a kernel holds stand there, too.
_NAMED: Final = 16
# Longer than any kernel takes where its process gets a core. One that does not, beside much other
# work, or that was stopped, shall not be waited for: then each compiles for itself.
_PATIENCE_S: Final = 5.0
_LOOK_EVERY_S: Final = 0.01
_CONSTANTS: Final = (bool, int, float, complex, str, bytes, type(None), type(...))
# How kernels are compiled at all, and what this module asks.
_MAKERS: Final = ("compiling.py", "kept_kernels.py")


class KeptKernels(FunctionCache):
    """The kept versions of one kernel; stands in the place of numba's own."""

    # Any: numba's classes have no types.
    def __init__(self, kernel: Any) -> None:
        """Find where they are kept, as numba does.

        Raises:
            RuntimeError: nowhere on this machine can anything be kept.
        """
        self._kernel = kernel
        self._files: _CheckedFiles | None = None
        super().__init__(kernel.py_func)  # type: ignore[no-untyped-call]

    @property
    def _cache_file(self) -> _CheckedFiles:
        # Not before it is asked for: what a kernel calls may stand behind it in its module.
        if self._files is None:
            digest = self._contents()
            # Another name than numba's: a version before could not read these files. Without the
            # line, which is no part of a kernel.
            name, _, python = self._impl.filename_base.rpartition("-")
            base = f"{name}-{python.partition('.')[2]}{CHECKED}-{digest[:_NAMED]}"
            self._files = _CheckedFiles(self._cache_path, base, digest)  # type: ignore[no-untyped-call]
        return self._files

    @_cache_file.setter
    def _cache_file(self, _: object) -> None:
        """Take none of numba's own."""

    def _contents(self) -> str:
        try:
            return contents_digest(self._kernel)
        except UntellableError:
            # As long as all sources of kernels are as they are, which names the folder.
            stamp = self._impl.locator.get_source_stamp()
            return hashlib.sha256(repr((stamp, self._cache_path)).encode()).hexdigest()

    def _index_key(self, signature: Any, codegen: Any) -> Any:
        key = super()._index_key(signature, codegen)  # type: ignore[no-untyped-call]
        return (*key, fields_of(signature))

    def holds(self, signature: object, context: Any) -> bool:
        """Whether a version is kept, as far as the index says."""
        context.refresh()
        key = self._index_key(signature, context.codegen())
        return key in self._cache_file._load_index()  # noqa: SLF001

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other processes from compiling the same kernel while the block runs.

        Kernels wait for those that they call and never the other way round, so nobody waits in a
        circle. Where files cannot be locked, or the other takes too long, nobody is kept from it.
        """
        path = Path(self._cache_file.lock_path)
        try:
            lock = path.open("wb")
        except OSError:
            yield
            return
        with lock, closing(file_lock(path, lock.fileno())) as held:
            if not _take(held):
                tell(f"waiting for another process that compiles {self._py_func.__name__}")
                _wait_for(held)
                tell("")
            yield


class _CheckedFiles(IndexDataCacheFile):
    """The index of a kernel's versions and the file of each, with their digests.

    No two files ever have one name, whoever writes them: an index never names another's version.
    """

    @property
    def lock_path(self) -> str:
        """The file that is locked while a version is compiled."""
        return f"{self._index_path.removesuffix('.nbi')}.lock"

    def _data_name(self, number: int) -> str:
        return f"{Path(self._index_path).stem}.{uuid.uuid4().hex[:12]}.nbc"

    def _load_index(self) -> dict[Any, str]:
        content = _checked(Path(self._index_path))
        if content is None:
            return {}
        stream = io.BytesIO(content)
        # As in numba: what another version of it kept may not even be readable.
        if pickle.load(stream) != self._version:
            return {}
        stamp, overloads = pickle.load(stream)
        return overloads if stamp == self._source_stamp else {}

    def _load_data(self, name: str) -> Any:
        content = _checked(Path(self._cache_path) / name)
        return None if content is None else pickle.loads(content)

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[BinaryIO]:
        content = io.BytesIO()
        yield content
        with super()._open_for_write(filepath) as stream:
            stream.write(hashlib.sha256(content.getvalue()).digest())
            stream.write(content.getvalue())


def _take(lock: FileLock) -> bool:
    """Take a lock that nobody has, or go on where there are none; False when another has it."""
    try:
        return lock.take(is_shared=False, waits=False)
    except OSError:
        return True


def _wait_for(lock: FileLock) -> None:
    until = time.monotonic() + _patience.left_s
    while not _take(lock):
        if time.monotonic() > until:
            # Nor is the next one waited for, that it will not have compiled either.
            _patience.left_s = 0.0
            return
        time.sleep(_LOOK_EVERY_S)


class _Patience:
    """How long this process waits for another one."""

    left_s = _PATIENCE_S


_patience = _Patience()


def _checked(path: Path) -> bytes | None:
    """The content of a file behind its digest; None, and the file is gone, when they disagree."""
    try:
        whole = path.read_bytes()
    except OSError:
        return None
    digest, content = whole[:_DIGEST_BYTES], whole[_DIGEST_BYTES:]
    if hashlib.sha256(content).digest() == digest:
        return content
    with suppress(OSError):
        path.unlink()
    return None


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
