"""JSON-LD contexts of RO-Crate 1.1 and Workflow Run Crate, as far as our crates use them.

The originals lie at w3id.org, which tests do not ask.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

_SCHEMA: Final = "http://schema.org/"
_RUN: Final = "https://w3id.org/ro/terms/workflow-run#"
_BIOSCHEMAS: Final = "https://bioschemas.org/"
_ELSEWHERE: Final = {
    "File": f"{_SCHEMA}MediaObject",
    "conformsTo": "http://purl.org/dc/terms/conformsTo",
    "ComputationalWorkflow": f"{_BIOSCHEMAS}ComputationalWorkflow",
    "FormalParameter": f"{_BIOSCHEMAS}FormalParameter",
    "input": f"{_BIOSCHEMAS}ComputationalWorkflow#input",
    "output": f"{_BIOSCHEMAS}ComputationalWorkflow#output",
}
_OF_RUNS: Final = (
    *("ParameterConnection", "sourceParameter", "targetParameter", "connection"),
    *("resourceUsage", "sha256"),
)


# Any: JSON.
def context_of(crate: Mapping[str, Any]) -> dict[str, object]:
    """Give a context with every term of a crate that it does not define itself."""
    own = {name for part in crate["@context"] if isinstance(part, dict) for name in part}
    terms = {
        name: _ELSEWHERE.get(name, f"{_RUN if name in _OF_RUNS else _SCHEMA}{name}")
        for name in sorted(set(_terms(crate)) - own)
    }
    return {"@context": terms}


def _terms(crate: Mapping[str, Any]) -> Iterator[str]:
    for entity in crate["@graph"]:
        yield from (name for name in entity if not name.startswith("@"))
        types = entity["@type"]
        yield from types if isinstance(types, list) else [types]
