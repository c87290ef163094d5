"""Digests of source code, which stand for a version wherever code is not a released install."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Final

from orthoflow.catalog import MethodEntry

_ROOT: Final = Path(__file__).resolve().parents[1]
_DISTRIBUTION: Final = "orthoflow-tls"
# What a method's result can depend on in the framework; engine and command line cannot change it.
_FRAMEWORK_PARTS: Final = ("errors.py", "files", "geometry", "products", "sdk")
_BUILT_IN_PACKAGE: Final = "orthoflow_plugins."


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
    return metadata.version(_DISTRIBUTION) if is_framework_released() else framework_digest()


@cache
def framework_digest() -> str:
    """Digest of the framework's code that methods use."""
    parts = [_ROOT / part for part in _FRAMEWORK_PARTS]
    files = [file for part in parts for file in ([part] if part.is_file() else part.rglob("*.py"))]
    return _digest(files)


def plugin_digest(entry: MethodEntry) -> str:
    """Digest of the code that a method belongs to.

    For the built-in methods that is the package of their kind, since one kind never imports
    another; for all others everything their distribution's packages hold.
    """
    files = entry.source_files()
    module = entry.spec.target.partition(":")[0]
    if module.startswith(_BUILT_IN_PACKAGE):
        kind = module.split(".")[1]
        own = [file for file in files if kind in (file.stem, file.parent.name)]
        return _digest(own or files)
    return _digest(files)


def compiled_digest(entry: MethodEntry) -> str:
    """Digest of all code whose compiled kernels a method may use, one per plugin."""
    both = framework_digest() + _digest(entry.source_files())
    return hashlib.sha256(both.encode()).hexdigest()


def _digest(files: Iterable[Path]) -> str:
    paths = sorted(files)
    if not paths:
        return hashlib.sha256().hexdigest()
    root = os.path.commonpath([path.parent for path in paths])
    digest = hashlib.sha256()
    for path in paths:
        content = path.read_bytes()
        digest.update(f"{path.relative_to(root).as_posix()}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()
