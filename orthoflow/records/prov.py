"""A record as W3C PROV-JSON: which products came of which, by which method, of which software."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final
from urllib.parse import quote

from orthoflow_provenance.document import RecordedCell, RecordedProduct, RunRecord, cost_metrics

from orthoflow.engine.journal import cell_file_name
from orthoflow.products import JsonValue
from orthoflow.records.published import PRODUCTS_FOLDER

Entry = dict[str, JsonValue]

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


def prov_document(record: RunRecord) -> dict[str, JsonValue]:
    """Describe a run as a PROV-JSON document (W3C member submission of 24 April 2013).

    Entities are products, inputs, their files and published files, all with digests; activities are
    the cells that were executed, with method, version, parameters, seed, times and metrics; agents
    are this program and the distributions that brought the methods.
    """
    graph = _Graph(record=record)
    graph.add_workflow()
    graph.add_inputs()
    for environment in record.environments:
        graph.entity[_name("environment", environment.id)] = {
            "prov:type": _type("Environment"),
            **_known(
                python=environment.python,
                os=environment.os,
                cpu=environment.cpu,
                cores=environment.cores,
                threads=environment.threads,
                gitCommit=environment.git_commit,
                packages=json.dumps(dict(environment.packages), sort_keys=True),
            ),
        }
    for cell in record.cells:
        if cell.status != "skipped":
            graph.add_cell(cell)
    graph.add_published()
    run = f"urn:orthoflow:run:{quote(record.run_id, safe='')}:"
    prefixes: Entry = {**_NAMES, **{part: f"{run}{part}:" for part in _PARTS}}
    return {"prefix": prefixes, **graph.sections()}


@dataclass(frozen=True, kw_only=True)
class _Graph:
    """The parts of a document as they come together; relations are named by their place."""

    record: RunRecord
    entity: Entry = field(default_factory=dict)
    activity: Entry = field(default_factory=dict)
    agent: Entry = field(default_factory=dict)
    relations: dict[str, Entry] = field(default_factory=dict)

    def sections(self) -> dict[str, JsonValue]:
        """All parts that hold something."""
        things = {"entity": self.entity, "activity": self.activity, "agent": self.agent}
        return {name: part for name, part in {**things, **self.relations}.items() if part}

    def relate(self, kind: str, **ends: JsonValue) -> None:
        """Add a relation; ends are PROV's names without their prefix, `role` too."""
        part = self.relations.setdefault(kind, {})
        part[f"_:{kind}{len(part)}"] = {
            f"prov:{name}": value for name, value in ends.items() if value is not None
        }

    def add_workflow(self) -> None:
        """Add the plan, and the program that followed it."""
        record = self.record
        self.entity[_name("workflow", "plan")] = {
            "prov:type": {"$": "prov:Plan", "type": "xsd:QName"},
            "prov:label": record.name,
            **_known(
                source=record.workflow_source,
                sourceSha256=_sha256(record.workflow_source),
                resolved=record.workflow_resolved,
                overrides=" ".join(record.overrides),
                seed=record.seed,
            ),
        }
        self.agent[_name("software", record.created_by)] = _software(record.created_by)

    def add_inputs(self) -> None:
        """Add the workflow's inputs and their files; an absent optional one is no entity."""
        for entry in self.record.inputs:
            if not entry.files:
                continue
            name = _name("input", entry.name)
            self.entity[name] = {
                "prov:type": {"$": "prov:Collection", "type": "xsd:QName"},
                "prov:label": entry.name,
            }
            for file in entry.files:
                member = _name("file", file.sha256)
                self.entity[member] = {
                    "prov:type": _type("InputFile"),
                    "prov:label": file.name,
                    **_known(sha256=file.sha256, sizeBytes=file.size_bytes),
                }
                self.relate("hadMember", collection=name, entity=member)

    def add_cell(self, cell: RecordedCell) -> None:
        """Add what a cell did, with what, and what came of it."""
        name = _name("cell", cell.address)
        self.activity[name] = _activity(cell)
        agent = f"{cell.distribution} {cell.distribution_version}".strip() or "unknown"
        self.agent.setdefault(_name("software", agent), _software(agent))
        self.relate(
            "wasAssociatedWith",
            activity=name,
            agent=_name("software", agent),
            plan=_name("workflow", "plan"),
        )
        program = _name("software", self.record.created_by)
        pairs = self.relations.get("actedOnBehalfOf", {}).values()
        delegation: JsonValue = {
            "prov:delegate": _name("software", agent),
            "prov:responsible": program,
        }
        if program != _name("software", agent) and delegation not in pairs:
            self.relate("actedOnBehalfOf", delegate=_name("software", agent), responsible=program)
        if cell.environment:
            environment = _name("environment", cell.environment)
            self.relate("used", activity=name, entity=environment, role="environment")
        sources = {port: _source(product) for port, product in cell.inputs.items()}
        for port, source in sources.items():
            self.relate("used", activity=name, entity=source, role=port)
        for port, product in cell.outputs.items():
            made = _name("product", f"{cell.address}.{port}")
            self.entity[made] = _product(product)
            self.relate(
                "wasGeneratedBy", entity=made, activity=name, time=cell.ended or None, role=port
            )
            for source in dict.fromkeys(sources.values()):
                self.relate(
                    "wasDerivedFrom", generatedEntity=made, usedEntity=source, activity=name
                )

    def add_published(self) -> None:
        """Add the files that the run wrote for other programs, each of the cell that made it."""
        owners = {
            f"{PRODUCTS_FOLDER}/{cell_file_name(cell.address)}": cell.address
            for cell in self.record.cells
            if cell.status != "skipped"
        }
        for file in self.record.published:
            name = _name("published", file.path)
            self.entity[name] = {
                "prov:type": _type("PublishedFile"),
                "prov:label": file.path,
                **_known(sha256=file.sha256, sizeBytes=file.size_bytes),
            }
            owner = owners.get(file.path.rpartition("/")[0])
            if owner is not None:
                self.relate("wasGeneratedBy", entity=name, activity=_name("cell", owner))


def _activity(cell: RecordedCell) -> Entry:
    times = {"prov:startTime": cell.started, "prov:endTime": cell.ended}
    measured = [*cell.metrics, *cost_metrics(cell)]
    return {
        **{name: time for name, time in times.items() if time},
        "prov:type": _type("Cell"),
        "prov:label": cell.address,
        **_known(
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
        ),
        **_attributes("parameter", cell.params.items()),
        **_attributes("metric", ((item.name, item.value) for item in measured)),
    }


def _product(product: RecordedProduct) -> Entry:
    return {
        "prov:type": _type("Product"),
        "prov:label": product.type_name,
        **_known(
            type=product.type_name,
            encodingVersion=product.encoding_version,
            digest=product.digest,
            isEmbedded=product.embedded,
        ),
    }


def _source(product: RecordedProduct) -> str:
    """Name of the entity that an input is: `inputs.name`, or `address.port` of another cell."""
    owner, _, name = product.source.partition(".")
    return _name("input", name) if owner == "inputs" else _name("product", product.source)


def _software(name: str) -> Entry:
    program, _, version = name.rpartition(" ")
    return {
        "prov:type": {"$": "prov:SoftwareAgent", "type": "xsd:QName"},
        "prov:label": name,
        **_known(name=program or name, version=version if program else ""),
    }


def _type(name: str) -> JsonValue:
    return {"$": f"orthoflow:{name}", "type": "xsd:QName"}


def _name(part: str, name: str) -> str:
    """Qualified name; whatever no local name may hold is written as %XX."""
    return f"{part}:{quote(name, safe='') or '_'}"


def _known(**values: bool | float | str | None) -> Entry:
    return _attributes("orthoflow", ((k, v) for k, v in values.items() if v not in (None, "")))


def _attributes(prefix: str, values: Iterable[tuple[str, JsonValue]]) -> Entry:
    """Attributes as PROV-JSON has them: scalars as they are, all else as JSON text."""
    return {_name(prefix, name): _literal(value) for name, value in values}


def _literal(value: JsonValue) -> JsonValue:
    if isinstance(value, float) and not math.isfinite(value):
        # JSON knows no NaN, XML Schema does.
        special = {"nan": "NaN", "inf": "INF", "-inf": "-INF"}
        return {"$": special[repr(value)], "type": "xsd:double"}
    if isinstance(value, bool | int | float | str):
        return value
    return json.dumps(value, ensure_ascii=False)


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()


def count_things(document: Mapping[str, JsonValue]) -> dict[str, int]:
    """How many entities, activities and agents a document has, for a sentence."""
    sections = {name: document.get(name) for name in ("entity", "activity", "agent")}
    return {name: len(part) if isinstance(part, dict) else 0 for name, part in sections.items()}
