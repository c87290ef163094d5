"""`orthoflow doctor`: show what is installed, what is missing, and the consequences."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Final, Literal

import click

from orthoflow.cli.commands import (
    EXIT_GOOD,
    EXIT_PLUGIN_MISSING,
    Command,
    json_option,
    store_option,
)
from orthoflow.cli.tables import counted, echo, echo_json, echo_table
from orthoflow.geometry.threads import usable_cores
from orthoflow.version import __version__

_IMPORT_TIMEOUT_S: Final = 120
_COMFORTABLE_DISK_BYTES: Final = 5 * 1024**3
_COMFORTABLE_MEMORY_BYTES: Final = 2 * 1024**3

_EVERYTHING: Final = "everything"
# Distribution on the package index -> imported module, and features that need it.
LIBRARIES: Final[Mapping[str, tuple[str, str]]] = {
    "click": ("click", _EVERYTHING),
    "h5py": ("h5py", _EVERYTHING),
    "jinja2": ("jinja2", "the report"),
    "networkx": ("networkx", _EVERYTHING),
    "numpy": ("numpy", _EVERYTHING),
    "pluggy": ("pluggy", _EVERYTHING),
    "pydantic": ("pydantic", _EVERYTHING),
    "rich": ("rich", "live progress"),
    "ruamel.yaml": ("ruamel.yaml", _EVERYTHING),
    "numba": ("numba", "methods of simulate, plane, raster, ortho and inspect"),
    "scipy": ("scipy", "methods of plane and inspect"),
    "opencv-python-headless": ("cv2", "photos, previews: simulate.room, raster and ortho"),
    "rasterio": ("rasterio", "GeoTIFF files: raster and mosaic"),
    "laspy": ("laspy", "LAS and LAZ files: read.scan, --to laz"),
    "lazrs": ("lazrs", "compressed LAZ files: read.scan, --to laz"),
    "pye57": ("pye57", "E57 files: read.scan, --to e57"),
    "pyproj": ("pyproj", "coordinate systems: read.scan, cameras of Metashape"),
    "plyfile": ("plyfile", "PLY files with list properties: read.scan"),
    "pandas": ("pandas", "point clouds as text files: read.scan"),
    "pillow": ("PIL", "EXIF data of photos: read.photos, ortho"),
    "simplejpeg": ("simplejpeg", "detection of damaged JPEG files: read.photos"),
    "psutil": ("psutil", "free memory: methods of raster"),
    "threadpoolctl": ("threadpoolctl", "number of cores per step"),
    "matplotlib": ("matplotlib", "methods of plane, for drawing plans"),
    "mahotas": ("mahotas", "inspection by SURF features"),
    "pycolmap": ("pycolmap", "bundle adjustment"),
    "pyceres": ("pyceres", "bundle adjustment"),
    "libusb-package": ("libusb_package", "open3d on machines without libusb-1.0"),
    "open3d-cpu": ("open3d", "comparators of open3d; the default methods work without it"),
    "fonttools": ("fontTools", "system fonts in sheets"),
    "ezdxf": ("ezdxf", "CAD drawings: --to dxf"),
    "prov": ("prov", "PROV documents: --to prov"),
    "reportlab": ("reportlab", "sheets: --to sheet"),
    "cryptography": ("cryptography", "signatures of records: sign, verify --signer"),
    "distributed": ("distributed", "clusters: --executor dask"),
}
_CORE: Final = frozenset(
    (*(name for name, (_, use) in LIBRARIES.items() if use == _EVERYTHING), "jinja2", "rich")
)
# Optional packages, with the extras that `pip install` needs.
_EXTRAS: Final = {"cryptography": "cryptography[ssh]", "distributed": "distributed"}
# Part of the message of a failed import -> missing system package.
_SYSTEM_PACKAGES: Final = {
    "libGL.so": "libgl1",
    "libX11.so": "libx11-6",
    "libusb": "libusb-1.0-0",
    "libgomp": "libgomp1",
}
# The wheel of open3d needs libusb-1.0.so.0, which libusb-package contains; loading it globally
# makes it available to open3d.
_OPEN3D_PRELUDE: Final = """
import ctypes
try:
    import libusb_package
    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
except (ImportError, OSError, TypeError):
    pass
"""

Verdict = Literal["ok", "limited", "missing"]


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Attributes:
        name: name of the checked item.
        verdict: ok, limited (works with a restriction) or missing.
        found: version, size or setting.
        cost: consequence and remedy; empty if ok.
        use: features that need it, for libraries.
        is_core: whether orthoflow cannot work without it.
    """

    name: str
    verdict: Verdict
    found: str
    cost: str = ""
    use: str = ""
    is_core: bool = False


@click.command(cls=Command)
@store_option
@json_option
def doctor(store: Path, *, as_json: bool) -> int:
    """Show what is installed, what is missing, and the consequences.

    The exit code is 4 if something essential is missing.
    """
    # A broken library may crash the process that imports it.
    with ThreadPoolExecutor(max_workers=max(2, os.cpu_count() or 1)) as pool:
        libraries = list(pool.map(_library, LIBRARIES))
    findings = [*_machine(), *_store(store), *libraries, *_plugins()]
    is_broken = any(item.is_core and item.verdict == "missing" for item in findings)
    if as_json:
        # Same names as the columns of the table.
        keys = {"use": "for", "is_core": "core"}
        listed = [
            {keys.get(name, name): value for name, value in vars(item).items()} for item in findings
        ]
        echo_json({"version": __version__, "ok": not is_broken, "findings": listed})
    else:
        _print(findings, is_broken=is_broken)
    return EXIT_PLUGIN_MISSING if is_broken else EXIT_GOOD


def _print(findings: list[Finding], *, is_broken: bool) -> None:
    echo(f"orthoflow {__version__}", "")
    echo_table(
        ("what", "verdict", "found", "for"),
        [(item.name, item.verdict, item.found, item.use) for item in findings],
    )
    costs = [f"- {item.name}: {item.cost}" for item in findings if item.cost]
    if costs:
        echo("", "Consequences:", *costs)
    if is_broken:
        echo("", "a required library is missing")
    elif costs:
        echo("", f"orthoflow works, with {counted(len(costs), 'restriction')}")
    else:
        echo("", "everything works")


def _library(name: str) -> Finding:
    module, use = LIBRARIES[name]
    is_core = name in _CORE
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        version = ""
    problem = _import_problem(module)
    if not problem:
        return Finding(name, "ok", version or "present", use=use, is_core=is_core)
    if version:
        lacks = (package for part, package in _SYSTEM_PACKAGES.items() if part in problem)
        package = next(lacks, "")
        way_out = f"apt-get install {package}" if package else "reinstall it"
        found = f"{version}, but {problem}"
    else:
        wanted = _EXTRAS.get(name, name)
        way_out = f"pip install '{wanted}'" if "[" in wanted else f"pip install {wanted}"
        found = "not installed"
    verdict: Verdict = "limited" if name in _EXTRAS and not version else "missing"
    return Finding(name, verdict, found, f"not available: {use} ({way_out})", use, is_core)


def _import_problem(module: str) -> str:
    prelude = _OPEN3D_PRELUDE if module == "open3d" else ""
    command = [sys.executable, "-c", f"{prelude}\nimport {module}"]
    try:
        done = subprocess.run(command, capture_output=True, timeout=_IMPORT_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return f"importing it takes longer than {_IMPORT_TIMEOUT_S} s"
    if done.returncode == 0:
        return ""
    if done.returncode < 0:
        return f"importing it crashes (signal {-done.returncode})"
    lines = done.stderr.decode(errors="replace").split("\n")
    return (
        f"importing it fails: {next(filter(None, map(str.strip, reversed(lines))), 'no message')}"
    )


def _machine() -> Iterator[Finding]:
    found = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    if (platform.system(), platform.machine()) == ("Linux", "x86_64"):
        yield Finding("platform", "ok", found)
    else:
        yield Finding("platform", "limited", found, "only Linux on x86-64 is tested")
    yield Finding("cores", "ok", str(usable_cores()))
    try:
        import psutil

        n_bytes = psutil.virtual_memory().available
    except (ImportError, OSError):
        # A missing library is reported separately.
        yield Finding("memory", "limited", "unknown", "cannot be measured")
        return
    cost = "scans with many millions of points will not fit"
    yield _enough("memory", n_bytes, _COMFORTABLE_MEMORY_BYTES, "available", cost)


def _enough(name: str, n_bytes: int, comfortable_bytes: int, found: str, cost: str) -> Finding:
    """Return the finding on whether there is enough of a resource."""
    text = f"{n_bytes / 1024**3:.1f} GiB {found}"
    return (
        Finding(name, "ok", text)
        if n_bytes >= comfortable_bytes
        else Finding(name, "limited", text, cost)
    )


def _store(store: Path) -> Iterator[Finding]:
    places = (store.absolute(), *store.absolute().parents)
    folder = next(place for place in places if place.is_dir())
    free = shutil.disk_usage(folder).free
    cost = "long runs may fill it (orthoflow cache gc, or --store DIR)"
    yield _enough("disk of the store", free, _COMFORTABLE_DISK_BYTES, "free", cost)
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"x")
    except OSError as error:
        problem = f"{folder} cannot be written: {(error.strerror or str(error)).lower()}"
        cost = "no run can start here (choose another folder with --store DIR)"
        yield Finding("store", "missing", problem, cost, is_core=True)
    else:
        yield Finding("store", "ok", f"{store} is writable", is_core=True)


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
        cost = f"its methods are missing: it is disabled by {DISABLED}"
        yield Finding(f"plugin {name}", "limited", "switched off", cost)
    looked_at = [entry.looked_at() for entry in catalog.methods.values()]
    entries = (*catalog.products.values(), *catalog.kinds.values(), *looked_at)
    for problem in dict.fromkeys(entry.problem for entry in entries if entry.problem):
        yield Finding("plugins", "limited", "not usable in its current state", problem)
