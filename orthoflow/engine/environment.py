"""Software versions, processor and time of a run, without names of users, hosts or folders."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Final

from orthoflow.engine.results import RecordedEnvironment, canonical_json

_GIT_TIMEOUT_S: Final = 10.0


def environment(threads: int) -> RecordedEnvironment:
    """Describe this machine and installation for a record.

    Args:
        threads: number of threads of the cell.
    """
    unnamed = RecordedEnvironment(
        id="",
        python=platform.python_version(),
        os=f"{platform.system()} {platform.release()}",
        cpu=cpu_name(),
        cores=os.cpu_count() or 1,
        threads=threads,
        git_commit=git_commit(),
        packages=packages(),
    )
    content = {name: value for name, value in asdict(unnamed).items() if name != "id"}
    digest = hashlib.sha256(canonical_json(content).encode()).hexdigest()
    return replace(unnamed, id=f"sha256:{digest}")


@cache
def packages() -> dict[str, str]:
    """Return name -> version of installed distributions.

    If a distribution is installed twice, the first one on the search path counts.
    """
    found: dict[str, str] = {}
    for distribution in metadata.distributions():
        # Skip metadata that is not valid text, or lacks a name or version.
        with suppress(ValueError, KeyError):
            stated = distribution.metadata
            if stated["Name"] and stated["Version"]:
                found.setdefault(stated["Name"], stated["Version"])
    return dict(sorted(found.items(), key=lambda item: item[0].lower()))


@cache
def cpu_name() -> str:
    """Return the model name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


@cache
def git_commit() -> str:
    """Return the commit of orthoflow's checkout, followed by `+changes` if the code is modified."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return ""
    commit = _git(root, "rev-parse", "HEAD")
    changes = _git(root, "status", "--porcelain", "--untracked-files=no")
    return f"{commit}+changes" if commit and changes else commit


def _git(root: Path, *arguments: str) -> str:
    try:
        finished = subprocess.run(
            ["git", "-C", str(root), *arguments],
            capture_output=True,
            text=True,
            check=False,
            timeout=_GIT_TIMEOUT_S,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return finished.stdout.strip() if finished.returncode == 0 else ""


def now() -> str:
    """Return the current time in UTC as ISO 8601, to the millisecond."""
    return _written(datetime.now(UTC), "milliseconds")


def time_of_file(mtime_s: float) -> str:
    """Convert a file time in seconds since 1970 to ISO 8601 in UTC, to the second."""
    return _written(datetime.fromtimestamp(mtime_s, tz=UTC), "seconds")


def time_in_a_name() -> str:
    """Return the current time in UTC as digits that sort by time, for use in file names."""
    return f"{datetime.now(UTC):%Y%m%d-%H%M%S}"


def _written(time: datetime, to: str) -> str:
    return time.isoformat(timespec=to).replace("+00:00", "Z")
