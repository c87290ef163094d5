"""Digests of source code, which stand for a version wherever code is not a released install."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path
from typing import Final

from orthoflow.catalog import MethodEntry

_ROOT: Final = Path(__file__).resolve().parents[1]
_DISTRIBUTION: Final = "orthoflow-tls"
# What a method's result can depend on in the framework; engine and command line cannot change it.
_FRAMEWORK_PARTS: Final = ("errors.py", "files", "geometry", "products", "sdk")
_BUILT_IN_PACKAGE: Final = "orthoflow_plugins"


@cache
def is_framework_released() -> bool:
    """Whether the framework came from an index, so that its version stands for its code."""
    try:
        distribution = metadata.distribution(_DISTRIBUTION)
    except metadata.PackageNotFoundError:
        return False
    if distribution.read_text("direct_url.json") is not None:
        return False
    return _ROOT.is_relative_to(Path(str(distribution.locate_file(""))).resolve())


def framework_tag() -> str:
    """What stands for the framework's code: the version of a release, else the digest."""
    if is_framework_released():
        return metadata.version(_DISTRIBUTION)
    return files_digest(framework_files())


@cache
def framework_files() -> tuple[Path, ...]:
    """The framework's code that methods use."""
    parts = [_ROOT / part for part in _FRAMEWORK_PARTS]
    return tuple(
        file for part in parts for file in ([part] if part.is_file() else part.rglob("*.py"))
    )


def plugin_files(entry: MethodEntry) -> tuple[Path, ...]:
    """The code that a method belongs to.

    For the built-in methods that is the package of their kind, since one kind never imports
    another; for all others everything their distribution's packages hold.
    """
    files = entry.source_files()
    module = entry.spec.target.partition(":")[0]
    if not module.startswith(f"{_BUILT_IN_PACKAGE}."):
        return files
    place = f"/{_BUILT_IN_PACKAGE}/{module.split('.')[1]}"
    return tuple(file for file in files if file.as_posix().partition(place)[2][:1] in ("/", "."))


def unreleased_code(entry: MethodEntry) -> dict[str, tuple[Path, ...]]:
    """Files whose content decides a method's results, where no version stands for them."""
    code: dict[str, tuple[Path, ...]] = {}
    if not entry.distribution.is_released:
        code["plugin"] = plugin_files(entry)
    if not is_framework_released():
        code["framework"] = framework_files()
    return code


def compiled_digest(entry: MethodEntry) -> str:
    """Digest of all code whose compiled kernels a method may use, one per plugin."""
    both = files_digest(framework_files()) + files_digest(entry.source_files())
    return hashlib.sha256(both.encode()).hexdigest()


def files_digest(files: Iterable[Path]) -> str:
    """Digest of files with their names; computed once for as long as they stay as they are."""
    stats = ((path, path.stat()) for path in sorted(files))
    return _digest(tuple((path, stat.st_size, stat.st_mtime_ns) for path, stat in stats))


@lru_cache(maxsize=256)
def _digest(files: tuple[tuple[Path, int, int], ...]) -> str:
    digest = hashlib.sha256()
    root = os.path.commonpath([path.parent for path, _, _ in files]) if files else ""
    for path, _, _ in files:
        content = path.read_bytes()
        digest.update(f"{path.relative_to(root).as_posix()}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()
