"""Memory settings of test processes: memory of arrays is kept for the next ones.

Asking the system for each anew took 6 % of the processor time of tests of methods. The C library
reads it when a process starts: it stands in the environment of who is to have it, nowhere else.
"""

from __future__ import annotations

from typing import Final

KEPT_MEMORY: Final = {
    "MALLOC_MMAP_THRESHOLD_": str(1 << 30),
    "MALLOC_TRIM_THRESHOLD_": str(1 << 32),
}
