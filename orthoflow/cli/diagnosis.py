"""What is installed and whether it works: the findings of `orthoflow doctor`."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Final, Literal

from orthoflow.system import usable_cores

_IMPORT_TIMEOUT_S: Final = 120
_COMFORTABLE_DISK_BYTES: Final = 5 * 1024**3
_COMFORTABLE_MEMORY_BYTES: Final = 2 * 1024**3

Verdict = Literal["ok", "limited", "missing"]


@dataclass(frozen=True, kw_only=True)
class Library:
    """A distribution that orthoflow uses.

    Attributes:
        distribution: its name on the package index.
        module: what is imported.
        use: what needs it.
        is_core: nothing works without it.
        extra: by what `pip install` gets it, with the extras of its own that are used; empty
            for a part of a plain installation.
    """

    distribution: str
    module: str
    use: str
    is_core: bool = False
    extra: str = ""


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """One thing that was looked at.

    Attributes:
        name: what was looked at.
        verdict: ok, limited (works, with a restriction) or missing.
        found: version, size or setting.
        use: what needs it, where that is a library.
        cost: what does not work because of it, and the way out; empty when ok.
        is_core: orthoflow cannot work without it.
    """

    name: str
    verdict: Verdict
    found: str
    use: str = ""
    cost: str = ""
    is_core: bool = False


_EVERYTHING: Final = "everything"
LIBRARIES: Final = (
    Library(distribution="click", module="click", use=_EVERYTHING, is_core=True),
    Library(distribution="h5py", module="h5py", use=_EVERYTHING, is_core=True),
    Library(distribution="jinja2", module="jinja2", use="the report", is_core=True),
    Library(distribution="networkx", module="networkx", use=_EVERYTHING, is_core=True),
    Library(distribution="numpy", module="numpy", use=_EVERYTHING, is_core=True),
    Library(distribution="pluggy", module="pluggy", use=_EVERYTHING, is_core=True),
    Library(distribution="pydantic", module="pydantic", use=_EVERYTHING, is_core=True),
    Library(distribution="rich", module="rich", use="live progress", is_core=True),
    Library(distribution="ruamel.yaml", module="ruamel.yaml", use=_EVERYTHING, is_core=True),
    Library(
        distribution="numba",
        module="numba",
        use="methods of simulate, plane, raster, ortho and inspect",
    ),
    Library(distribution="scipy", module="scipy", use="methods of plane and inspect"),
    Library(
        distribution="opencv-python-headless",
        module="cv2",
        use="photographs, filled gaps, previews: simulate.room and the methods of raster and ortho",
    ),
    Library(
        distribution="rasterio",
        module="rasterio",
        use="GeoTIFF files: what raster and mosaic publish",
    ),
    Library(distribution="laspy", module="laspy", use="LAS and LAZ files: read.scan, --to laz"),
    Library(distribution="lazrs", module="lazrs", use="compressed LAZ files: read.scan, --to laz"),
    Library(distribution="pye57", module="pye57", use="E57 files: read.scan, --to e57"),
    Library(
        distribution="pyproj",
        module="pyproj",
        use="coordinate systems: read.scan, cameras of Metashape",
    ),
    Library(distribution="pandas", module="pandas", use="text files of points: read.scan"),
    Library(distribution="pillow", module="PIL", use="EXIF data of photos: read.photos, ortho"),
    Library(
        distribution="simplejpeg", module="simplejpeg", use="damage in JPEG files: read.photos"
    ),
    Library(distribution="psutil", module="psutil", use="free memory: methods of raster"),
    Library(distribution="threadpoolctl", module="threadpoolctl", use="cores of each step"),
    Library(
        distribution="matplotlib",
        module="matplotlib",
        use="methods of plane, which draw their plans with it",
    ),
    Library(distribution="mahotas", module="mahotas", use="inspection by SURF features"),
    Library(distribution="pycolmap", module="pycolmap", use="bundle adjustment"),
    Library(distribution="pyceres", module="pyceres", use="bundle adjustment"),
    Library(
        distribution="libusb-package",
        module="libusb_package",
        use="open3d on machines without libusb-1.0",
    ),
    Library(
        distribution="open3d-cpu",
        module="open3d",
        use="comparators of open3d; the default methods work without it",
    ),
    Library(distribution="fonttools", module="fontTools", use="fonts of the system in sheets"),
    Library(distribution="ezdxf", module="ezdxf", use="CAD drawings: --to dxf"),
    Library(distribution="reportlab", module="reportlab", use="sheets: --to sheet"),
    Library(
        distribution="cryptography",
        module="cryptography",
        use="signatures of records: sign, verify --signer",
        extra="cryptography[ssh]",
    ),
    Library(
        distribution="distributed",
        module="distributed",
        use="clusters: --executor dask",
        extra="distributed",
    ),
)

# The wheel of open3d needs libusb-1.0.so.0, which libusb-package carries: loaded globally, it is
# found when open3d is imported.
_OPEN3D_PRELUDE: Final = """
import ctypes
try:
    import libusb_package
    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
except (ImportError, OSError, TypeError):
    pass
"""


def diagnose_libraries() -> list[Diagnosis]:
    """Import every library in a process of its own, since a broken one can crash its process."""
    with ThreadPoolExecutor(max_workers=max(2, os.cpu_count() or 1)) as pool:
        return list(pool.map(diagnose_library, LIBRARIES))


def diagnose_library(library: Library) -> Diagnosis:
    """State which version of a library is installed and whether it can be imported."""
    try:
        version = metadata.version(library.distribution)
    except metadata.PackageNotFoundError:
        version = ""
    good = Diagnosis(
        name=library.distribution,
        verdict="ok",
        found=version or "present",
        use=library.use,
        is_core=library.is_core,
    )
    problem = _import_problem(library.module)
    if not problem:
        return good
    if version:
        found, way_out = f"{version}, but {problem}", _way_out(problem)
    else:
        wanted = f"'{library.extra}'" if "[" in library.extra else library.distribution
        found, way_out = "not installed", f"pip install {wanted}"
    return replace(
        good,
        verdict="limited" if library.extra and not version else "missing",
        found=found,
        cost=f"not to be had: {library.use} ({way_out})",
    )


def _import_problem(module: str) -> str:
    prelude = _OPEN3D_PRELUDE if module == "open3d" else ""
    try:
        done = subprocess.run(
            [sys.executable, "-c", f"{prelude}\nimport {module}"],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_IMPORT_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"its import takes longer than {_IMPORT_TIMEOUT_S} s"
    if done.returncode == 0:
        return ""
    if done.returncode < 0:
        return f"its import crashes (signal {-done.returncode})"
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    return f"its import fails: {lines[-1] if lines else 'no message'}"


def _way_out(problem: str) -> str:
    packages = {
        "libGL.so": "libgl1",
        "libX11.so": "libx11-6",
        "libusb": "libusb-1.0-0",
        "libgomp": "libgomp1",
    }
    for library, package in packages.items():
        if library in problem:
            return f"install the system package {package}, e.g. apt-get install {package}"
    return "reinstall it"


def diagnose_machine(store: Path) -> Iterator[Diagnosis]:
    """Look at the platform, the cores, the memory, the disk of the store, and its write access."""
    yield _diagnose_platform()
    yield Diagnosis(name="cores", verdict="ok", found=str(usable_cores()))
    yield _diagnose_memory()
    yield from _diagnose_store(store)


def _diagnose_platform() -> Diagnosis:
    found = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    is_supported = platform.system() == "Linux" and platform.machine() == "x86_64"
    return Diagnosis(
        name="platform",
        verdict="ok" if is_supported else "limited",
        found=found,
        cost="" if is_supported else "only Linux on x86-64 is tested",
    )


def _diagnose_memory() -> Diagnosis:
    try:
        from orthoflow.engine.measuring import available_memory

        n_bytes = available_memory().available
    except (ImportError, OSError, KeyError, ValueError):
        # The engine does not load when a core library is missing, which is a finding of its own.
        return Diagnosis(
            name="memory", verdict="limited", found="unknown", cost="cannot be measured"
        )
    is_enough = n_bytes >= _COMFORTABLE_MEMORY_BYTES
    return Diagnosis(
        name="memory",
        verdict="ok" if is_enough else "limited",
        found=f"{n_bytes / 1024**3:.1f} GiB available",
        cost="" if is_enough else "scans of many millions of points will not fit",
    )


def _diagnose_store(store: Path) -> Iterator[Diagnosis]:
    existing = next(
        folder for folder in (store.absolute(), *store.absolute().parents) if folder.is_dir()
    )
    free = shutil.disk_usage(existing).free
    is_enough = free >= _COMFORTABLE_DISK_BYTES
    yield Diagnosis(
        name="disk of the store",
        verdict="ok" if is_enough else "limited",
        found=f"{free / 1024**3:.1f} GiB free",
        cost="" if is_enough else "long runs may fill it (orthoflow cache gc, or --store DIR)",
    )
    problem = _write_problem(existing)
    yield Diagnosis(
        name="store and numba cache",
        verdict="missing" if problem else "ok",
        found=problem or f"{store} is writable",
        cost="no run can start here (choose another folder with --store DIR)" if problem else "",
        is_core=True,
    )


def _write_problem(folder: Path) -> str:
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"x")
    except OSError as error:
        return f"{folder} cannot be written: {(error.strerror or str(error)).lower()}"
    return ""
