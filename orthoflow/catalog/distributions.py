"""The distribution of a plugin, and the location of its code."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from importlib.metadata import Distribution, EntryPoint, PackageNotFoundError, requires
from importlib.util import find_spec
from pathlib import Path
from typing import Final

# Name at the beginning of a requirement.
_REQUIREMENT: Final = re.compile(r"[\w.-]+")


@dataclass(frozen=True, kw_only=True)
class DistributionInfo:
    """The distribution that contains a plugin.

    Attributes:
        name: name of the distribution.
        version: version of the distribution.
        source_folder: folder of the package with the hooks; None for a plugin that is a single
            module next to unrelated code (see `MethodEntry.source_files`).
    """

    name: str
    version: str
    source_folder: Path | None

    def __str__(self) -> str:
        return f"{self.name} {self.version}"


def describe_distribution(entry_point: EntryPoint) -> DistributionInfo:
    """Return the distribution of an entry point, without importing the plugin."""
    code = package_path(entry_point.module)
    folder = code if code is not None and code.is_dir() else None
    distribution = entry_point.dist
    if distribution is None:
        return DistributionInfo(name=entry_point.name, version="0", source_folder=folder)
    name, version = _name_and_version(distribution)
    return DistributionInfo(
        name=name or entry_point.name,
        version=version or "0",
        source_folder=folder,
    )


def _name_and_version(distribution: Distribution) -> tuple[str, str]:
    try:
        stated = distribution.metadata
    except ValueError:
        return "", ""
    return str(stated["Name"] or ""), str(stated["Version"] or "")


def package_path(module: str) -> Path | None:
    """Return the folder of a module's outermost regular package, or its file if it has no package.

    Only namespace packages, which contain no code, are imported. None if the module does not exist.
    """
    name, _, rest = module.partition(".")
    while True:
        try:
            spec = find_spec(name)
        except (ImportError, ValueError, AttributeError):
            return None
        if spec is None:
            return None
        if spec.origin is not None and spec.has_location:
            origin = Path(spec.origin).resolve()
            return origin.parent if spec.submodule_search_locations else origin
        if not rest:
            return None
        head, _, rest = rest.partition(".")
        name = f"{name}.{head}"


def canonical_name(name: str) -> str:
    """Return the normalised name of a distribution.

    >>> canonical_name("Ruamel.YAML_clib")
    'ruamel-yaml-clib'
    """
    return re.sub(r"[-_.]+", "-", name).lower()


def direct_requirements(name: str) -> frozenset[str] | None:
    """Return the canonical names of the direct requirements of a distribution, for all platforms.

    Extras are excluded. None if the distribution is not installed or its metadata is unreadable.
    """
    try:
        stated = requires(name) or []
    except (PackageNotFoundError, ValueError):
        return None
    found = (_REQUIREMENT.match(text) for text in stated if "extra ==" not in text)
    return frozenset(canonical_name(match[0]) for match in found if match)


@cache
def required_distributions(names: frozenset[str]) -> frozenset[str] | None:
    """Return the canonical names of distributions and of their direct and indirect requirements.

    None if one of the given distributions is not installed, since its requirements are then
    unknown.
    """
    left = [canonical_name(name) for name in names]
    if any(direct_requirements(name) is None for name in left):
        return None
    found: set[str] = set()
    while left:
        name = left.pop()
        if name not in found:
            found.add(name)
            left += direct_requirements(name) or ()
    return frozenset(found)


@cache
def source_files(paths: tuple[Path | None, ...]) -> tuple[Path, ...]:
    """Return all Python files of packages and single modules, sorted, without duplicates.

    The folders are searched once per process, since a plan needs the files of every method.
    """
    files: set[Path] = set()
    for path in paths:
        if path is not None:
            files.update([path] if path.is_file() else path.rglob("*.py"))
    return tuple(sorted(files))
