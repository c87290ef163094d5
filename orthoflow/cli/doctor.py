"""`orthoflow doctor`: show what is installed, what is missing, and the consequences."""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Final, Literal

import click

from orthoflow.catalog.distributions import direct_requirements
from orthoflow.cli.commands import (
    EXIT_GOOD,
    EXIT_PLUGIN_MISSING,
    Command,
    json_option,
    store_option,
)
from orthoflow.cli.tables import counted, echo, echo_json, echo_table, size
from orthoflow.geometry.threads import usable_cores
from orthoflow.version import DISTRIBUTION, __version__

_IMPORT_TIMEOUT_S: Final = 120
_MIN_DISK_BYTES: Final = 5 * 1024**3
_MIN_MEMORY_BYTES: Final = 2 * 1024**3

# No command works without these distributions.
_CORE: Final = frozenset(
    {"click", "h5py", "jinja2", "networkx", "numpy", "pluggy", "pydantic", "rich", "ruamel-yaml"}
)
# Distribution -> module, where the names differ.
_MODULES: Final[Mapping[str, str]] = {
    "fonttools": "fontTools",
    "open3d-cpu": "open3d",
    "opencv-python-headless": "cv2",
    "pillow": "PIL",
    "ruamel-yaml": "ruamel.yaml",
}
# Part of the message of a failed import -> missing system package.
_SYSTEM_PACKAGES: Final = {
    "libGL.so": "libgl1",
    "libX11.so": "libx11-6",
    "libusb": "libusb-1.0-0",
    "libgomp": "libgomp1",
}
# The wheel of open3d needs libusb-1.0.so.0, which the distribution libusb-package contains. Loading
# this library globally makes it available to open3d.
_OPEN3D_PRELUDE: Final = """
import ctypes
try:
    import libusb_package
    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
except (ImportError, OSError, TypeError):
    pass
"""


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Attributes:
        name: name of the checked item.
        verdict: ok, limited (works with a restriction) or missing.
        found: version, size or setting.
        cost: consequence and remedy; empty if the verdict is ok.
        core: whether orthoflow requires the item.
    """

    name: str
    verdict: Literal["ok", "limited", "missing"]
    found: str
    cost: str = ""
    core: bool = False


@click.command(cls=Command)
@store_option
@json_option
def doctor(store: Path, *, as_json: bool) -> int:
    """Show what is installed, what is missing, and the consequences.

    The exit code is 4 if something essential is missing.
    """
    # Each library is imported in a process of its own, because it may crash.
    with ThreadPoolExecutor(max_workers=max(2, os.cpu_count() or 1)) as pool:
        libraries = list(pool.map(_library, required_libraries()))
    findings = [*_machine(), *_store(store), *libraries, *_plugins()]
    is_broken = any(item.core and item.verdict == "missing" for item in findings)
    if as_json:
        listed = [asdict(item) for item in findings]
        echo_json({"version": __version__, "ok": not is_broken, "findings": listed})
    else:
        _print(findings, is_broken=is_broken)
    return EXIT_PLUGIN_MISSING if is_broken else EXIT_GOOD


def _print(findings: list[Finding], *, is_broken: bool) -> None:
    echo(f"orthoflow {__version__}", "")
    rows = [(item.name, item.verdict, item.found) for item in findings]
    echo_table(("what", "verdict", "found"), rows)
    costs = [f"- {item.name}: {item.cost}" for item in findings if item.cost]
    if costs:
        echo("", "Consequences:", *costs)
    restricted = f"orthoflow works with {counted(len(costs), 'restriction')}"
    echo("", "a required part is missing" if is_broken else restricted)


def required_libraries() -> list[str]:
    """Return the names of the libraries that orthoflow requires."""
    # On Linux, open3d is provided by open3d-cpu.
    return sorted((direct_requirements(DISTRIBUTION) or frozenset()) - {"open3d"})


def _library(name: str) -> Finding:
    core = name in _CORE
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        cost = f"methods that need it do not work (pip install {name})"
        return Finding(name, "missing", "not installed", cost, core)
    problem = _import_problem(_MODULES.get(name, name.replace("-", "_")))
    if not problem:
        return Finding(name, "ok", version, core=core)
    lacking = [package for part, package in _SYSTEM_PACKAGES.items() if part in problem]
    remedy = f"apt-get install {lacking[0]}" if lacking else "reinstall it"
    cost = f"methods that need it do not work ({remedy})"
    return Finding(name, "missing", f"{version}, but {problem}", cost, core)


def _import_problem(module: str) -> str:
    prelude = _OPEN3D_PRELUDE if module == "open3d" else ""
    command = [sys.executable, "-c", f"{prelude}\nimport {module}"]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_IMPORT_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return f"importing it takes longer than {_IMPORT_TIMEOUT_S} s"
    if done.returncode < 0:
        return f"importing it crashes (signal {-done.returncode})"
    lines = done.stderr.strip().splitlines() or ["no message"]
    return f"importing it fails: {lines[-1]}" if done.returncode else ""


def _machine() -> Iterator[Finding]:
    found = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    if (platform.system(), platform.machine()) == ("Linux", "x86_64"):
        yield Finding("platform", "ok", found)
    else:
        yield Finding("platform", "limited", found, "only Linux on x86-64 is tested")
    yield Finding("cores", "ok", str(usable_cores()))
    # A missing library is reported with the others; without /proc, the memory is unknown.
    with contextlib.suppress(ImportError, OSError):
        import psutil

        cost = "scans with many millions of points will not fit"
        yield _enough("memory", psutil.virtual_memory().available, _MIN_MEMORY_BYTES, cost)


def _enough(name: str, n_bytes: int, min_bytes: int, cost: str) -> Finding:
    is_enough = n_bytes >= min_bytes
    verdict: Literal["ok", "limited"] = "ok" if is_enough else "limited"
    return Finding(name, verdict, f"{size(n_bytes)} free", "" if is_enough else cost)


def _store(store: Path) -> Iterator[Finding]:
    places = (store.absolute(), *store.absolute().parents)
    folder = next(place for place in places if place.is_dir())
    free = shutil.disk_usage(folder).free
    cost = "long runs may fill it (free space with `orthoflow cache gc`, or set --store DIR)"
    yield _enough("disk of the store", free, _MIN_DISK_BYTES, cost)
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"x")
    except OSError as error:
        problem = f"cannot write to {folder}: {(error.strerror or str(error)).lower()}"
        cost = "no run can start here (choose another folder with --store DIR)"
        yield Finding("store", "missing", problem, cost, core=True)
    else:
        yield Finding("store", "ok", f"{store} is writable", core=True)


def _plugins() -> Iterator[Finding]:
    try:
        from orthoflow.catalog.catalog import DISABLED
        from orthoflow.catalog.discovery import discover_catalog

        catalog = discover_catalog()
    except ImportError as error:
        cost = "no methods can be found; install the missing parts"
        yield Finding("plugins", "missing", str(error), cost)
        return
    yield Finding("plugins", "ok", counted(len(catalog.methods), "method"))
    for broken in catalog.broken:
        cost = f"its methods are missing: {broken.error}"
        name = f"plugin {broken.entry_point}"
        yield Finding(name, "missing", f"{broken.distribution} cannot be loaded", cost)
    for name in catalog.disabled:
        cost = f"its methods are missing: the plugin is disabled by {DISABLED}"
        yield Finding(f"plugin {name}", "limited", "disabled", cost)
    looked_at = [entry.looked_at() for entry in catalog.methods.values()]
    entries = (*catalog.products.values(), *catalog.kinds.values(), *looked_at)
    for problem in dict.fromkeys(entry.problem for entry in entries if entry.problem):
        yield Finding("plugins", "limited", "not usable in its current state", problem)
