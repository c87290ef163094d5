"""The portable twins of what only Linux has: locks, and steps without processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from orthoflow import system
from orthoflow.system import FileLock, file_lock, flags, read_at, take_room

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
        pytest.skip("this system has no such locks")
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
