"""How much memory processes take, how much is left, and which step goes when too little is."""

from __future__ import annotations

import errno
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import psutil

MIB: Final = 1 << 20
GIB: Final = 1 << 30
_CGROUPS: Final = Path("/sys/fs/cgroup")
# Version 1 says "unlimited" with a number near 2**63.
_UNLIMITED: Final = 1 << 60
# A process can touch fresh memory at about this rate; the next look must come before the floor.
_FASTEST_BYTES_PER_S: Final = 6 * GIB
_SHORTEST_S: Final = 0.01
_LONGEST_S: Final = 0.25


def process_memory(process_id: int | None = None) -> int:
    """Bytes that a process, this one by default, made itself; 0 when it is gone.

    Mapped files do not count: they can be read again.
    """
    try:
        memory = psutil.Process(process_id).memory_info()
    except psutil.Error:
        return 0
    return int(memory.rss - getattr(memory, "shared", 0))


def tree_memory(root: int) -> int:
    """Bytes that a process and all that it started made themselves."""
    try:
        children = psutil.Process(root).children(recursive=True)
    except psutil.Error:
        return 0
    return sum(process_memory(process) for process in (root, *(one.pid for one in children)))


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
    memory = psutil.virtual_memory()
    total, available = memory.total, memory.available
    for limit, used in _group_limits():
        total = min(total, limit)
        available = min(available, limit - used)
    return AvailableMemory(available=max(0, available), total=total)


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
