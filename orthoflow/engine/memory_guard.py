"""Stops the largest step before the machine runs out of memory and kills at random."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.engine.memory import GIB, available_memory, group_memory

# A process can touch fresh memory at about this rate; the next look must come before the floor.
_FASTEST_BYTES_PER_S: Final = 6 * GIB
_SHORTEST_S: Final = 0.01
_LONGEST_S: Final = 0.25


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

    def check(self, groups: Mapping[str, int]) -> Victim | None:
        """Choose a step to stop when too little memory is left.

        Args:
            groups: address -> process group of every running step.
        """
        memory = available_memory()
        margin = memory.available - memory.floor
        self.interval_s = min(max(margin / _FASTEST_BYTES_PER_S, _SHORTEST_S), _LONGEST_S)
        if margin > 0 or not groups:
            return None
        held = {address: group_memory(group) for address, group in groups.items()}
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
