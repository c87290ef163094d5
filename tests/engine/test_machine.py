"""What the engine reads off the machine and says of it: memory, locks, hours, versions, disks."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import shutil
import subprocess
import time
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import pytest

from orthoflow.engine import environment, file_digests, measuring
from orthoflow.engine.durability import (
    exclusive_lock,
    folder_size,
    is_broken,
    is_locked,
    place_folder,
    shared_lock,
    size_of,
    store_error,
    whole_folder,
    write_whole,
    writing_to,
)
from orthoflow.engine.file_digests import FileDigests
from orthoflow.engine.measuring import AvailableMemory, MemoryGuard
from orthoflow.errors import InputError, StoreError
from tests.faulty_files import FaultyFiles

MIB = 1 << 20


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder whose files stand for those of the kernel."""
    for module in (measuring, environment):
        monkeypatch.setattr(module, "Path", lambda path: tmp_path / str(path).lstrip("/"))
    monkeypatch.setattr(measuring, "_CGROUPS", tmp_path / "sys/fs/cgroup")
    return tmp_path


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def test_memory_of_a_tree_is_that_of_a_process_and_all_that_it_started() -> None:
    own = measuring.tree_memory(os.getpid())
    mine = measuring.process_memory()
    assert own >= 0.9 * mine > 0
    # None has this number.
    assert measuring.tree_memory(1 << 30) == 0


GROUP: dict[str, dict[str, str]] = {
    "none": {},
    "version 2": {
        "proc/self/cgroup": "0::/outer/inner\n",
        "sys/fs/cgroup/outer/inner/memory.max": "max\n",
        "sys/fs/cgroup/outer/inner/memory.current": f"{100 * MIB}\n",
        "sys/fs/cgroup/outer/memory.max": f"{1000 * MIB}\n",
        "sys/fs/cgroup/outer/memory.current": f"{700 * MIB}\n",
        "sys/fs/cgroup/outer/memory.stat": f"file 7\ninactive_file {200 * MIB}\n",
        "sys/fs/memory.max": f"{1 * MIB}\n",
        "sys/fs/memory.current": "0\n",
    },
    "version 1": {
        "proc/self/cgroup": "12:cpu:/x\n4:blkio,memory:/outer\n",
        "sys/fs/cgroup/memory/outer/memory.limit_in_bytes": f"{2000 * MIB}\n",
        "sys/fs/cgroup/memory/outer/memory.usage_in_bytes": f"{500 * MIB}\n",
        "sys/fs/cgroup/memory/outer/memory.stat": f"total_inactive_file {30 * MIB}\ncache 9\n",
        "sys/fs/cgroup/memory/memory.limit_in_bytes": "9223372036854771712\n",
        "sys/fs/cgroup/memory/memory.usage_in_bytes": f"{9000 * MIB}\n",
    },
    "a group of the host's": {
        "proc/self/cgroup": "0::/not/here\n",
        "sys/fs/cgroup/memory.max": f"{600 * MIB}\n",
        "sys/fs/cgroup/memory.current": f"{700 * MIB}\n",
    },
    "other controllers": {
        "proc/self/cgroup": "12:cpu:/x\n",
        "sys/fs/cgroup/memory/x/memory.limit_in_bytes": "1\n",
        "sys/fs/cgroup/memory/x/memory.usage_in_bytes": "1\n",
    },
}


@pytest.mark.parametrize(
    ("group", "available_mib", "total_mib"),
    [
        ("none", 4096, 8192),
        ("version 2", 500, 1000),
        ("version 1", 1530, 2000),
        ("a group of the host's", 0, 600),
        ("other controllers", 4096, 8192),
    ],
)
def test_the_tightest_group_says_how_much_is_left(
    machine: Path, monkeypatch: pytest.MonkeyPatch, group: str, available_mib: int, total_mib: int
) -> None:
    here = SimpleNamespace(total=8192 * MIB, available=4096 * MIB)
    monkeypatch.setattr(measuring.psutil, "virtual_memory", lambda: here)
    write(machine, GROUP[group])
    assert measuring.available_memory() == AvailableMemory(
        available=available_mib * MIB, total=total_mib * MIB
    )


@pytest.mark.parametrize(
    ("margin_mib", "interval_s"),
    # At 6 GiB per second: never sooner than a hundredth, never later than a quarter of a second.
    [(-5, 0.01), (0, 0.01), (61.44, 0.01), (614.4, 0.1), (1536, 0.25), (10_000, 0.25)],
)
def test_the_guard_looks_again_before_the_rest_can_be_eaten(
    monkeypatch: pytest.MonkeyPatch, margin_mib: float, interval_s: float
) -> None:
    here = AvailableMemory(available=0, total=64 << 30)
    left = AvailableMemory(available=here.floor + round(margin_mib * MIB), total=here.total)
    monkeypatch.setattr(measuring, "available_memory", lambda: left)
    guard = MemoryGuard()
    assert guard.interval_s == 0.25
    assert guard.check({}) is None
    assert guard.interval_s == pytest.approx(interval_s, rel=1e-6)


@pytest.mark.parametrize(("over", "is_stopped"), [(1, False), (0, True), (-1, True)])
def test_a_step_is_stopped_at_the_floor_and_not_above(
    monkeypatch: pytest.MonkeyPatch, over: int, is_stopped: bool
) -> None:
    here = AvailableMemory(available=0, total=64 << 30)
    left = AvailableMemory(available=here.floor + over, total=here.total)
    monkeypatch.setattr(measuring, "available_memory", lambda: left)
    monkeypatch.setattr(measuring, "tree_memory", {1: here.floor, 2: here.floor - 1}.__getitem__)
    found = MemoryGuard().check({"small": 2, "large": 1})
    assert (found is not None) == is_stopped
    if found is not None:
        assert (found.address, found.n_bytes) == ("large", here.floor)
        assert MemoryGuard().check({"small": 2}) is None


def test_kills_of_the_kernel_are_counted(machine: Path) -> None:
    assert measuring.oom_kills() == 0
    write(machine, {"proc/vmstat": "nr_free 4\noom_kill 3\noom_kill_other 9\n"})
    assert measuring.oom_kills() == 3


# --- versions ---


def test_the_processor_is_named_as_the_kernel_does(machine: Path) -> None:
    import platform

    assert environment.cpu_name.__wrapped__() == platform.machine()
    write(machine, {"proc/cpuinfo": "processor : 0\nmodel name\t: Fast: 3 GHz \nmodel name: b\n"})
    assert environment.cpu_name.__wrapped__() == "Fast: 3 GHz"


def test_the_commit_is_that_of_the_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(environment, "__file__", str(tmp_path / "orthoflow/engine/a.py"))
    commit = environment.git_commit.__wrapped__
    assert commit() == ""
    write(tmp_path, {"tracked": "one"})
    own = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
    for arguments in (("init", "-q"), ("add", "tracked"), (*own, "commit", "-qm", "a")):
        subprocess.run(["git", "-C", str(tmp_path), *arguments], check=True)
    clean = commit()
    assert re.fullmatch(r"[0-9a-f]{40}", clean)
    write(tmp_path, {"tracked": "other"})
    assert commit() == f"{clean}+changes"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit() == ""


def test_the_id_of_an_environment_is_a_digest_of_all_of_it() -> None:
    one, two = environment.environment(1), environment.environment(2)
    assert re.fullmatch(r"sha256:[0-9a-f]{64}", one.id)
    assert one.id != two.id
    assert one == environment.environment(1)
    assert (one.threads, two.threads, one.cores) == (1, 2, os.cpu_count())
    assert list(one.packages) == sorted(one.packages, key=str.lower)


def test_the_first_of_two_distributions_of_a_name_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    texts = (
        {"METADATA": "Metadata-Version: 2.1\nName: b\nLicense: one\n  Name: c\nVersion: 1\n"},
        {"PKG-INFO": "version: 2\nname:A\nName: c\n\nText: is long\n"},
        {"METADATA": "Name: b\nVersion: 3\n"},
        {"METADATA": "Version: 4\n\nName: behind\n"},
        {"": "Name: \nVersion: 5\n", "METADATA": ""},
        {},
        {"": "Name: d\nVersion: 6\n"},
    )
    found = [SimpleNamespace(read_text=text.get) for text in texts]
    monkeypatch.setattr(metadata, "distributions", lambda: found)
    told = environment.packages.__wrapped__()
    assert list(told.items()) == [("A", "2"), ("b", "1"), ("d", "6")]


# --- digests of files ---


@pytest.mark.parametrize(("age_ns", "is_kept"), [(2_000_000_000, False), (2_000_000_001, True)])
def test_digests_of_files_that_may_still_change_are_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, age_ns: int, *, is_kept: bool
) -> None:
    path, memo = tmp_path / "scan", tmp_path / "memo"
    path.write_bytes(b"abc")
    now_ns = path.stat().st_mtime_ns + age_ns
    monkeypatch.setattr(time, "time_ns", lambda: now_ns)
    digests = FileDigests(memo)
    found = digests.digest(path)
    assert (found.name, found.size_bytes) == ("scan", 3)
    assert found.sha256 == hashlib.sha256(b"abc").hexdigest()
    assert found.identity == file_digests.file_identity(path)
    digests.save()
    assert memo.exists() == is_kept
    if is_kept:
        written = memo.stat()
        # Known already: nothing new is kept, and the file is not read again.
        monkeypatch.setattr(file_digests, "file_sha256", lambda path: "not read")
        for again in (digests, FileDigests(memo)):
            assert again.digest(path) == found
            again.save()
        assert memo.stat() == written


def test_a_file_that_changes_while_it_is_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "scan"
    path.write_bytes(b"abc")

    def read(path: Path) -> str:
        path.write_bytes(b"abcd")
        return "0" * 64

    monkeypatch.setattr(file_digests, "file_sha256", read)
    with pytest.raises(InputError, match="scan changed while it was read; run again"):
        FileDigests(tmp_path / "memo").digest(path)


# --- hours ---


def test_hours_are_written_in_utc() -> None:
    assert environment.time_of_file(1_000_000_000.75) == "2001-09-09T01:46:40Z"
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", environment.now())
    assert re.fullmatch(r"\d{8}-\d{6}", environment.time_in_a_name())


# --- locks ---


def test_a_lock_is_shared_by_many_or_held_by_one(tmp_path: Path) -> None:
    path = tmp_path / "a" / "lock"
    assert not is_locked(path)
    before = os.umask(0o022)
    try:
        with shared_lock(path), shared_lock(path):
            assert path.stat().st_mode & 0o777 == 0o644
            assert is_locked(path)
            with (
                pytest.raises(StoreError, match=r"^it is busy$"),
                exclusive_lock(path, "it is busy"),
            ):
                pass
    finally:
        os.umask(before)
    assert not is_locked(path)
    with exclusive_lock(path, "busy"):
        assert is_locked(path)
    assert not is_locked(path)


def test_a_file_system_without_locks_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import fcntl

    def refuse(descriptor: int, mode: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    path = tmp_path / "lock"
    with pytest.raises(StoreError) as caught, shared_lock(path):
        pass
    assert str(caught.value) == (
        f"cannot lock {path}: No locks available; the store must lie on a file system with locks"
    )


# --- disks ---


@pytest.mark.parametrize(
    "number",
    [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EIO, errno.EBADMSG],
    ids=errno.errorcode.get,
)
def test_what_the_disk_refuses_names_the_folder_and_keeps_its_number(number: int) -> None:
    here, said = Path("/here"), r"^cannot write to /here: "
    with pytest.raises(StoreError, match=said) as caught, writing_to(here):
        raise OSError(number, "as the kernel says")
    assert caught.value.errno == number
    is_known = "as the kernel says" not in str(caught.value)
    assert is_known == (number != errno.EBADMSG)


def test_an_error_without_a_number_is_told_in_its_own_words() -> None:
    assert str(store_error(OSError("odd"), Path("/here"))) == "cannot write to /here: odd"
    with pytest.raises(StoreError, match=r"^mine$"), writing_to(Path("/here")):
        raise StoreError("mine")


def test_a_file_that_cannot_be_placed_leaves_nothing_beside_it(tmp_path: Path) -> None:
    (tmp_path / "a" / "full").mkdir(parents=True)
    (tmp_path / "a" / "full" / "of.it").touch()
    with pytest.raises(StoreError, match=r"^cannot write to "):
        write_whole(tmp_path / "a" / "full", b"new")
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["full"]
    # As long as a name may be: the one aside is no longer.
    long = tmp_path / ("x" * 255)
    write_whole(long, b"one")
    write_whole(long, b"two")
    assert long.read_bytes() == b"two"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "x" * 255]


def test_the_first_of_two_folders_stays(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write(tmp_path / name, {"who": name, "more": "12345"})
    final = tmp_path / "deep" / "er" / "final"
    assert place_folder(tmp_path / "one", final)
    assert not place_folder(tmp_path / "two", final)
    assert (final / "who").read_text() == "one"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["deep"]
    assert folder_size(tmp_path) == 8
    assert folder_size(tmp_path / "gone") == 0
    with pytest.raises(StoreError, match=r"^cannot write to "):
        place_folder(final, final / "inside")
    assert (final / "who").read_text() == "one"


def test_a_whole_folder_takes_the_place_of_an_empty_one_only(tmp_path: Path) -> None:
    final = tmp_path / "made"
    final.mkdir()
    with whole_folder(final) as aside:
        aside.mkdir()
        (aside / "a").write_text("one")
    assert (final / "a").read_text() == "one"

    def make_another() -> None:
        with whole_folder(final) as aside:
            aside.mkdir()
            (aside / "a").write_text("other")

    with pytest.raises(StoreError, match="cannot write to"):
        make_another()
    assert (final / "a").read_text() == "one"
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


def test_a_folder_is_as_large_as_its_files_and_a_link_is_itself(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "a").write_bytes(b"x" * 700)
    (tmp_path / "deep" / "b").write_bytes(b"x" * 40)
    assert (size_of(tmp_path / "a"), size_of(tmp_path / "deep"), size_of(tmp_path)) == (
        *(700, 40, 740),
    )
    for name, target in (("to a", "a"), ("to deep", "deep")):
        (tmp_path / name).symlink_to(target)
        assert size_of(tmp_path / name) == len(target)


@pytest.mark.parametrize(
    ("number", "name", "broken"),
    [
        (errno.EIO, None, True),
        (errno.EIO, 7, True),
        (errno.EROFS, "/store/objects/x", True),
        (errno.EROFS, b"/store/objects/x", True),
        (errno.EIO, "/elsewhere/x", False),
        (errno.ENOSPC, "/store/x", False),
    ],
    ids=["nameless", "a descriptor", "text", "bytes", "elsewhere", "full"],
)
def test_a_disk_is_broken_where_it_fails_in_a_folder(
    number: int, name: str | bytes | int | None, broken: bool
) -> None:
    assert is_broken(OSError(number, "why", name), Path("/store")) is broken


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
