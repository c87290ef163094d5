"""Exports of runs for archives and other programs, as RO-Crate and W3C PROV."""

from __future__ import annotations

import base64
import hashlib
import json
import mimetypes
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeAlias
from urllib.parse import quote

from orthoflow_provenance.document import (
    PublishedFile,
    RecordedCell,
    RecordedFile,
    RecordedProduct,
    RunRecord,
    cost_metrics,
)
from orthoflow_provenance.record import plain_fields
from prov.constants import PROV, PROV_ROLE
from prov.identifier import Identifier, Namespace, QualifiedName
from prov.model import ProvDocument

from orthoflow.engine.durability import writing_to
from orthoflow.engine.journal import RECORD_FILE, cell_file_name
from orthoflow.errors import RecordError
from orthoflow.products import JsonValue
from orthoflow.records.runs import (
    FIGURES_FOLDER,
    GRAPH_FILE,
    METADATA_FILE,
    PRODUCTS_FOLDER,
    REPORT_FILE,
    RESOLVED_FILE,
    WORKFLOW_FILE,
    Run,
    copy_files,
    crate_texts,
    creating,
    described_file,
    encoded,
    environment_file,
    figure_files,
    pages_of,
    path_inside,
)
from orthoflow.records.seals import SIGNATURE_SUFFIX, page_of
from orthoflow.version import DISTRIBUTION

Entity: TypeAlias = dict[str, JsonValue]
NO_LICENSE: Final = "not specified: ask the author of these results"
_CRATE: Final = "https://w3id.org/ro/crate/1.1"
_WORKFLOW_CRATE: Final = "https://w3id.org/workflowhub/workflow-ro-crate/1.0"
_PROFILES: Final = {
    "https://w3id.org/ro/wfrun/process/0.5": "Process Run Crate",
    "https://w3id.org/ro/wfrun/workflow/0.5": "Workflow Run Crate",
    "https://w3id.org/ro/wfrun/provenance/0.5": "Provenance Run Crate",
    _WORKFLOW_CRATE: "Workflow RO-Crate",
}
_BIOSCHEMAS: Final = "https://bioschemas.org/profiles/ComputationalWorkflow/1.0-RELEASE"
_REQUIREMENTS: Final = "https://pip.pypa.io/en/stable/reference/requirements-file-format/"
_LANGUAGE: Final = "#orthoflow-workflow-format"
_ENGINE: Final = "#engine"
_RUN: Final = "#run"
_ORCID: Final = re.compile(r"https://orcid\.org/(\d{4}-){3}\d{3}[\dX]$")
_CONTEXT: Final[list[JsonValue]] = [
    f"{_CRATE}/context",
    "https://w3id.org/ro/terms/workflow-run/context",
    {"buildInstructions": "https://codemeta.github.io/terms/buildInstructions"},
]
# These properties of the crate, and of its other entities, are not derived from the record.
_FREE: Final = {"./": {"license", "author", "creator", "description"}, "": {"description"}}
_MEDIA_TYPES: Final = {".h5": "application/x-hdf5", ".tif": "image/tiff", ".yaml": "text/yaml"}
_UNIT_CODES: Final = {
    "s": "https://qudt.org/vocab/unit/SEC",
    "MiB": "https://qudt.org/vocab/unit/MebiBYTE",
    "1": "https://qudt.org/vocab/unit/UNITLESS",
}


def write_crate(
    run: Run,
    folder: Path,
    *,
    license_text: str = NO_LICENSE,
    author: str = "",
) -> tuple[Path, ...]:
    """Write a run as an RO-Crate: record, report, products, workflow and their metadata.

    Input files are referenced by their digests and not copied, because they may be large or may
    belong to somebody else. To include them, embed them in the record (see `write_embedded`).

    Args:
        run: the run.
        folder: existing folder, empty except for a record with embedded files.
        license_text: URL or name of the license of the results.
        author: author of the results, as name or ORCID; empty if unknown.

    Returns:
        The paths of the files, beginning with the metadata file.

    Raises:
        StoreError: the disk cannot be written to.
        RecordError: a name in the record is not allowed as a file name, a file has been replaced by
            a link, or a cell uses a product that no cell produced.
    """
    texts = crate_texts(run.record)
    for name, content in texts.items():
        _write(folder, name, content)
    names = [*texts, *_copy_files(run, folder)]
    known = {file.path: file for file in run.record.published}
    files = [known[name] if name in known else described_file(folder, name) for name in names]
    crate = crate_metadata(run.record, files, license_text=license_text, author=author)
    _write(folder, METADATA_FILE, encoded(json.dumps(crate, indent=1, ensure_ascii=False) + "\n"))
    return (folder / METADATA_FILE, *(path_inside(folder, name) for name in names))


def _write(folder: Path, name: str, content: bytes) -> None:
    with creating(folder, name) as stream:
        stream.write(content)


def _copy_files(run: Run, folder: Path) -> list[str]:
    is_new = run.path == folder / RECORD_FILE
    if not is_new:
        with writing_to(folder):
            shutil.copyfile(run.path, folder / RECORD_FILE)
    pages = [REPORT_FILE, *pages_of(run).values()]
    wanted = [*pages]
    # If the report was written with links, it refers to these files.
    wanted += [f"{FIGURES_FOLDER}/{name}" for name in (GRAPH_FILE, *figure_files(run, run.cells))]
    # The record and its signature may be in another folder than the other files.
    signature = f"{RECORD_FILE}{SIGNATURE_SUFFIX}"
    signed = copy_files(run.path.parent, folder, [signature], ()) if not is_new else ()
    wanted += [
        f"{PRODUCTS_FOLDER}/{cell_file_name(address)}/{file.name}"
        for address, files in run.files.items()
        for file in files
    ]
    # These published files, such as the table of all metrics, belong to no cell.
    wanted += [file.path for file in run.record.published if file.path.count("/") == 1]
    copied = copy_files(run.folder, folder, wanted, run.record.published)
    for page in set(pages) & set(copied) if is_new else ():
        text = path_inside(folder, page).read_text(encoding="utf-8")
        _write(folder, page, encoded(page_of(text, run)))
    return [RECORD_FILE, *signed, *copied]


def crate_metadata(
    record: RunRecord, files: Sequence[PublishedFile], *, license_text: str, author: str = ""
) -> dict[str, JsonValue]:
    """Describe a run and the files of its crate as JSON-LD.

    Args:
        record: record of the run.
        files: the files of the crate.
        license_text: URL or name of the license of the results.
        author: author of the results, as name or ORCID; empty if unknown.
    """
    crate = _Crate()
    cells = [cell for cell in record.cells if cell.status != "skipped"]
    crate.add(
        METADATA_FILE,
        "CreativeWork",
        about=_ref("./"),
        conformsTo=_refs((_CRATE, _WORKFLOW_CRATE)),
    )
    _add_run(crate, record, files, license_text)
    if author.strip():
        _add_author(crate, author.strip())
    _add_files(crate, record, files)
    taken = {product.source for cell in cells for product in cell.inputs.values()}
    given: dict[str, str] = {}
    for position, cell in enumerate(cells):
        _add_cell(crate, record, cell, position, given)
        for port, product in cell.outputs.items():
            source = f"{cell.address}.{port}"
            given[source] = f"{_tool_id(cell)}/out/{port}"
            if source not in taken:
                _add_final(crate, source, given[source], product)
    return {"@context": _CONTEXT, "@graph": list(crate.entities.values())}


def metadata_differences(
    record: RunRecord, files: Sequence[PublishedFile], stated: Mapping[str, Any]
) -> list[str]:
    """Compare the metadata of a crate with a record.

    The order of lists is ignored, and so are the properties that only the author of the crate
    knows: license, author, descriptions, persons and organizations.

    Args:
        record: record of the run.
        files: the files of the crate, according to the metadata.
        stated: the metadata of the crate.

    Returns:
        The entity and property of each difference.

    Raises:
        RecordError: a cell of the record uses a product that no cell produced.
    """
    made = crate_metadata(record, files, license_text="")
    differences = [] if stated.get("@context") == made["@context"] else ["@context"]
    expected = {entity["@id"]: entity for entity in _entities(made)}
    missing = dict.fromkeys(expected)
    for entity in _entities(stated):
        identifier = entity["@id"]
        missing.pop(identifier, None)
        if identifier in expected:
            known, free = expected[identifier], _FREE["./" if identifier == "./" else ""]
            differences += [
                f"{identifier} {name}"
                for name in dict.fromkeys([*known, *entity])
                if name not in free and _unordered(known.get(name)) != _unordered(entity.get(name))
            ]
        elif entity.get("@type") not in ("Person", "Organization"):
            differences.append(f"{identifier} (added)")
    return [*differences, *(f"{identifier} (missing)" for identifier in missing)]


def _entities(crate: Mapping[str, Any]) -> list[dict[str, Any]]:
    entities: list[dict[str, Any]] = crate["@graph"]
    return entities


def _unordered(value: Any) -> Any:
    return sorted(value, key=json.dumps) if isinstance(value, list) else value


class _Crate:
    def __init__(self) -> None:
        self.entities: dict[str, Entity] = {}

    def add(self, identifier: str, kind: JsonValue, /, **facts: JsonValue) -> str:
        """Add an entity. If it exists, add only missing properties and extend its lists."""
        entity = self.entities.setdefault(identifier, {"@id": identifier, "@type": kind})
        for name, value in facts.items():
            if name in entity and isinstance(value, list):
                self.extend(identifier, name, value)
            else:
                entity.setdefault(name, value)
        return identifier

    def extend(self, identifier: str, name: str, more: Iterable[JsonValue]) -> None:
        """Extend a list of an entity without duplicates, unless the entity does not exist."""
        if identifier in self.entities:
            known = self.entities[identifier].setdefault(name, [])
            assert isinstance(known, list)  # noqa: S101 - lists alone are extended
            known += [item for item in more if item not in known]

    def link(self, identifier: str, name: str, *targets: str) -> None:
        self.extend(identifier, name, _refs(targets))

    def formal(self, identifier: str, name: str, kind: str) -> str:
        return self.add(identifier, "FormalParameter", additionalType=kind, name=name)

    def connect(self, owner: str, identifier: str, source: str, target: str) -> None:
        self.add(
            identifier,
            "ParameterConnection",
            sourceParameter=_ref(source),
            targetParameter=_ref(target),
        )
        self.link(owner, "connection", identifier)


def _ref(identifier: str) -> dict[str, JsonValue]:
    return {"@id": identifier}


def _refs(identifiers: Iterable[str]) -> list[JsonValue]:
    return [_ref(identifier) for identifier in dict.fromkeys(identifiers)]


def _file_id(file: RecordedFile) -> str:
    """Return an id (RFC 6920) that identifies a file outside the crate by its content."""
    digest = base64.urlsafe_b64encode(bytes.fromhex(file.sha256)).decode().rstrip("=")
    return f"ni:///sha-256;{digest}"


def _product_id(product: RecordedProduct) -> str:
    return f"#product-{product.digest.removeprefix('sha256:')}"


def _tool_id(cell: RecordedCell) -> str:
    return f"#method-{cell.method}"


def _status(*, is_ok: bool) -> str:
    return f"http://schema.org/{'Completed' if is_ok else 'Failed'}ActionStatus"


def _value_type(value: JsonValue) -> str:
    return {bool: "Boolean", int: "Integer", float: "Float"}.get(type(value), "Text")


def _port_type(product: RecordedProduct) -> str:
    return "File" if product.type_name == "files" else "CreativeWork"


def _add_author(crate: _Crate, author: str) -> None:
    orcid = found[0] if (found := _ORCID.search(author)) else ""
    name = author.removesuffix(orcid).strip(" ,<(") or author
    person = crate.add(orcid or "#author", "Person", name=name)
    crate.add("./", "Dataset", author=_ref(person), creator=_ref(person))


def _add_run(
    crate: _Crate, record: RunRecord, files: Sequence[PublishedFile], license_text: str
) -> None:
    names = [file.path for file in files]
    crate.add(
        "./",
        "Dataset",
        name=f"{record.name}, run {record.run_id}",
        description=f"Run of the workflow {record.name} with {record.created_by}: "
        f"{len(record.cells)} steps, {record.status}. {RECORD_FILE} is the complete record. "
        f"{_how_to_read(record)}",
        datePublished=record.ended,
        license=license_text,
        conformsTo=_refs(_PROFILES),
        hasPart=_refs(names),
        mainEntity=_ref(WORKFLOW_FILE),
        mentions=_refs([_RUN]),
    )
    for profile, name in _PROFILES.items():
        crate.add(profile, "CreativeWork", name=name, version=profile.rpartition("/")[2])
    options = " ".join(record.overrides)
    note = f"ran with {options}" if options else "ran unchanged"
    crate.add(
        WORKFLOW_FILE,
        ["File", "SoftwareSourceCode", "ComputationalWorkflow", "HowTo"],
        name=record.name,
        description=f"The workflow as written by its author; it {note}. {RESOLVED_FILE} is the "
        "workflow that ran, with all parameters.",
        version=record.created_by,
        encodingFormat="text/yaml",
        conformsTo=_ref(_BIOSCHEMAS),
        programmingLanguage=_ref(_LANGUAGE),
        buildInstructions=_refs(environment_file(item.id) for item in record.environments),
        **{name: [] for name in ("hasPart", "step", "input", "output", "connection")},
    )
    crate.add(_LANGUAGE, "ComputerLanguage", name="orthoflow workflow", version="1")
    ran = [cell for cell in record.cells if cell.status != "skipped"]
    crate.add(
        _RUN,
        "CreateAction",
        name=f"run {record.run_id} of {record.name}",
        description=f"{len(ran)} steps, seed {record.seed}",
        instrument=_ref(WORKFLOW_FILE),
        startTime=record.started,
        endTime=record.ended,
        actionStatus=_status(is_ok=record.status == "ok"),
        object=_refs([RESOLVED_FILE]),
        result=_refs(
            [RECORD_FILE, *(name for name in names if name.startswith(f"{PRODUCTS_FOLDER}/"))]
        ),
    )
    if record.status == "failed":
        failed = [cell.address for cell in ran if cell.status == "failed"]
        crate.add(_RUN, "CreateAction", error=f"failed: {', '.join(failed)}")
    crate.add(
        "#orchestration",
        "OrganizeAction",
        name=f"orchestrate {record.name} with {record.created_by}",
        instrument=_ref(_ENGINE),
        startTime=record.started,
        endTime=record.ended,
        object=[],
        result=_ref(_RUN),
    )
    name, _, version = record.created_by.partition(" ")
    crate.add(
        _ENGINE,
        "SoftwareApplication",
        name=name,
        softwareVersion=version,
        description=f"Python package: pip install {DISTRIBUTION}=={version}; if no index "
        "has that version, ask the authors of this crate for its wheel or sources",
    )


def _add_files(crate: _Crate, record: RunRecord, files: Sequence[PublishedFile]) -> None:
    lists = {environment_file(item.id) for item in record.environments}
    for part in files:
        name = part.path
        facts: Entity = {"encodingFormat": _media_type(name)}
        facts |= {"contentSize": str(part.size_bytes), "sha256": part.sha256}
        title = name.rpartition("/")[2]
        if name in lists:
            title = "Python packages installed during the run"
            facts["conformsTo"] = _ref(_REQUIREMENTS)
        if name == RECORD_FILE:
            facts["description"] = _how_to_read(record)
        crate.add(name, "File", name=title, **facts)
    crate.add(_REQUIREMENTS, "WebPage", name="Requirements file format")
    for entry in record.inputs:
        if entry.files:
            given = crate.formal(f"{WORKFLOW_FILE}#inputs/{entry.name}", entry.name, "File")
            crate.link(WORKFLOW_FILE, "input", given)
        within: Entity = {"isPartOf": _ref(RECORD_FILE)} if entry.embedded else {}
        for file in entry.files:
            crate.add(
                _file_id(file),
                "File",
                name=file.name,
                contentSize=str(file.size_bytes),
                sha256=file.sha256,
                encodingFormat=_media_type(file.name),
                exampleOfWork=_refs([given]),
                **within,
            )
        named = [_file_id(file) for file in entry.files]
        crate.link("./", "hasPart", *named)
        crate.link(_RUN, "object", *named)


def _add_cell(
    crate: _Crate, record: RunRecord, cell: RecordedCell, position: int, given: dict[str, str]
) -> None:
    """Add a cell: its method, its step of the workflow, and its execution.

    Args:
        crate: crate to extend.
        record: record that contains the cell.
        cell: a cell that was executed.
        position: index of the cell in the run, starting at 0.
        given: `address.port` of the outputs of earlier cells -> ids of their formal parameters.
    """
    tool = _add_method(crate, cell)
    variant = cell.assignment.get(cell.step, "")
    title = f"{cell.step}{f'.{variant}' if variant else ''}"
    known = {item.id for item in record.environments}
    made_with = {"buildInstructions": _ref(environment_file(cell.environment))}
    step = crate.add(
        f"{WORKFLOW_FILE}#{title}",
        "HowToStep",
        name=title,
        position=str(position),
        workExample=_ref(tool),
        connection=[],
        **(made_with if cell.environment in known else {}),
    )
    crate.link(WORKFLOW_FILE, "hasPart", tool)
    crate.link(WORKFLOW_FILE, "step", step)
    action = _add_action(crate, cell)
    crate.link("./", "mentions", action)
    control = f"#control-of-{cell.address}"
    orchestrated = f"orchestrate {cell.address}"
    crate.add(
        control, "ControlAction", name=orchestrated, instrument=_ref(step), object=_ref(action)
    )
    crate.link("#orchestration", "object", control)
    files = {entry.name: entry.files for entry in record.inputs}
    for port, product in cell.inputs.items():
        owner, _, name = product.source.rpartition(".")
        if owner != "inputs" and product.source not in given:
            raise RecordError(
                f"according to the record, {product.source} was used, but no executed step "
                "produced it: `orthoflow verify` reports other contradictions"
            )
        source = f"{WORKFLOW_FILE}#inputs/{name}" if owner == "inputs" else given[product.source]
        target = f"{tool}/{port}"
        crate.connect(step, f"#connection-{step}-{source}-{target}", source, target)
        taken = [_product_id(product)]
        if owner == "inputs":
            taken = [_file_id(file) for file in files.get(name, ())]
        crate.link(action, "object", *taken)
        for one in taken:
            crate.link(one, "exampleOfWork", target)
    for name, value in cell.params.items():
        setting = crate.add(
            f"#setting-{cell.address}/{name}",
            "PropertyValue",
            name=name,
            value=value
            if isinstance(value, bool | int | float | str)
            else json.dumps(value, ensure_ascii=False),
            exampleOfWork=_refs([f"{tool}/{name}"]),
        )
        crate.link(action, "object", setting)
        if name in cell.params_set:
            of_step = crate.formal(f"{step}/{name}", f"{cell.step}.{name}", _value_type(value))
            crate.link(setting, "exampleOfWork", of_step)
            crate.link(WORKFLOW_FILE, "input", of_step)
            crate.link(_RUN, "object", setting)
            target = f"{tool}/{name}"
            crate.connect(step, f"#connection-{step}-{of_step}-{target}", of_step, target)


def _add_method(crate: _Crate, cell: RecordedCell) -> str:
    tool, origin = _tool_id(cell), f"#distribution-{cell.distribution}"
    version = cell.distribution_version
    crate.add(origin, "SoftwareApplication", name=cell.distribution, version=version)
    inputs = [
        *(
            crate.formal(f"{tool}/{port}", port, _port_type(one))
            for port, one in cell.inputs.items()
        ),
        *(crate.formal(f"{tool}/{name}", name, _value_type(v)) for name, v in cell.params.items()),
    ]
    outputs = [
        crate.formal(f"{tool}/out/{port}", port, _port_type(one))
        for port, one in cell.outputs.items()
    ]
    return crate.add(
        tool,
        "SoftwareApplication",
        name=cell.method,
        softwareVersion=f"{version}, result version {cell.result_version}",
        description=f"{cell.determinism} method of {cell.distribution}",
        input=_refs(inputs),
        output=_refs(outputs),
        softwareRequirements=_ref(origin),
        mainEntity=_ref(origin),
        citation=list(cell.citations),
    )


def _add_action(crate: _Crate, cell: RecordedCell) -> str:
    note = "computed in this run" if cell.status == "ok" else "failed in this run"
    if cell.cached_from:
        note = f"computed by the earlier run {cell.cached_from} and taken from the store"
    made = []
    for port, product in cell.outputs.items():
        made.append(
            crate.add(
                _product_id(product),
                "CreativeWork",
                name=f"{product.type_name} of {cell.address}",
                identifier=product.digest,
                additionalType=product.type_name,
                exampleOfWork=_refs([f"{_tool_id(cell)}/out/{port}"]),
                **({"isPartOf": _ref(RECORD_FILE)} if product.embedded else {}),
            )
        )
    for metric in cell.metrics:
        identifier, value = f"#metric-{cell.address}/{metric.name}", metric.value
        facts: Entity = {"name": metric.name, "unitText": metric.unit, "value": value}
        made.append(crate.add(identifier, "PropertyValue", **facts))
    costs = [
        crate.add(
            f"#cost-{cell.address}/{cost.name}",
            "PropertyValue",
            name=cost.name,
            propertyID=cost.name,
            unitCode=_UNIT_CODES[cost.unit],
            value=str(cost.value),
        )
        for cost in cost_metrics(cell)
    ]
    return crate.add(
        f"#run-of-{cell.address}",
        "CreateAction",
        name=f"{cell.method} as {cell.address}",
        description=note,
        instrument=_ref(_tool_id(cell)),
        startTime=cell.started,
        endTime=cell.ended,
        actionStatus=_status(is_ok=cell.status == "ok"),
        object=[],
        result=_refs(made),
        resourceUsage=_refs(costs),
        **({"error": cell.error_message} if cell.status == "failed" else {}),
    )


def _add_final(crate: _Crate, source: str, of_tool: str, product: RecordedProduct) -> None:
    output = crate.formal(f"{WORKFLOW_FILE}#out/{source}", source, "CreativeWork")
    crate.link(WORKFLOW_FILE, "output", output)
    crate.connect(WORKFLOW_FILE, f"#to-{output}", of_tool, output)
    crate.link(_product_id(product), "exampleOfWork", output)
    crate.link(_RUN, "result", _product_id(product))


def _how_to_read(record: RunRecord) -> str:
    packages = {DISTRIBUTION: record.created_by.partition(" ")[2]} | {
        cell.distribution: cell.distribution_version for cell in record.cells if cell.distribution
    }
    named = ", ".join(f"{name} {version}" for name, version in packages.items())
    given = [entry.embedded for entry in record.inputs if entry.files]
    source = "the input files" if given else "the record alone"
    if given and all(given):
        source += ", which are embedded in it"
    return (
        f"Install the Python packages of the run ({named}), from a package index or from wheels "
        f"provided by the authors of this crate. In this folder, `orthoflow verify {RECORD_FILE}` "
        "then checks that the record and the products have not changed since they were written, "
        f"`orthoflow show {RECORD_FILE}` summarises the record, and `orthoflow replay "
        f"{RECORD_FILE} -o ../again` recomputes it from {source}. Any HDF5 program can open the "
        f"record. Paths in {WORKFLOW_FILE} are those of the machine on which the workflow ran."
    )


def _media_type(name: str) -> str:
    known = _MEDIA_TYPES.get(Path(name).suffix.lower())
    return known or mimetypes.guess_type(name)[0] or "application/octet-stream"


# The type is `Any` because the `prov` library accepts many types as attribute values.
Attributes = list[tuple[QualifiedName | str | Identifier, Any]]
# Attribute names are in this namespace, and names of entities are in the namespace of the run.
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

    The entities are products, inputs with their files, and published files, all with digests. The
    activities are the executed cells with their method, version, parameters, seed, times and
    metrics. The agents are orthoflow and the distributions of the methods.
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
        _add_activity(document, cell)
    _add_published(document, record, cells)
    return document


def _add_workflow(document: ProvDocument, record: RunRecord) -> None:
    source, resolved = record.workflow_source, record.workflow_resolved
    facts = {"source": source, "resolved": resolved, "source_sha256": _sha256(source)}
    facts |= {"overrides": " ".join(record.overrides), "seed": str(record.seed)}
    plan = _attributes(PROV["Plan"], record.name, facts)
    document.entity(_name("workflow", "plan"), plan)
    for environment in record.environments:
        packages = json.dumps(dict(environment.packages), sort_keys=True)
        stated = {**plain_fields(environment), "packages": packages}
        name = _name("environment", environment.id)
        document.entity(name, _attributes(_type("Environment"), "", stated))


def _add_inputs(document: ProvDocument, record: RunRecord) -> None:
    known: set[str] = set()
    for entry in record.inputs:
        if not entry.files:
            continue
        name = _name("input", entry.name)
        document.entity(name, _attributes(PROV["Collection"], entry.name, {}))
        for file in entry.files:
            member = _name("file", file.sha256)
            if member not in known:
                known.add(member)
                facts = _attributes(_type("InputFile"), file.name, plain_fields(file))
                document.entity(member, facts)
            document.membership(name, member)


def _add_software(document: ProvDocument, record: RunRecord, cells: Iterable[RecordedCell]) -> None:
    program = record.created_by
    for name in dict.fromkeys([program, *map(_distribution, cells)]):
        title, _, version = name.rpartition(" ")
        facts = {"name": title or name, "version": version if title else ""}
        document.agent(_name("software", name), _attributes(PROV["SoftwareAgent"], name, facts))
        if name != program:
            document.delegation(_name("software", name), _name("software", program))


def _add_activity(document: ProvDocument, cell: RecordedCell) -> None:
    name = _name("cell", cell.address)
    attributes = _attributes(_type("Cell"), cell.address, plain_fields(cell))
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
        facts = _attributes(_type("Product"), product.type_name, plain_fields(product))
        document.entity(made, facts)
        document.generation(made, name, cell.ended or None, other_attributes={PROV_ROLE: port})
        for source in dict.fromkeys(_source(product) for product in cell.inputs.values()):
            document.derivation(made, source, name)


def _add_published(
    document: ProvDocument, record: RunRecord, cells: Iterable[RecordedCell]
) -> None:
    owners = {f"{PRODUCTS_FOLDER}/{cell_file_name(cell.address)}": cell.address for cell in cells}
    for file in record.published:
        name = _name("published", file.path)
        facts = _attributes(_type("PublishedFile"), file.path, plain_fields(file))
        document.entity(name, facts)
        owner = owners.get(file.path.rpartition("/")[0])
        if owner is not None:
            document.generation(name, _name("cell", owner))


def _source(product: RecordedProduct) -> str:
    owner, _, name = product.source.partition(".")
    return _name("input", name) if owner == "inputs" else _name("product", product.source)


def _distribution(cell: RecordedCell) -> str:
    return f"{cell.distribution} {cell.distribution_version}".strip() or "unknown"


def _type(name: str) -> QualifiedName:
    return Namespace("orthoflow", _TERMS)[name]


def _name(part: str, name: str) -> str:
    """Return a qualified name; characters that are not allowed in a local name become %XX."""
    return f"{part}:{quote(name, safe='') or '_'}"


def _attributes(kind: QualifiedName, label: str, facts: Mapping[str, str | float]) -> Attributes:
    known = [("prov:label", label), *((_name("orthoflow", key), facts[key]) for key in facts)]
    return [("prov:type", kind), *(item for item in known if item[1] != "")]


def _literal(value: JsonValue) -> JsonValue:
    if isinstance(value, bool | int | float | str):
        return value
    return json.dumps(value, ensure_ascii=False)


def _sha256(text: str) -> str:
    return hashlib.sha256(encoded(text)).hexdigest()
