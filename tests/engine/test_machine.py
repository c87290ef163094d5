"""What the engine reads off the machine and says of it: memory, locks, hours, versions, disks."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from orthoflow.engine import environment, measuring
from orthoflow.engine.durability import exclusive_lock, is_locked, shared_lock, whole_folder
from orthoflow.errors import StoreError
from tests.faulty_files import FaultyFiles

MIB = 1 << 20


def test_memory_of_a_tree_is_that_of_a_process_and_all_that_it_started() -> None:
    own = measuring.tree_memory(os.getpid())
    mine = measuring.process_memory()
    assert own >= 0.9 * mine > 0
    # None has this number.
    assert measuring.tree_memory(1 << 30) == 0


@pytest.mark.parametrize(
    ("total_mib", "floor_mib"), [(2048, 256), (8192, 512), (64 << 10, (64 << 10) * 3 / 100)]
)
def test_memory_is_short_at_the_floor_and_not_above(
    monkeypatch: pytest.MonkeyPatch, total_mib: int, floor_mib: float
) -> None:
    floor = int(floor_mib * MIB)
    for over, expected in ((1, 0), (0, floor), (-1, floor)):
        here = SimpleNamespace(total=total_mib * MIB, available=floor + over)
        monkeypatch.setattr(measuring.psutil, "virtual_memory", lambda here=here: here)
        assert measuring.memory_shortage() == expected


OF_MEMORY = (
    *(MemoryError(), OSError(errno.ENOMEM, ""), RuntimeError("can't start new thread")),
    *(ImportError("a.so: failed to map segment"), ImportError("cannot allocate memory in static")),
)
OTHERS = (RuntimeError("no threads"), ImportError("no module a"), OSError(errno.ENOSPC, "no space"))


def test_lack_of_memory_differs_from_other_errors() -> None:
    assert all(map(measuring.is_for_want_of_memory, OF_MEMORY))
    assert not any(map(measuring.is_for_want_of_memory, OTHERS))


# --- versions ---


def test_the_commit_is_that_of_the_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(environment, "__file__", str(tmp_path / "orthoflow/engine/a.py"))
    commit = environment.git_commit.__wrapped__
    assert commit() == ""
    (tmp_path / "tracked").write_text("one")
    own = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
    for arguments in (("init", "-q"), ("add", "tracked"), (*own, "commit", "-qm", "a")):
        subprocess.run(["git", "-C", str(tmp_path), *arguments], check=True)
    clean = commit()
    assert re.fullmatch(r"[0-9a-f]{40}", clean)
    (tmp_path / "tracked").write_text("other")
    assert commit() == f"{clean}+changes"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit() == ""


# --- locks ---


def test_a_lock_is_shared_by_many_or_held_by_one(tmp_path: Path) -> None:
    path = tmp_path / "a" / "lock"
    assert not is_locked(path)
    before = os.umask(0o022)
    try:
        with shared_lock(path), shared_lock(path):
            assert path.stat().st_mode & 0o777 == 0o644
            busy = pytest.raises(StoreError, match=r"^it is busy$")
            with busy, exclusive_lock(path, "it is busy"):
                pass
    finally:
        os.umask(before)
    assert not is_locked(path)
    with exclusive_lock(path, "busy"):
        assert is_locked(path)
    assert not is_locked(path)


# --- disks ---


def test_a_folder_holds_nothing_of_one_that_was_broken_off(tmp_path: Path) -> None:
    final = tmp_path / "exports" / "csv"
    left = tmp_path / "exports" / ".csv.unfinished" / "walls" / "old.csv"
    operation, is_through = 0, False
    while not is_through:
        operation += 1
        left.parent.mkdir(parents=True, exist_ok=True)
        left.write_text("of another call")
        shutil.rmtree(final, ignore_errors=True)
        files = FaultyFiles(tmp_path, "bad disk", operation, seed=operation)
        with files.in_place(), contextlib.suppress(StoreError), whole_folder(final) as aside:
            aside.mkdir(exist_ok=True)
            (aside / "new.csv").write_text("of this one")
        is_through = files.count < operation
        found = [path.name for path in final.rglob("*") if path.is_file()]
        assert found in (["new.csv"], [])
    assert found == ["new.csv"]
    assert operation > 10
