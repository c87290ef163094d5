"""Cache keys: which ingredients decide a cell's result, and nothing else.

Paths, step names, cores, timeouts, package versions and time stamps stay out on purpose.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol, cast

from orthoflow.catalog import Catalog
from orthoflow.engine.results import ProductRef
from orthoflow.engine.sources import compiled_digest, files_digest, unreleased_code
from orthoflow.engine.store import canonical_json
from orthoflow.errors import PluginError
from orthoflow.products.product import JsonValue
from orthoflow.sdk.methods import Method, port_specs
from orthoflow.workflow.cells import Cell

_WHAT: Final = "orthoflow/cell"
_KEY_VERSION: Final = 1


@dataclass(frozen=True, kw_only=True)
class MethodFacts:
    """What the engine needs to know of a method, without its class.

    Attributes:
        id: `kind.method`.
        target: import string of the class.
        result_version: raised by the author when results change.
        determinism: exact, seeded or loose.
        citations: where the method comes from.
        distribution: name of the distribution that brings it.
        distribution_version: its version.
        tools: external libraries whose version changes results.
        code: digests of source code that is not a released install; empty when all is released.
        compiled_digest: names the folder for compiled kernels.
        inputs: port -> product type.
        outputs: port -> product type.
        sources: the files behind `code`.
    """

    id: str
    target: str
    result_version: int
    determinism: str
    citations: tuple[str, ...]
    distribution: str
    distribution_version: str
    tools: Mapping[str, str]
    code: Mapping[str, str]
    compiled_digest: str
    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    sources: Mapping[str, tuple[Path, ...]] = field(default_factory=dict)

    def is_code_unchanged(self) -> bool:
        """Whether the code on the disk is still the one in the keys."""
        try:
            return all(files_digest(self.sources[name]) == self.code[name] for name in self.sources)
        except OSError:
            return False


@dataclass(frozen=True, kw_only=True)
class CellKey:
    """Key of a cell and the text it is the SHA-256 of."""

    key: str
    preimage: str


def method_facts(method_id: str, catalog: Catalog) -> MethodFacts:
    """Load a method and note what decides its results.

    Raises:
        PluginError: the method, or a library it needs, is missing or broken.
    """
    entry = catalog.method(method_id)
    cls: type[Method] = entry.load()
    distribution = entry.distribution
    sources = unreleased_code(entry)
    return MethodFacts(
        id=method_id,
        target=entry.spec.target,
        result_version=cls.result_version,
        determinism=cls.determinism,
        citations=tuple(cls.citations),
        distribution=distribution.name,
        distribution_version=distribution.version,
        tools=_tools(cls),
        code={name: files_digest(files) for name, files in sources.items()},
        sources=sources,
        compiled_digest=compiled_digest(entry),
        inputs={name: port.type_name for name, port in port_specs(cls.In).items()},
        outputs={name: port.type_name for name, port in port_specs(cls.Out).items()},
    )


class NamedContent(Protocol):
    """A file by name and content; `FileRef` is one, and so is a file in a record."""

    @property
    def name(self) -> str:
        """Name without its folder."""
        raise AssertionError("a protocol is never called")

    @property
    def size_bytes(self) -> int:
        """Its size."""
        raise AssertionError("a protocol is never called")

    @property
    def sha256(self) -> str:
        """Hexadecimal digest of its bytes."""
        raise AssertionError("a protocol is never called")


def input_digest(files: Sequence[NamedContent]) -> str:
    """Digest of a workflow input: names without folders, sizes and contents, in order."""
    listing: JsonValue = [
        {"name": file.name, "size_bytes": file.size_bytes, "sha256": file.sha256} for file in files
    ]
    text = canonical_json({"what": "orthoflow/files", "v": 1, "files": listing})
    return f"sha256:{hashlib.sha256(text.encode()).hexdigest()}"


def cell_key(cell: Cell, facts: MethodFacts, inputs: Mapping[str, ProductRef]) -> CellKey:
    """Give the key of a cell whose inputs are known.

    Args:
        cell: the cell.
        facts: of its method.
        inputs: port -> product.
    """
    preimage: dict[str, JsonValue] = {
        "what": _WHAT,
        "v": _KEY_VERSION,
        "method": facts.id,
        "result_version": facts.result_version,
        "code": dict(facts.code) or None,
        "params": dict(cell.params),
        "seed": None if facts.determinism == "exact" else cell.seed,
        "tools": dict(facts.tools),
        "inputs": {
            port: f"{ref.type_name}@{ref.encoding_version}:{ref.digest}"
            for port, ref in inputs.items()
        },
    }
    text = canonical_json(preimage)
    return CellKey(key=hashlib.sha256(text.encode()).hexdigest(), preimage=text)


def read_preimage(text: str) -> Mapping[str, JsonValue]:
    """Read a preimage's text; an empty mapping when it is not one."""
    try:
        content = json.loads(text)
    except ValueError:
        return {}
    return cast("dict[str, JsonValue]", content) if isinstance(content, dict) else {}


def _tools(cls: type[Method]) -> dict[str, str]:
    try:
        return {str(name): str(version) for name, version in cls.tools().items()}
    except Exception as error:
        raise PluginError(
            f"method {cls.id} cannot tell the versions of its libraries: {error}"
        ) from error
