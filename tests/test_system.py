"""The portable twins of what only Linux has: locks, and steps without processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest

from orthoflow import system
from orthoflow.system import FileLock, file_lock, flags, read_at, take_room
from tests.optional import skip

ROOT = Path(__file__).resolve().parents[1]

# Our code finds neither these modules nor these names; libraries may have theirs.
WITHOUT = (Path(__file__).parent / "without_linux.py").read_text()
COMMAND = f"{WITHOUT}\nfrom orthoflow.cli import main\nmain()\n"

# Every module of ours is loaded as a system without these would load it.
EVERYTHING = f"""{WITHOUT}
import importlib, pkgutil
import orthoflow, orthoflow_plugins, orthoflow_provenance
n_loaded = 0
for package in (orthoflow, orthoflow_plugins, orthoflow_provenance):
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not found.name.endswith("__main__"):
            importlib.import_module(found.name)
            n_loaded += 1
print(n_loaded)
"""

WORKFLOW = """
orthoflow: 1
name: elsewhere
steps:
  cloud: {use: read.scan, in: {files: inputs.scan}}
inputs:
  scan: {files: scan.xyz}
"""


def without_linux(folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_a_workflow_runs_where_there_are_neither_kernel_locks_nor_forks(tmp_path: Path) -> None:
    (tmp_path / "elsewhere.yaml").write_text(WORKFLOW)
    points = [f"{x / 10} {y / 10} {(x * y) % 3 / 100}" for x in range(30) for y in range(30)]
    (tmp_path / "scan.xyz").write_text("\n".join(points))
    said = without_linux(tmp_path, "run", "elsewhere.yaml", "-o", "run")
    assert "0 of 1 step cached" in said
    # The twin of the locks was used, not the kernel's.
    assert (tmp_path / "run" / "journal.jsonl.lock").is_file()
    assert "verified" in without_linux(tmp_path, "verify", "run")
    again = without_linux(tmp_path, "run", "elsewhere.yaml", "-o", "again")
    assert "cloud: cached (1 of 1)" in again


def test_every_module_loads_without_what_only_linux_has() -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error::ImportWarning", "-c", EVERYTHING],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    sources = [
        path
        for package in ("orthoflow", "plugins/orthoflow_plugins", "provenance/orthoflow_provenance")
        for path in (ROOT / package).rglob("*.py")
        if path.name != "__main__.py" and path.parent != ROOT / package
    ]
    # As many modules as there are sources in folders, and those beside them.
    assert int(done.stdout) >= len(sources)


def locks(path: Path, n: int, monkeypatch: pytest.MonkeyPatch, *, twin: bool) -> list[FileLock]:
    if twin:
        monkeypatch.setattr(system, "_fcntl", None)
    return [file_lock(path, os.open(path, os.O_RDWR | os.O_CREAT)) for _ in range(n)]


@pytest.mark.parametrize("twin", [False, True], ids=["kernel", "twin"])
def test_many_share_a_lock_and_one_holds_it_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, twin: bool
) -> None:
    if not twin and system._fcntl is None:
        skip("platform", "fcntl")
    path = tmp_path / "store"
    first, second, third = locks(path, 3, monkeypatch, twin=twin)
    assert first.take(is_shared=True, waits=False)
    assert second.take(is_shared=True, waits=False)
    assert not third.take(is_shared=False, waits=False)
    if twin:
        first.close()
        assert not third.take(is_shared=False, waits=False)
        second.close()
        assert third.take(is_shared=False, waits=False)
        assert not first.take(is_shared=True, waits=False)
        third.close()


def test_the_twin_of_a_dead_process_is_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "store"
    (mine,) = locks(path, 1, monkeypatch, twin=True)
    holder = subprocess.Popen(
        [
            sys.executable,
            "-c",
            textwrap.dedent(
                f"""
                import time
                from pathlib import Path
                from orthoflow.system import _DatabaseLock
                lock = _DatabaseLock(Path({str(path)!r}))
                print(lock.take(is_shared=False, waits=True), flush=True)
                time.sleep(600)
                """
            ),
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "True\n"
        assert not mine.take(is_shared=False, waits=False)
    finally:
        holder.kill()
        holder.wait()
        holder.stdout.close()
    assert mine.take(is_shared=False, waits=False)
    mine.close()


def test_flags_that_a_system_does_not_know_count_nothing() -> None:
    assert flags("O_RDWR", "O_CREAT", "O_OF_ANOTHER_PLANET") == os.O_RDWR | os.O_CREAT


@pytest.mark.parametrize("twin", [False, True], ids=["system", "twin"])
def test_room_on_the_disk_is_taken_and_places_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, twin: bool
) -> None:
    if twin:
        monkeypatch.delattr(os, "posix_fallocate", raising=False)
        monkeypatch.delattr(os, "pread", raising=False)
    path = tmp_path / "array"
    size_bytes = (5 << 20) + 3
    with path.open("wb") as file:
        take_room(file, size_bytes)
    found = path.stat()
    assert found.st_size == size_bytes
    # Blocks of 512 bytes: nothing of it is a hole.
    assert 512 * found.st_blocks >= size_bytes
    path.write_bytes(b"0123456789")
    descriptor = os.open(path, os.O_RDONLY)
    try:
        assert read_at(descriptor, 4, 3) == b"3456"
    finally:
        os.close(descriptor)


def test_cores_are_those_that_the_process_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {1, 4, 5}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    assert system.usable_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    assert system.usable_cores() == 8
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert system.usable_cores() == 1


def test_memory_is_limited_where_somebody_limited_it(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = SimpleNamespace(RLIMIT_AS=9, RLIM_INFINITY=-1)
    limits.getrlimit = {9: (5_000_000, 7_000_000)}.__getitem__
    monkeypatch.setattr(system, "_resource", limits)
    assert system.address_space() == 5_000_000
    limits.getrlimit = {9: (-1, -1)}.__getitem__
    assert system.address_space() is None
    monkeypatch.setattr(system, "_resource", None)
    assert system.address_space() is None


def test_processes_that_ended_have_used_processor_time(monkeypatch: pytest.MonkeyPatch) -> None:
    used = SimpleNamespace(ru_utime=1.5, ru_stime=0.25)
    of_children = SimpleNamespace(RUSAGE_CHILDREN=-1, getrusage={-1: used}.__getitem__)
    monkeypatch.setattr(system, "_resource", of_children)
    assert system.children_processor_s() == 1.75
    monkeypatch.setattr(system, "_resource", None)
    times = SimpleNamespace(children_user=2.5, children_system=0.5, user=9.0, system=9.0)
    monkeypatch.setattr(os, "times", lambda: times)
    assert system.children_processor_s() == 3.0


def test_a_file_is_locked_until_it_is_closed_where_the_kernel_can(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a"
    path.touch()
    with path.open("rb") as one, path.open("rb") as other:
        system.lock_where_possible(one.fileno(), is_shared=True)
        lock = file_lock(path, other.fileno())
        assert not lock.take(is_shared=False, waits=False)
        assert lock.take(is_shared=True, waits=False)
    with path.open("rb") as one, path.open("rb") as other:
        monkeypatch.setattr(system, "_fcntl", None)
        system.lock_where_possible(one.fileno(), is_shared=False)
        monkeypatch.undo()
        assert file_lock(path, other.fileno()).take(is_shared=False, waits=False)


def test_the_twin_of_a_lock_says_where_there_can_be_none(tmp_path: Path) -> None:
    lock = system._DatabaseLock(tmp_path / "no folder" / "a")
    with pytest.raises(OSError, match="unable to open"):
        lock.take(is_shared=True, waits=False)
    lock.close()


@pytest.mark.parametrize("twin", [False, True], ids=["system", "twin"])
@pytest.mark.parametrize("fails", [False, True])
def test_the_working_folder_is_come_back_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, twin: bool, fails: bool
) -> None:
    if twin:
        monkeypatch.delattr(os, "O_PATH", raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "below").mkdir()
    with suppress(ZeroDivisionError), system.working_folder_kept():
        os.chdir("below")
        assert 1 // (not fails)
    assert Path.cwd() == tmp_path
