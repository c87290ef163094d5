"""The entities of a Provenance Run Crate that describe a record: who did what with what.

The profile is Provenance Run Crate 0.5 (https://w3id.org/ro/wfrun/provenance/0.5), on RO-Crate
1.1.
A cell is a `CreateAction` of its method (a `SoftwareApplication`) for a step (`HowToStep`);
products that the record holds are named by their digest.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping
from typing import Final, TypeAlias

from orthoflow_provenance.document import (
    RecordedCell,
    RecordedEnvironment,
    RecordedFile,
    RecordedProduct,
    RunRecord,
    cost_metrics,
)

from orthoflow.products.product import JsonValue

Entity: TypeAlias = dict[str, JsonValue]

WORKFLOW_FILE: Final = "workflow.yaml"
RESOLVED_FILE: Final = "workflow-resolved.json"
_DONE: Final = "http://schema.org/CompletedActionStatus"
_FAILED: Final = "http://schema.org/FailedActionStatus"
_UNIT_CODES: Final = {
    "s": "https://qudt.org/vocab/unit/SEC",
    "MiB": "https://qudt.org/vocab/unit/MebiBYTE",
    "1": "https://qudt.org/vocab/unit/UNITLESS",
}


def ref(identifier: str) -> dict[str, JsonValue]:
    """Point at an entity."""
    return {"@id": identifier}


def refs(identifiers: Iterator[str] | tuple[str, ...]) -> list[JsonValue]:
    """Point at entities, each once."""
    return [ref(identifier) for identifier in dict.fromkeys(identifiers)]


def file_id(file: RecordedFile) -> str:
    """Name a file that is not in the crate by its content (RFC 6920).

    >>> file_id(RecordedFile(name="a", size_bytes=0, sha256="00" * 32))[:20]
    'ni:///sha-256;AAAAAA'
    """
    digest = base64.urlsafe_b64encode(bytes.fromhex(file.sha256)).decode().rstrip("=")
    return f"ni:///sha-256;{digest}"


def product_id(product: RecordedProduct) -> str:
    """Name a product by its digest."""
    return f"#product-{product.digest.removeprefix('sha256:')}"


def environment_file(environment: RecordedEnvironment) -> str:
    """Name of the list of packages of an environment."""
    return f"requirements-{environment.id.removeprefix('sha256:')[:12]}.txt"


def ran(record: RunRecord) -> tuple[RecordedCell, ...]:
    """Cells that were executed; skipped ones are no actions."""
    return tuple(cell for cell in record.cells if cell.status != "skipped")


def tool_id(cell: RecordedCell) -> str:
    """Name the method of a cell."""
    return f"#method-{cell.method}"


def step_id(cell: RecordedCell) -> str:
    """Name the step of a cell, one per variant."""
    variant = cell.assignment.get(cell.step, "")
    return f"{WORKFLOW_FILE}#{cell.step}{f'.{variant}' if variant else ''}"


def action_id(cell: RecordedCell) -> str:
    """Name the execution of a cell."""
    return f"#run-of-{cell.address}"


def formal_id(owner: str, name: str) -> str:
    """Name a formal parameter: an input, output or setting of a method or of the workflow."""
    return f"{owner}/{name}" if "#" in owner else f"{owner}#{name}"


def status_of(*, is_ok: bool) -> str:
    """Name of the status of an action."""
    return _DONE if is_ok else _FAILED


def value_type(value: JsonValue) -> str:
    """Schema.org's name for the type of a setting; what is no scalar is written as JSON text."""
    names = {bool: "Boolean", int: "Integer", float: "Float"}
    return names.get(type(value), "Text")


def port_type(product: RecordedProduct) -> str:
    """Schema.org's name for what a port takes: files of the user, or products of the record."""
    return "File" if product.type_name == "files" else "CreativeWork"


def value_text(value: JsonValue) -> JsonValue:
    """Give a setting as a scalar."""
    if isinstance(value, bool | int | float | str):
        return value
    return json.dumps(value, ensure_ascii=False)


def formal(identifier: str, name: str, additional_type: str) -> Entity:
    """A formal parameter."""
    return {
        "@id": identifier,
        "@type": "FormalParameter",
        "additionalType": additional_type,
        "name": name,
    }


def method_entities(record: RunRecord) -> Iterator[Entity]:
    """Methods with their ports and settings, and the distributions that brought them."""
    by_tool: dict[str, list[RecordedCell]] = {}
    for cell in ran(record):
        by_tool.setdefault(tool_id(cell), []).append(cell)
    brought: dict[str, Entity] = {}
    for tool, cells in by_tool.items():
        first = cells[0]
        origin = f"#distribution-{first.distribution}"
        brought[origin] = {
            "@id": origin,
            "@type": "SoftwareApplication",
            "name": first.distribution,
            "version": first.distribution_version,
        }
        settings = {name: value for cell in cells for name, value in cell.params.items()}
        ports = {port: product for cell in cells for port, product in cell.inputs.items()}
        outputs = {port: product for cell in cells for port, product in cell.outputs.items()}
        yield {
            "@id": tool,
            "@type": "SoftwareApplication",
            "name": first.method,
            "softwareVersion": f"{first.distribution_version}, result version "
            f"{first.result_version}",
            "description": f"{first.determinism} method of {first.distribution}",
            "input": refs(formal_id(tool, name) for name in (*ports, *settings)),
            "output": refs(formal_id(tool, f"out/{name}") for name in outputs),
            "softwareRequirements": ref(origin),
            "mainEntity": ref(origin),
            "citation": list(first.citations),
        }
        for port, product in ports.items():
            yield formal(formal_id(tool, port), port, port_type(product))
        for name, value in settings.items():
            yield formal(formal_id(tool, name), name, value_type(value))
        for port, product in outputs.items():
            yield formal(formal_id(tool, f"out/{port}"), port, port_type(product))
    yield from brought.values()


def cell_entities(record: RunRecord) -> Iterator[Entity]:
    """What happened: an action per cell, its control, its settings, costs and metrics."""
    files = {entry.name: entry.files for entry in record.inputs}
    for cell in ran(record):
        action = action_id(cell)
        settings = list(_settings(cell))
        costs = list(_costs(cell))
        metrics = list(_metrics(cell))
        taken = [
            identifier
            for product in cell.inputs.values()
            for identifier in _sources(product, files)
        ]
        content: Entity = {
            "@id": action,
            "@type": "CreateAction",
            "name": f"{cell.method} as {cell.address}",
            "description": _history(cell),
            "instrument": ref(tool_id(cell)),
            "startTime": cell.started,
            "endTime": cell.ended,
            "actionStatus": status_of(is_ok=cell.status == "ok"),
            "object": refs((*taken, *(str(entity["@id"]) for entity in settings))),
            "result": refs(
                (
                    *(product_id(product) for product in cell.outputs.values()),
                    *(str(entity["@id"]) for entity in metrics),
                )
            ),
            "resourceUsage": refs(tuple(str(entity["@id"]) for entity in costs)),
        }
        if cell.status == "failed":
            content["error"] = cell.error_message
        yield content
        yield {
            "@id": f"#control-of-{cell.address}",
            "@type": "ControlAction",
            "name": f"orchestrate {cell.address}",
            "instrument": ref(step_id(cell)),
            "object": ref(action),
        }
        yield from (*settings, *costs, *metrics)


def _sources(
    product: RecordedProduct, files: Mapping[str, tuple[RecordedFile, ...]]
) -> Iterator[str]:
    owner, _, name = product.source.rpartition(".")
    if owner == "inputs":
        yield from (file_id(file) for file in files.get(name, ()))
    else:
        yield product_id(product)


def _history(cell: RecordedCell) -> str:
    if cell.cached_from:
        return f"computed by the earlier run {cell.cached_from} and taken from the store"
    return "computed in this run" if cell.status == "ok" else "failed in this run"


def _settings(cell: RecordedCell) -> Iterator[Entity]:
    for name, value in cell.params.items():
        example = [ref(formal_id(tool_id(cell), name))]
        if name in cell.params_set:
            example.append(ref(formal_id(step_id(cell), name)))
        yield {
            "@id": f"#setting-{cell.address}/{name}",
            "@type": "PropertyValue",
            "name": name,
            "value": value_text(value),
            "exampleOfWork": list(example),
        }


def _costs(cell: RecordedCell) -> Iterator[Entity]:
    for cost in cost_metrics(cell):
        yield {
            "@id": f"#cost-{cell.address}/{cost.name}",
            "@type": "PropertyValue",
            "name": cost.name,
            "propertyID": cost.name,
            "unitCode": _UNIT_CODES[cost.unit],
            "value": str(cost.value),
        }


def _metrics(cell: RecordedCell) -> Iterator[Entity]:
    for metric in cell.metrics:
        yield {
            "@id": f"#metric-{cell.address}/{metric.name}",
            "@type": "PropertyValue",
            "name": metric.name,
            "unitText": metric.unit,
            "value": metric.value,
        }
