"""A record as W3C PROV: which products came of which, by which method, of which software."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from typing import Any, Final
from urllib.parse import quote

from orthoflow_provenance.document import (
    PublishedFile,
    RecordedCell,
    RecordedFile,
    RecordedProduct,
    RunRecord,
    cost_metrics,
)
from prov.constants import PROV, PROV_ROLE
from prov.identifier import Identifier, Namespace, QualifiedName
from prov.model import ProvDocument

from orthoflow.engine.journal import cell_file_name
from orthoflow.products import JsonValue
from orthoflow.records.published import PRODUCTS_FOLDER

# Any: what attributes may be is for `prov` to tell.
Attributes = list[tuple[QualifiedName | str | Identifier, Any]]

# Names of attributes are of this program; names of things are of the run.
_TERMS: Final = "urn:orthoflow:terms:"
_NAMES: Final = {
    "orthoflow": _TERMS,
    "parameter": f"{_TERMS}parameter:",
    "metric": f"{_TERMS}metric:",
    "software": "urn:orthoflow:software:",
    "environment": "urn:orthoflow:environment:",
}
_PARTS: Final = ("cell", "product", "input", "file", "published", "workflow")


def prov_document(record: RunRecord) -> ProvDocument:
    """Describe a run as a PROV document.

    Entities are products, inputs, their files and published files, all with digests; activities are
    the cells that were executed, with method, version, parameters, seed, times and metrics; agents
    are this program and the distributions that brought the methods.
    """
    document = ProvDocument()
    run = f"urn:orthoflow:run:{quote(record.run_id, safe='')}:"
    for prefix, uri in {**_NAMES, **{part: f"{run}{part}:" for part in _PARTS}}.items():
        document.add_namespace(prefix, uri)
    cells = [cell for cell in record.cells if cell.status != "skipped"]
    _add_workflow(document, record)
    _add_inputs(document, record)
    _add_software(document, record, cells)
    for cell in cells:
        _add_cell(document, cell)
    _add_published(document, record, cells)
    return document


def _add_workflow(document: ProvDocument, record: RunRecord) -> None:
    document.entity(
        _name("workflow", "plan"),
        _attributes(
            PROV["Plan"],
            record.name,
            source=record.workflow_source,
            sourceSha256=_sha256(record.workflow_source),
            resolved=record.workflow_resolved,
            overrides=" ".join(record.overrides),
            seed=record.seed,
        ),
    )
    for environment in record.environments:
        document.entity(
            _name("environment", environment.id),
            _attributes(
                _type("Environment"),
                "",
                python=environment.python,
                os=environment.os,
                cpu=environment.cpu,
                cores=environment.cores,
                threads=environment.threads,
                gitCommit=environment.git_commit,
                packages=json.dumps(dict(environment.packages), sort_keys=True),
            ),
        )


def _add_inputs(document: ProvDocument, record: RunRecord) -> None:
    """Add inputs and their files, each content once; an absent optional input is no entity."""
    known: set[str] = set()
    for entry in record.inputs:
        if not entry.files:
            continue
        name = _name("input", entry.name)
        document.entity(name, _attributes(PROV["Collection"], entry.name))
        for file in entry.files:
            member = _name("file", file.sha256)
            if member not in known:
                known.add(member)
                document.entity(member, _file("InputFile", file.name, file))
            document.membership(name, member)


def _add_software(document: ProvDocument, record: RunRecord, cells: Iterable[RecordedCell]) -> None:
    """Add this program, and distributions that act for it."""
    program = record.created_by
    for name in dict.fromkeys([program, *map(_distribution, cells)]):
        title, _, version = name.rpartition(" ")
        facts = {"name": title or name, "version": version if title else ""}
        document.agent(_name("software", name), _attributes(PROV["SoftwareAgent"], name, **facts))
        if name != program:
            document.delegation(_name("software", name), _name("software", program))


def _add_cell(document: ProvDocument, cell: RecordedCell) -> None:
    """Add the activity of a cell, with its inputs and outputs."""
    name = _name("cell", cell.address)
    attributes = _attributes(
        _type("Cell"),
        cell.address,
        step=cell.step,
        status=cell.status,
        method=cell.method,
        distribution=cell.distribution,
        distributionVersion=cell.distribution_version,
        resultVersion=cell.result_version,
        determinism=cell.determinism,
        seed=None if cell.seed is None else str(cell.seed),
        cachedFromRun=cell.cached_from,
        key=cell.key,
        error=cell.error_message,
    )
    attributes += [(_name("parameter", key), _literal(value)) for key, value in cell.params.items()]
    measured = [*cell.metrics, *cost_metrics(cell)]
    attributes += [(_name("metric", item.name), item.value) for item in measured]
    document.activity(name, cell.started or None, cell.ended or None, attributes)
    document.association(
        name, _name("software", _distribution(cell)), plan=_name("workflow", "plan")
    )
    sources = {port: _source(product) for port, product in cell.inputs.items()}
    if cell.environment:
        sources = {"environment": _name("environment", cell.environment), **sources}
    for role, source in sources.items():
        document.usage(name, source, other_attributes={PROV_ROLE: role})
    for port, product in cell.outputs.items():
        made = _name("product", f"{cell.address}.{port}")
        facts = _attributes(
            _type("Product"),
            product.type_name,
            type=product.type_name,
            encodingVersion=product.encoding_version,
            digest=product.digest,
            isEmbedded=product.embedded,
        )
        document.entity(made, facts)
        document.generation(made, name, cell.ended or None, other_attributes={PROV_ROLE: port})
        for source in dict.fromkeys(_source(product) for product in cell.inputs.values()):
            document.derivation(made, source, name)


def _add_published(
    document: ProvDocument, record: RunRecord, cells: Iterable[RecordedCell]
) -> None:
    """Add the files that the run published, each with its cell."""
    owners = {f"{PRODUCTS_FOLDER}/{cell_file_name(cell.address)}": cell.address for cell in cells}
    for file in record.published:
        name = _name("published", file.path)
        document.entity(name, _file("PublishedFile", file.path, file))
        owner = owners.get(file.path.rpartition("/")[0])
        if owner is not None:
            document.generation(name, _name("cell", owner))


def _file(kind: str, label: str, file: RecordedFile | PublishedFile) -> Attributes:
    return _attributes(_type(kind), label, sha256=file.sha256, sizeBytes=file.size_bytes)


def _source(product: RecordedProduct) -> str:
    """Name of the entity of an input: `inputs.name`, or `address.port` of another cell."""
    owner, _, name = product.source.partition(".")
    return _name("input", name) if owner == "inputs" else _name("product", product.source)


def _distribution(cell: RecordedCell) -> str:
    return f"{cell.distribution} {cell.distribution_version}".strip() or "unknown"


def _type(name: str) -> QualifiedName:
    return Namespace("orthoflow", _TERMS)[name]


def _name(part: str, name: str) -> str:
    """Return a qualified name; characters that a local name cannot contain are written as %XX."""
    return f"{part}:{quote(name, safe='') or '_'}"


def _attributes(kind: QualifiedName, label: str, **facts: bool | float | str | None) -> Attributes:
    known = [("prov:label", label), *((_name("orthoflow", key), facts[key]) for key in facts)]
    return [("prov:type", kind), *(item for item in known if item[1] not in (None, ""))]


def _literal(value: JsonValue) -> JsonValue:
    """Return a scalar as it is, all else as JSON text."""
    if isinstance(value, bool | int | float | str):
        return value
    return json.dumps(value, ensure_ascii=False)


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()
