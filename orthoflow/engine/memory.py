"""How much memory processes take, how much is left, and which step goes when too little is."""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from orthoflow.engine.process_trees import descendants
from orthoflow.geometry.threads import start_beside

MIB: Final = 1 << 20
GIB: Final = 1 << 30
_SAMPLE_S: Final = 0.05
_CGROUPS: Final = Path("/sys/fs/cgroup")
# Version 1 says "unlimited" with a number near 2**63.
_UNLIMITED: Final = 1 << 60
# A process can touch fresh memory at about this rate; the next look must come before the floor.
_FASTEST_BYTES_PER_S: Final = 6 * GIB
_SHORTEST_S: Final = 0.01
_LONGEST_S: Final = 0.25


@dataclass(frozen=True, kw_only=True)
class ProcessMemory:
    """Memory of one process in bytes.

    Attributes:
        anonymous: its own memory; mapped files do not count.
        files: resident parts of mapped files.
        peak_resident: largest sum of both so far.
    """

    anonymous: int
    files: int
    peak_resident: int


def process_memory(process_id: int | str = "self") -> ProcessMemory | None:
    """Measure a process; None when it is gone."""
    try:
        text = Path(f"/proc/{process_id}/status").read_text(encoding="utf-8")
    except OSError:
        return None
    fields = _fields(text)
    return ProcessMemory(
        anonymous=fields.get("RssAnon", 0) + fields.get("RssShmem", 0),
        files=fields.get("RssFile", 0),
        peak_resident=fields.get("VmHWM", 0),
    )


def tree_memory(root: int) -> int:
    """Anonymous memory of a process and of all that it started, in bytes."""
    memories = (process_memory(process) for process in (root, *descendants(root)))
    return sum(memory.anonymous for memory in memories if memory)


@dataclass(frozen=True, kw_only=True)
class AvailableMemory:
    """Bytes that processes here can still get, and bytes there are in all."""

    available: int
    total: int

    @property
    def floor(self) -> int:
        """Below this the machine starts to fail at random: 512 MiB or 3 % of all."""
        return min(max(512 * MIB, self.total * 3 // 100), self.total // 8)


def available_memory() -> AvailableMemory:
    """Measure the machine and every control group that this process is in."""
    fields = _fields(Path("/proc/meminfo").read_text(encoding="utf-8"))
    total, available = fields["MemTotal"], fields["MemAvailable"]
    for limit, used in _group_limits():
        total = min(total, limit)
        available = min(available, limit - used)
    return AvailableMemory(available=max(0, available), total=total)


class MemorySampler:
    """Samples this process's memory in a thread while a method runs.

    Attributes:
        peak_mib: largest own memory; at least what the kernel's high-water mark proves.
        processor_s: processor seconds that the samples took so far. They grow with the clock, so a
            step that compiles for minutes would seem to compute longer.
    """

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._peak_anonymous = 0
        self._peak_files = 0
        self._peak_resident = 0
        self._earlier_peak = 0
        self.processor_s = 0.0

    def __enter__(self) -> Self:
        self._note()
        self._earlier_peak = self._peak_resident
        self._thread = start_beside(self._sample)
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        self._note()

    @property
    def peak_mib(self) -> float:
        """Largest own memory in MiB.

        Between two samples the kernel's mark of all resident memory less the largest part that
        mapped files ever took is a lower bound; of a process in which other steps ran before, where
        the mark rose.
        """
        has_risen = self._peak_resident > self._earlier_peak
        proven = self._peak_resident - self._peak_files if has_risen else 0
        return round(max(self._peak_anonymous, proven) / MIB, 1)

    def _sample(self) -> None:
        while not self._stop.wait(_SAMPLE_S):
            self._note()
            self.processor_s = time.thread_time()

    def _note(self) -> None:
        memory = process_memory()
        if memory is not None:
            self._peak_anonymous = max(self._peak_anonymous, memory.anonymous)
            self._peak_files = max(self._peak_files, memory.files)
            self._peak_resident = max(self._peak_resident, memory.peak_resident)


def _fields(text: str) -> dict[str, int]:
    """Read `Name:   123 kB` lines as bytes."""
    fields: dict[str, int] = {}
    for line in text.splitlines():
        name, _, value = line.partition(":")
        words = value.split()
        if len(words) == 2 and words[1] == "kB":
            fields[name] = int(words[0]) * 1024
    return fields


def _group_limits() -> list[tuple[int, int]]:
    """(limit, used) of this process's memory control groups and their parents, in bytes."""
    try:
        lines = Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    found: list[tuple[int, int]] = []
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            found += _limits_upwards(_CGROUPS, path, _V2)
        elif "memory" in controllers.split(","):
            found += _limits_upwards(_CGROUPS / "memory", path, _V1)
    return found


_V1: Final = {
    "limit": "memory.limit_in_bytes",
    "used": "memory.usage_in_bytes",
    "cache": "total_inactive_file",
}
_V2: Final = {"limit": "memory.max", "used": "memory.current", "cache": "inactive_file"}


def _limits_upwards(root: Path, path: str, names: Mapping[str, str]) -> list[tuple[int, int]]:
    folder = root / path.lstrip("/")
    found: list[tuple[int, int]] = []
    # Inside a container the path may be the host's; the container's own group is then the root.
    for level in [folder, *folder.parents]:
        if not level.is_relative_to(root):
            break
        limit = _number(level / names["limit"])
        used = _number(level / names["used"])
        if limit is not None and used is not None and limit < _UNLIMITED:
            found.append((limit, used - _reclaimable(level, names["cache"])))
    return found


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def _reclaimable(folder: Path, name: str) -> int:
    try:
        lines = (folder / "memory.stat").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) for line in lines if line.split()[0] == name)


@dataclass(frozen=True, kw_only=True)
class Victim:
    """The step to stop, and the memory it holds."""

    address: str
    n_bytes: int


class MemoryGuard:
    """Watches the memory that is left while steps run.

    Attributes:
        interval_s: when to look again at the latest.
    """

    def __init__(self) -> None:
        self.interval_s = _LONGEST_S

    def check(self, roots: Mapping[str, int]) -> Victim | None:
        """Choose a step to stop when too little memory is left.

        Args:
            roots: name -> process above all others of every running step.
        """
        memory = available_memory()
        margin = memory.available - memory.floor
        self.interval_s = min(max(margin / _FASTEST_BYTES_PER_S, _SHORTEST_S), _LONGEST_S)
        if margin > 0 or not roots:
            return None
        held = {address: tree_memory(root) for address, root in roots.items()}
        largest = max(held, key=lambda address: held[address])
        # Somebody else may be eating: a small step would be killed for nothing.
        if held[largest] < memory.floor:
            return None
        return Victim(address=largest, n_bytes=held[largest])


def oom_kills() -> int:
    """How often the kernel has killed for want of memory since it started."""
    try:
        lines = Path("/proc/vmstat").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) for line in lines if line.startswith("oom_kill "))


def is_for_want_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory ran out, also while a library or a thread was started.

    The loader and threads tell that in words only.
    """
    if isinstance(error, ImportError):
        return "failed to map segment" in str(error) or "allocate memory" in str(error)
    if isinstance(error, RuntimeError) and "can't start new thread" in str(error):
        return True
    return isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM
