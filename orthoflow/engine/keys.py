"""Cache keys, which are the SHA-256 of everything that determines the result of a cell.

Paths, step names, cores, timeouts and timestamps are deliberately excluded. The code of the
method and the versions of the libraries that it may use are always included.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path
from typing import Final, TypeAlias, cast

from orthoflow.catalog.catalog import Catalog, MethodEntry
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.catalog.distributions import canonical_name, direct_requirements
from orthoflow.catalog.guarding import UserInterrupt, guarded
from orthoflow.engine.results import MethodIdentity, ProductRef, RecordedFile, canonical_json
from orthoflow.errors import OrthoflowError, PluginError
from orthoflow.products.product import JsonValue
from orthoflow.sdk.lines import describe_error
from orthoflow.sdk.methods import Method, port_specs
from orthoflow.untrusted_text import parse_json
from orthoflow.version import DISTRIBUTION
from orthoflow.workflow.expand import Cell

_WHAT: Final = "orthoflow/cell"
_CODE: Final = "its code"
_KEY_VERSION: Final = 1
_ROOT: Final = Path(__file__).resolve().parents[1]
# Only these parts of the framework can affect the result of a method.
_FRAMEWORK_PARTS: Final = ("errors.py", "files", "geometry", "products", "sdk")
_CORE: Final = frozenset({"numpy", "numba", "scipy", "opencv-python-headless"})
# These libraries do not affect results: they serve the command line, records, web pages, drawings
# and metadata.
_WITHOUT_EFFECT: Final = frozenset(
    {"click", "ezdxf", "filelock", "h5py", "iiif-prezi3", "jinja2", "libusb-package", "matplotlib"}
    | {"networkx", "pluggy", "prov", "psutil", "pydantic", "pystac", "reportlab", "rich", "rocrate"}
    | {"ruamel-yaml"}
)
_OUR_OWN: Final = frozenset({"orthoflow", "orthoflow_plugins", "orthoflow_provenance"})
_IMPORTED: Final = re.compile(r"^\s*(?:import|from)\s+([A-Za-z_]\w*)", re.MULTILINE)
_MADE_BY_PYTHON: Final = frozenset({"__pycache__", ".pyc", ".nbi", ".nbc"})
_BUILT_IN_PACKAGE: Final = "orthoflow_plugins"

# Path, size and modification time of files.
_States: TypeAlias = tuple[tuple[Path, int, int], ...]


@dataclass(frozen=True, kw_only=True)
class MethodFacts(MethodIdentity):
    """Properties of a method that the engine needs, without its class.

    Attributes:
        target: import string of the class.
        tools: library -> version, for the libraries that can affect results.
        code: digests of the code of the plugin and of the framework.
        inputs: port -> product type.
        outputs: port -> product type.
        sources: source files from which `code` was computed.
        repeatable: input ports that accept several files with the same content.
    """

    target: str
    tools: Mapping[str, str]
    code: Mapping[str, str]
    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    sources: Mapping[str, tuple[Path, ...]] = field(default_factory=dict)
    repeatable: frozenset[str] = frozenset()

    @property
    def kernels(self) -> str:
        """Name of the folder for kernels of the plugin; empty for built-in methods."""
        if self.target.startswith(f"{_BUILT_IN_PACKAGE}."):
            return ""
        return hashlib.sha256("".join(self.code.values()).encode()).hexdigest()

    def is_code_unchanged(self) -> bool:
        """Whether the code on disk is unchanged since `code` was computed."""
        try:
            return all(files_digest(self.sources[name]) == self.code[name] for name in self.sources)
        except OSError:
            return False


@dataclass(frozen=True, kw_only=True)
class CellKey:
    """Key of a cell, and the text of which the key is the SHA-256."""

    key: str
    preimage: str


def method_facts(method_id: str, catalog: Catalog) -> MethodFacts:
    """Load a method and determine what its results depend on.

    Raises:
        PluginError: the method, or a library that it needs, is missing or broken.
    """
    entry = catalog.method(method_id)
    cls: type[Method] = entry.load()
    distribution = entry.distribution
    # The contents of these files can affect results, regardless of the version.
    sources = {"plugin": plugin_files(entry), "framework": framework_files()}
    is_ours = entry.spec.target.startswith(f"{_BUILT_IN_PACKAGE}.")
    libraries = library_versions(distribution.name, () if is_ours else entry.source_files())
    unaffected = frozenset(map(canonical_name, cls.unaffected_by))
    return MethodFacts(
        method=method_id,
        target=entry.spec.target,
        result_version=cls.result_version,
        determinism=cls.determinism,
        citations=tuple(cls.citations),
        distribution=distribution.name,
        distribution_version=distribution.version,
        tools={
            **{name: version for name, version in libraries.items() if name not in unaffected},
            **_tools(cls),
        },
        code={name: files_digest(files) for name, files in sources.items()},
        sources=sources,
        inputs={name: port.type_name for name, port in port_specs(cls.In).items()},
        outputs={name: port.type_name for name, port in port_specs(cls.Out).items()},
        repeatable=frozenset(cls.repeatable),
    )


def input_digest(files: Sequence[RecordedFile]) -> str:
    """Return the digest of the names (without folders), sizes, contents and order of files."""
    listing: JsonValue = [
        {"name": file.name, "size_bytes": file.size_bytes, "sha256": file.sha256} for file in files
    ]
    text = canonical_json({"what": "orthoflow/files", "v": 1, "files": listing})
    return f"sha256:{hashlib.sha256(text.encode()).hexdigest()}"


def cell_key(cell: Cell, facts: MethodFacts, inputs: Mapping[str, ProductRef]) -> CellKey:
    """Return the key of a cell whose inputs are known.

    Args:
        cell: the cell.
        facts: facts of its method.
        inputs: port -> product connected to it.
    """
    preimage: dict[str, JsonValue] = {
        "what": _WHAT,
        "v": _KEY_VERSION,
        "method": facts.method,
        "result_version": facts.result_version,
        "code": dict(facts.code),
        "params": dict(cell.params),
        "seed": None if facts.determinism == "exact" else cell.seed,
        "tools": dict(facts.tools),
        "inputs": {
            port: f"{ref.type_name}@{ref.encoding_version}:{ref.digest}"
            for port, ref in inputs.items()
        },
    }
    if facts.determinism == "exact" and cell.repeat:
        # A repeat recomputes the same result to measure the time, so it needs its own key.
        preimage["repeat"] = cell.repeat
    text = canonical_json(preimage)
    return CellKey(key=hashlib.sha256(text.encode()).hexdigest(), preimage=text)


def read_preimage(text: str) -> Mapping[str, JsonValue]:
    """Parse the text of a preimage; return an empty mapping if the text is invalid."""
    try:
        content = parse_json(text)
    except ValueError:
        return {}
    return cast("dict[str, JsonValue]", content) if isinstance(content, dict) else {}


def stated_versions(preimage: Mapping[str, JsonValue], name: str) -> dict[str, str]:
    """Return the entry `code` or `tools` of a preimage; empty if the entry is not a mapping.

    >>> stated_versions({"tools": {"numpy": "2.1"}, "code": [1]}, "tools")
    {'numpy': '2.1'}
    """
    stated = preimage.get(name)
    return {k: str(v) for k, v in stated.items()} if isinstance(stated, dict) else {}


def _tools(cls: type[Method]) -> dict[str, str]:
    try:
        with guarded():
            return {str(name): str(version) for name, version in cls.tools().items()}
    except UserInterrupt:
        raise
    except BaseException as error:
        raise PluginError(
            f"method {cls.id} failed to report the versions of its libraries: "
            f"{describe_error(error)}"
        ) from error


@cache
def library_versions(distribution: str, sources: tuple[Path, ...] = ()) -> Mapping[str, str]:
    """Return the versions of the libraries that can affect results of a plugin's methods.

    These are the installed requirements of orthoflow and of the plugin's distribution, and other
    installed libraries that the plugin's sources import. Libraries that only display or store
    results are excluded.

    Args:
        distribution: distribution of the plugin.
        sources: Python files of the plugin; empty for built-in plugins.
    """
    required = [direct_requirements(name) or () for name in (DISTRIBUTION, distribution)]
    names = {*_CORE, *required[0], *required[1], *_imported(sources)}
    versions: dict[str, str] = {}
    for name in sorted(names - _WITHOUT_EFFECT - {DISTRIBUTION, canonical_name(distribution)}):
        with suppress(metadata.PackageNotFoundError, ValueError, KeyError):
            versions[name] = metadata.version(name)
    return versions


def _imported(sources: Iterable[Path]) -> set[str]:
    modules = {
        name
        for path in sources
        for name in _IMPORTED.findall(path.read_text(encoding="utf-8", errors="replace"))
        if name not in sys.stdlib_module_names
    }
    modules -= {path.stem for path in sources} | {path.parent.name for path in sources} | _OUR_OWN
    if not modules:
        return set()
    # `metadata.packages_distributions` returns the same names, but adds a quarter of a second to
    # each command.
    listed = re.compile(
        rf"^(?:{'|'.join(map(re.escape, sorted(modules)))})(?:[/.]|$)", re.MULTILINE
    )
    return {
        canonical_name(one.name)
        for one in metadata.distributions()
        if listed.search(one.read_text("top_level.txt") or one.read_text("RECORD") or "")
    }


@cache
def framework_files() -> tuple[Path, ...]:
    """Return the files of the framework that methods use."""
    parts = [_ROOT / part for part in _FRAMEWORK_PARTS]
    return tuple(
        file for part in parts for file in ([part] if part.is_file() else part.rglob("*.py"))
    )


def plugin_files(entry: MethodEntry) -> tuple[Path, ...]:
    """Return the code files of a method, together with the data files in the same packages.

    For a built-in method, this is the package of its kind, since no kind imports another. For
    other methods, these are all packages of the distribution.
    """
    files = entry.source_files()
    module = entry.spec.target.partition(":")[0]
    if module.startswith(f"{_BUILT_IN_PACKAGE}."):
        place = f"/{_BUILT_IN_PACKAGE}/{module.split('.')[1]}"
        return tuple(f for f in files if f.as_posix().partition(place)[2][:1] in ("/", "."))
    packages = {file.parent for file in files if file.name == "__init__.py"}
    found = {
        path
        for package in packages
        if package.parent not in packages
        for path in package.rglob("*")
        if path.is_file() and not _MADE_BY_PYTHON.intersection((path.suffix, path.parent.name))
    }
    return tuple(sorted(found.union(files)))


def files_digest(files: Iterable[Path]) -> str:
    """Return the digest of the names and contents of files; it is cached until a file changes."""
    return _digest(_states(files))


def _states(files: Iterable[Path]) -> _States:
    stats = ((path, path.stat()) for path in sorted(files))
    return tuple((path, stat.st_size, stat.st_mtime_ns) for path, stat in stats)


@lru_cache(maxsize=256)
def _digest(files: _States) -> str:
    digest = hashlib.sha256()
    root = os.path.commonpath([path.parent for path, _, _ in files]) if files else ""
    for path, _, _ in files:
        content = path.read_bytes()
        digest.update(f"{path.relative_to(root).as_posix()}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()


def methods_text(methods: Mapping[str, MethodFacts]) -> str:
    """Return the code digests and library versions of methods as JSON, for `misfit`."""
    return json.dumps({name: _facts(facts) for name, facts in methods.items()}, sort_keys=True)


def misfit(methods: str) -> str:
    """Describe how the installed methods differ from those of a plan; empty if they agree.

    Only the first difference is described.
    """
    catalog = discover_catalog()
    for name, planned in json.loads(methods).items():
        try:
            here = _facts(method_facts(name, catalog))
        except OrthoflowError as error:
            return str(error)
        for what in sorted((planned.keys() | here.keys()) - {_CODE}):
            before, now = planned.get(what, "none"), here.get(what, "none")
            if before != now:
                return f"{name} has {what} {now} there, but {before} in the plan"
        if planned[_CODE] != here[_CODE]:
            return f"the code of {name} there differs from the plan"
    return ""


def _facts(facts: MethodFacts) -> dict[str, JsonValue]:
    return {
        **facts.tools,
        "the distribution": f"{facts.distribution} {facts.distribution_version}",
        "the result version": facts.result_version,
        _CODE: dict(facts.code),
    }
