"""Kept kernels are loaded again, and what is not as it was kept is never run."""

from __future__ import annotations

import fcntl
import importlib.util
import os
import pickle
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO

import pytest
from numba.core import config

from orthoflow.geometry import kept_kernels
from orthoflow.geometry.kernel_news import heard_by
from orthoflow.system import HAS_STEP_PROCESSES

LOCKED_BY_LINUX = pytest.mark.skipif(not HAS_STEP_PROCESSES, reason="holds a lock as Linux does")

KERNELS = """
from orthoflow.geometry.compiling import compiled, inlined, kernel_part, typed_kernel_part

@inlined
def twice(x):
    return 2 * x

@kernel_part
def more(x):
    return twice(x) + 1

@typed_kernel_part("int64(int64)")
def most(x):
    return more(x) + 100

@compiled
def asked(x):
    return most(x) // 0.5
"""


@pytest.fixture
def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Any]:
    """Import the kernels as a new process does."""
    path = tmp_path / "kernels.py"
    path.write_text(KERNELS)
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "kept"))

    def load_again() -> Any:
        spec = importlib.util.spec_from_file_location("kernels", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load_again


def kept(folder: Path, name: str, ending: str) -> Path:
    [path] = (folder / "kept").rglob(f"kernels.{name}-*.{ending}")
    return path


def counts(kernel: Any) -> tuple[int, int]:
    return sum(kernel.stats.cache_hits.values()), sum(kernel.stats.cache_misses.values())


def test_what_one_process_compiled_another_loads(load: Callable[[], Any]) -> None:
    first, again = load(), load()
    assert first.asked(3) == again.asked(3) == 214.0
    assert counts(first.asked) == (0, 1)
    assert counts(again.asked) == (1, 0)
    assert counts(first.most) == (0, 1)
    assert counts(again.most) == (1, 0)


def test_what_an_edit_left_alone_is_loaded_and_nothing_else(
    load: Callable[[], Any], tmp_path: Path
) -> None:
    path = tmp_path / "kernels.py"
    assert load().asked(3) == 214.0
    # Of another length: Python itself takes bytecode of the same second for that of the file.
    path.write_text(KERNELS.replace("+ 100", "+ 1100"))
    edited = load()
    assert edited.asked(3) == 2214.0
    assert counts(edited.most) == counts(edited.asked) == (0, 1)
    assert counts(edited.more) == (1, 0)
    # As it was, but for lines and an unused name: both states lie there.
    path.write_text(f"# Above.\nUNUSED = 3\n{KERNELS}")
    again = load()
    assert again.asked(3) == 214.0
    assert counts(again.asked) == counts(again.most) == (1, 0)


@LOCKED_BY_LINUX
def test_a_kernel_that_another_process_compiles_is_waited_for_and_loaded(
    load: Callable[[], Any], tmp_path: Path
) -> None:
    load().asked(3)
    index = kept(tmp_path, "asked", "nbi")
    aside = index.rename(index.with_suffix(".aside"))
    again = load()
    heard: list[str] = []

    def compile_elsewhere(lock: BinaryIO) -> None:
        while not heard:
            time.sleep(0.01)
        aside.rename(index)
        lock.close()

    with heard_by(heard.append), ThreadPoolExecutor(1) as pool:
        lock = _locked(index)
        pool.submit(compile_elsewhere, lock)
        assert again.asked(3) == 214.0
    assert counts(again.asked) == (1, 0)
    assert heard == ["waiting for another process that compiles asked", ""]


@LOCKED_BY_LINUX
def test_who_takes_too_long_to_compile_is_waited_for_once(
    load: Callable[[], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load().asked(3)
    index = kept(tmp_path, "asked", "nbi")
    index.unlink()
    monkeypatch.setattr(kept_kernels._patience, "left_s", 0.2)
    again = load()
    with _locked(index):
        assert again.asked(3) == 214.0
        assert counts(again.asked) == (0, 1)
    assert kept_kernels._patience.left_s == 0.0


def _locked(index: Path) -> BinaryIO:
    lock = index.with_suffix(".lock").open("wb")
    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return lock


class _WritesWhenRead:
    """A pickle that does what its maker wants."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return os.mkdir, (str(self.path),)


def flip(path: Path, _: object) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def cut(path: Path, _: object) -> None:
    os.truncate(path, path.stat().st_size - 1)


def empty(path: Path, _: object) -> None:
    os.truncate(path, 0)


def put_pickle(path: Path, trap: Path) -> None:
    path.write_bytes(pickle.dumps(_WritesWhenRead(trap)))


def put_pickle_behind(path: Path, trap: Path) -> None:
    path.write_bytes(path.read_bytes()[:32] + pickle.dumps(_WritesWhenRead(trap)))


@pytest.mark.parametrize(
    ("ending", "damage"),
    [
        *(("nbc", damage) for damage in (flip, cut, empty, put_pickle, put_pickle_behind)),
        *(("nbi", damage) for damage in (flip, put_pickle)),
    ],
)
def test_what_was_damaged_or_replaced_is_not_run_but_compiled_again(
    load: Callable[[], Any], tmp_path: Path, ending: str, damage: Callable[[Path, Path], None]
) -> None:
    load().asked(3)
    trap = tmp_path / "trap"
    damage(kept(tmp_path, "asked", ending), trap)
    again = load()
    assert again.asked(3) == 214.0
    assert counts(again.asked) == (0, 1)
    assert not trap.exists()
    mended = load()
    assert mended.asked(3) == 214.0
    assert counts(mended.asked) == (1, 0)


def test_a_kernel_whose_contents_nobody_can_tell_is_known_by_its_file(
    load: Callable[[], Any], tmp_path: Path
) -> None:
    def known_as(text: str) -> str:
        (tmp_path / "kernels.py").write_text(text)
        os.utime(tmp_path / "kernels.py", (1e9, 1e9))
        return str(load().asked._cache._contents())

    text = (
        "from orthoflow.geometry.compiling import compiled\n"
        "@compiled\ndef asked(x):\n    return {1, 2}\n"
        "asked.py_func.__defaults__ = (object(),)\n"
    )
    # With its address in it, no name of the object would be the same in two processes.
    assert known_as(text) == known_as(text)
    assert known_as(text) != known_as(f"{text}\n")


@pytest.fixture
def index(tmp_path: Path) -> kept_kernels._CheckedFiles:
    files = kept_kernels._CheckedFiles(str(tmp_path), "kernel", "digest")  # type: ignore[no-untyped-call]
    files._save_index({"int64": "kernel.nbc"})  # type: ignore[no-untyped-call]
    return files


def test_an_index_holds_for_one_kernel_of_one_numba(
    index: kept_kernels._CheckedFiles, tmp_path: Path
) -> None:
    def opened(digest: str) -> kept_kernels._CheckedFiles:
        return kept_kernels._CheckedFiles(str(tmp_path), "kernel", digest)  # type: ignore[no-untyped-call]

    assert opened("digest")._load_index() == {"int64": "kernel.nbc"}
    assert opened("other")._load_index() == {}
    newer = opened("digest")
    newer._version = "another"
    assert newer._load_index() == {}


def test_where_files_cannot_be_locked_nobody_waits() -> None:
    class NoLock:
        def take(self, *, is_shared: bool, waits: bool) -> bool:
            raise OSError(37, "no locks available")

    assert kept_kernels._take(NoLock())  # type: ignore[arg-type]
