"""A run as a Provenance Run Crate: a folder for workflow archives and their tools."""

from __future__ import annotations

import base64
import json
import mimetypes
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

from orthoflow_provenance.document import (
    RecordedCell,
    RecordedEnvironment,
    RecordedFile,
    RecordedProduct,
    RunRecord,
    cost_metrics,
)

from orthoflow.engine.durability import writing_to
from orthoflow.engine.journal import RECORD_FILE, cell_file_name
from orthoflow.errors import RecordError
from orthoflow.products.product import JsonValue
from orthoflow.records.datasets import pages_of
from orthoflow.records.published import PRODUCTS_FOLDER
from orthoflow.records.runs import (
    FIGURES_FOLDER,
    GRAPH_FILE,
    REPORT_FILE,
    Run,
    copy_files,
    creating,
    figure_files,
    path_inside,
)
from orthoflow.records.verification import SIGNATURE_SUFFIX, page_of
from orthoflow.version import DISTRIBUTION

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
    """Reference an entity."""
    return {"@id": identifier}


def refs(identifiers: Iterator[str] | tuple[str, ...]) -> list[JsonValue]:
    """Reference entities, each once."""
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
    """Schema.org's name for the type of a setting; non-scalars are written as JSON text."""
    names = {bool: "Boolean", int: "Integer", float: "Float"}
    return names.get(type(value), "Text")


def port_type(product: RecordedProduct) -> str:
    """Schema.org's name for the type of a port: files of the user, or products of the record."""
    return "File" if product.type_name == "files" else "CreativeWork"


def value_text(value: JsonValue) -> JsonValue:
    """Return a setting as a scalar."""
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
    """Methods with their ports and settings, and their distributions."""
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
    """The executions: an action per cell, its control, its settings, costs and metrics."""
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


NO_LICENSE: Final = "not stated: ask who made these results"
METADATA_FILE: Final = "ro-crate-metadata.json"
_CRATE: Final = "https://w3id.org/ro/crate/1.1"
_PROFILES: Final = {
    "https://w3id.org/ro/wfrun/process/0.5": "Process Run Crate",
    "https://w3id.org/ro/wfrun/workflow/0.5": "Workflow Run Crate",
    "https://w3id.org/ro/wfrun/provenance/0.5": "Provenance Run Crate",
    "https://w3id.org/workflowhub/workflow-ro-crate/1.0": "Workflow RO-Crate",
}
_WORKFLOW_CRATE: Final = "https://w3id.org/workflowhub/workflow-ro-crate/1.0"
_BIOSCHEMAS: Final = "https://bioschemas.org/profiles/ComputationalWorkflow/1.0-RELEASE"
_REQUIREMENTS: Final = "https://pip.pypa.io/en/stable/reference/requirements-file-format/"
_LANGUAGE: Final = "#orthoflow-workflow-format"
_ENGINE: Final = "#engine"
_ORCID: Final = re.compile(r"https://orcid\.org/(\d{4}-){3}\d{3}[\dX]$")
_RUN: Final = "#run"
_CONTEXT: Final[list[JsonValue]] = [
    f"{_CRATE}/context",
    "https://w3id.org/ro/terms/workflow-run/context",
    {"buildInstructions": "https://codemeta.github.io/terms/buildInstructions"},
]
_MEDIA_TYPES: Final = {".h5": "application/x-hdf5", ".tif": "image/tiff", ".yaml": "text/yaml"}


def write_crate(
    run: Run,
    folder: Path,
    *,
    license_text: str = NO_LICENSE,
    author: str = "",
    record: Run | None = None,
) -> tuple[Path, ...]:
    """Write a run as an RO-Crate: record, report, products, workflow and their description.

    Input files are named by their digests, not copied: they may be large, and property of others.
    An embedded record has them, see `write_embedded`.

    Args:
        run: the run.
        folder: existing folder, empty but for `record`.
        license_text: URL or name of the license of the results.
        author: who made the results, by name or ORCID; empty if unknown.
        record: the run with another record, which is in the folder already.

    Returns:
        The files, the description first.

    Raises:
        StoreError: the disk cannot be written.
        RecordError: a name in the record cannot be a file name, a link replaces a file, or a cell
            takes a product that none gave.
    """
    texts = {
        WORKFLOW_FILE: run.record.workflow_source,
        RESOLVED_FILE: run.record.workflow_resolved,
        **{
            environment_file(environment): "".join(
                f"{name}=={version}\n" for name, version in environment.packages.items()
            )
            for environment in run.record.environments
        },
    }
    for name, text in texts.items():
        _write(folder, name, text)
    names = [*texts, *_copy_files(run, folder, record or run)]
    crate = crate_metadata((record or run).record, names, license_text=license_text, author=author)
    _write(folder, METADATA_FILE, json.dumps(crate, indent=1, ensure_ascii=False) + "\n")
    return (folder / METADATA_FILE, *(path_inside(folder, name) for name in names))


def _write(folder: Path, name: str, text: str) -> None:
    with creating(folder, name) as stream:
        # Unpaired surrogates, which parameters may contain, as JSON writes them.
        stream.write(text.encode("utf-8", "backslashreplace"))


def _copy_files(run: Run, folder: Path, record: Run) -> list[str]:
    """Copy record, report with its figures and published files; return their paths in the crate."""
    if record.path != folder / RECORD_FILE:
        with writing_to(folder):
            shutil.copyfile(record.path, folder / RECORD_FILE)
    pages = [REPORT_FILE, *pages_of(run).values()]
    wanted = [*pages]
    # Linked from the report, if it was written with them.
    wanted += [f"{FIGURES_FOLDER}/{name}" for name in (GRAPH_FILE, *figure_files(run, run.cells))]
    signed: tuple[str, ...] = ()
    if record is run and run.path.name == RECORD_FILE:
        # Recreated rasters are in a folder of their own.
        signature = f"{RECORD_FILE}{SIGNATURE_SUFFIX}"
        signed = copy_files(run.path.parent, folder, [signature], ())
    wanted += [
        f"{PRODUCTS_FOLDER}/{cell_file_name(address)}/{file.name}"
        for address, files in run.files.items()
        for file in files
    ]
    # Of no cell, such as the table of all metrics.
    wanted += [file.path for file in run.record.published if file.path.count("/") == 1]
    copied = copy_files(run.folder, folder, wanted, run.record.published)
    for page in set(pages) & set(copied) if record is not run else ():
        text = path_inside(folder, page).read_text(encoding="utf-8")
        _write(folder, page, page_of(text, record))
    return [RECORD_FILE, *signed, *copied]


def crate_metadata(
    record: RunRecord, files: list[str], *, license_text: str, author: str = ""
) -> dict[str, JsonValue]:
    """Describe a run and the files of its crate as JSON-LD.

    Args:
        record: of the run.
        files: paths in the crate, with `/`.
        license_text: URL or name of the license of the results.
        author: who made the results, by name or ORCID; empty if unknown.
    """
    crate = _Crate(
        record=record, files=tuple(files), license_text=license_text, author=author.strip()
    )
    return {"@context": _CONTEXT, "@graph": list(crate.graph())}


@dataclass(frozen=True, kw_only=True)
class _Crate:
    """One crate: the entities that represent the run as a whole."""

    record: RunRecord
    files: tuple[str, ...]
    license_text: str
    author: str

    def graph(self) -> Iterator[Entity]:
        """Return all entities, the descriptor and the root first."""
        yield {
            "@id": METADATA_FILE,
            "@type": "CreativeWork",
            "about": ref("./"),
            "conformsTo": refs((_CRATE, _WORKFLOW_CRATE)),
        }
        yield self._root()
        if self.author:
            name = self.author.removesuffix(self._orcid).strip(" ,<(")
            yield {"@id": self._author_id, "@type": "Person", "name": name or self.author}
        for profile, name in _PROFILES.items():
            version = profile.rpartition("/")[2]
            yield {"@id": profile, "@type": "CreativeWork", "name": name, "version": version}
        yield self._workflow()
        yield {
            "@id": _LANGUAGE,
            "@type": "ComputerLanguage",
            "name": "orthoflow workflow",
            "version": "1",
        }
        yield from self._steps()
        yield from self._formals()
        yield from self._plain_files()
        yield from self._input_files()
        yield from self._products()
        yield from self._run()
        yield from method_entities(self.record)
        yield from cell_entities(self.record)

    @property
    def _cells(self) -> tuple[RecordedCell, ...]:
        return ran(self.record)

    def _root(self) -> Entity:
        record = self.record
        root: Entity = {
            "@id": "./",
            "@type": "Dataset",
            "name": f"{record.name}, run {record.run_id}",
            "description": f"Run of the workflow {record.name} with {record.created_by}: "
            f"{len(record.cells)} steps, {record.status}. {RECORD_FILE} is the record of all of "
            f"it. {_how_to_read(record)}",
            "datePublished": record.ended,
            "license": self.license_text,
            "conformsTo": refs(tuple(_PROFILES)),
            "hasPart": refs((*self.files, *self._input_ids())),
            "mainEntity": ref(WORKFLOW_FILE),
            "mentions": refs((_RUN, *(action_id(cell) for cell in self._cells))),
        }
        if self.author:
            root["author"] = root["creator"] = ref(self._author_id)
        return root

    @property
    def _author_id(self) -> str:
        return self._orcid or "#author"

    @property
    def _orcid(self) -> str:
        found = _ORCID.search(self.author)
        return found[0] if found else ""

    def _input_ids(self) -> tuple[str, ...]:
        return tuple(file_id(file) for entry in self.record.inputs for file in entry.files)

    def _workflow(self) -> Entity:
        options = " ".join(self.record.overrides)
        said = f"ran with {options}" if options else "ran as it stands"
        return {
            "@id": WORKFLOW_FILE,
            "@type": ["File", "SoftwareSourceCode", "ComputationalWorkflow", "HowTo"],
            "name": self.record.name,
            "description": f"The workflow as its author wrote it; it {said}. {RESOLVED_FILE} has "
            "what ran, with every parameter.",
            "version": self.record.created_by,
            "encodingFormat": "text/yaml",
            "conformsTo": ref(_BIOSCHEMAS),
            "programmingLanguage": ref(_LANGUAGE),
            "hasPart": refs(tuple(tool_id(cell) for cell in self._cells)),
            "step": refs(tuple(step_id(cell) for cell in self._cells)),
            "input": refs(tuple(str(entity["@id"]) for entity in self._workflow_inputs())),
            "output": refs(tuple(_output_id(source) for source in self._final)),
            "connection": refs(tuple(f"#to-{_output_id(source)}" for source in self._final)),
            "buildInstructions": refs(self._environment_files()),
        }

    @property
    def _final(self) -> dict[str, tuple[RecordedCell, str]]:
        """Return outputs that no other cell takes, by `address.port`."""
        taken = {product.source for cell in self._cells for product in cell.inputs.values()}
        return {
            f"{cell.address}.{port}": (cell, port)
            for cell in self._cells
            for port in cell.outputs
            if f"{cell.address}.{port}" not in taken
        }

    def _environment_files(self) -> tuple[str, ...]:
        return tuple(environment_file(item) for item in self.record.environments)

    def _workflow_inputs(self) -> Iterator[Entity]:
        for entry in self.record.inputs:
            if entry.files:
                yield formal(_input_id(entry.name), entry.name, "File")
        seen: set[str] = set()
        for cell in self._cells:
            step = step_id(cell)
            for name in cell.params_set:
                identifier = formal_id(step, name)
                if identifier not in seen and name in cell.params:
                    seen.add(identifier)
                    kind = value_type(cell.params[name])
                    yield formal(identifier, f"{cell.step}.{name}", kind)

    def _formals(self) -> Iterator[Entity]:
        yield from self._workflow_inputs()
        for source, (cell, port) in self._final.items():
            yield formal(_output_id(source), source, "CreativeWork")
            tool = formal_id(tool_id(cell), f"out/{port}")
            yield _connection(f"#to-{_output_id(source)}", tool, _output_id(source))

    def _steps(self) -> Iterator[Entity]:
        environments = {item.id: environment_file(item) for item in self.record.environments}
        outputs = {
            f"{cell.address}.{port}": formal_id(tool_id(cell), f"out/{port}")
            for cell in self._cells
            for port in cell.outputs
        }
        steps: dict[str, Entity] = {}
        connections: dict[str, Entity] = {}
        for position, cell in enumerate(self._cells):
            step, tool = step_id(cell), tool_id(cell)
            targets = {
                _source_id(product.source, outputs): formal_id(tool, port)
                for port, product in cell.inputs.items()
            }
            targets |= {
                formal_id(step, name): formal_id(tool, name)
                for name in cell.params_set
                if name in cell.params
            }
            made = {
                f"#connection-{step}-{source}-{target}": _connection(
                    f"#connection-{step}-{source}-{target}", source, target
                )
                for source, target in targets.items()
            }
            connections |= made
            known = steps.setdefault(
                step,
                {
                    "@id": step,
                    "@type": "HowToStep",
                    "name": step.partition("#")[2],
                    "position": str(position),
                    "workExample": ref(tool),
                    "connection": [],
                },
            )
            known["connection"] = _joined(known["connection"], made)
            if cell.environment in environments:
                known["buildInstructions"] = ref(environments[cell.environment])
        yield from (*steps.values(), *connections.values())

    def _plain_files(self) -> Iterator[Entity]:
        lists = set(self._environment_files())
        published = {file.path: file for file in self.record.published}
        for name in self.files:
            if name == WORKFLOW_FILE:
                continue
            entity: Entity = {"@id": name, "@type": "File", "name": name.rpartition("/")[2]}
            entity["encodingFormat"] = _media_type(name)
            if name in lists:
                entity["conformsTo"] = ref(_REQUIREMENTS)
                entity["name"] = "Python packages that were installed"
            if name == RECORD_FILE:
                entity["description"] = _how_to_read(self.record)
            if name in published:
                entity["contentSize"] = str(published[name].size_bytes)
                entity["sha256"] = published[name].sha256
            yield entity
        yield {"@id": _REQUIREMENTS, "@type": "WebPage", "name": "Requirements file format"}

    def _input_files(self) -> Iterator[Entity]:
        ports: dict[str, list[str]] = {}
        for cell in self._cells:
            for port, product in cell.inputs.items():
                owner, _, name = product.source.rpartition(".")
                if owner == "inputs":
                    target = formal_id(tool_id(cell), port)
                    ports.setdefault(name, []).append(target)
        found: dict[str, Entity] = {}
        for entry in self.record.inputs:
            examples = (_input_id(entry.name), *ports.get(entry.name, ()))
            for file in entry.files:
                entity = found.setdefault(
                    file_id(file),
                    {
                        "@id": file_id(file),
                        "@type": "File",
                        "name": file.name,
                        "contentSize": str(file.size_bytes),
                        "sha256": file.sha256,
                        "encodingFormat": _media_type(file.name),
                        "exampleOfWork": [],
                    },
                )
                entity["exampleOfWork"] = _joined(entity["exampleOfWork"], examples)
                if entry.embedded:
                    entity["isPartOf"] = ref(RECORD_FILE)
        yield from found.values()

    def _products(self) -> Iterator[Entity]:
        found: dict[str, Entity] = {}
        examples: dict[str, list[str]] = {}
        final = self._final
        for cell in self._cells:
            tool = tool_id(cell)
            for port, product in cell.inputs.items():
                examples.setdefault(product_id(product), []).append(formal_id(tool, port))
            for port, product in cell.outputs.items():
                identifier = product_id(product)
                source = f"{cell.address}.{port}"
                named = [formal_id(tool, f"out/{port}")]
                named += [_output_id(source)] if source in final else []
                examples.setdefault(identifier, []).extend(named)
                entity = found.setdefault(
                    identifier,
                    {
                        "@id": identifier,
                        "@type": "CreativeWork",
                        "name": f"{product.type_name} of {cell.address}",
                        "identifier": product.digest,
                        "additionalType": product.type_name,
                    },
                )
                if product.embedded:
                    entity["isPartOf"] = ref(RECORD_FILE)
        for identifier, entity in found.items():
            entity["exampleOfWork"] = refs(tuple(examples[identifier]))
            yield entity

    def _run(self) -> Iterator[Entity]:
        record = self.record
        settings = tuple(
            f"#setting-{cell.address}/{name}"
            for cell in self._cells
            for name in cell.params_set
            if name in cell.params
        )
        results = [product_id(cell.outputs[port]) for cell, port in self._final.values()]
        published = [name for name in self.files if name.startswith(f"{PRODUCTS_FOLDER}/")]
        content: Entity = {
            "@id": _RUN,
            "@type": "CreateAction",
            "name": f"run {record.run_id} of {record.name}",
            "description": f"{len(self._cells)} steps, seed {record.seed}",
            "instrument": ref(WORKFLOW_FILE),
            "startTime": record.started,
            "endTime": record.ended,
            "actionStatus": status_of(is_ok=record.status == "ok"),
            "object": refs((*self._input_ids(), *settings, RESOLVED_FILE)),
            "result": refs((RECORD_FILE, *results, *published)),
        }
        if record.status == "failed":
            failed = [cell.address for cell in self._cells if cell.status == "failed"]
            content["error"] = f"failed: {', '.join(failed)}"
        yield content
        yield {
            "@id": "#orchestration",
            "@type": "OrganizeAction",
            "name": f"orchestrate {record.name} with {record.created_by}",
            "instrument": ref(_ENGINE),
            "startTime": record.started,
            "endTime": record.ended,
            "object": refs(tuple(f"#control-of-{cell.address}" for cell in self._cells)),
            "result": ref(_RUN),
        }
        name, _, version = record.created_by.partition(" ")
        yield {
            "@id": _ENGINE,
            "@type": "SoftwareApplication",
            "name": name,
            "softwareVersion": version,
            "description": f"Python package: pip install {DISTRIBUTION}=={version}, or, where no "
            "index has that version, of its wheel or sources, which those who made this crate have",
        }


def _how_to_read(record: RunRecord) -> str:
    """Return instructions for reading the record and checking the files of the crate."""
    version = record.created_by.partition(" ")[2]
    given = [entry.embedded for entry in record.inputs if entry.files]
    source = "the input files" if given else "it alone"
    if given and all(given):
        source += ", which lie in it"
    return (
        f"With the Python package {DISTRIBUTION} {version} (of an index, or its wheel from those "
        f"who made this crate) `orthoflow verify {RECORD_FILE}` in "
        "this folder says whether record and products are as they were written, `orthoflow show "
        f"{RECORD_FILE}` what it holds, `orthoflow replay {RECORD_FILE} -o ../again` computes it "
        f"anew from {source}; any HDF5 reader opens it, too. Paths in "
        f"{WORKFLOW_FILE} are of the machine that it ran on."
    )


def _input_id(name: str) -> str:
    return f"{WORKFLOW_FILE}#inputs/{name}"


def _output_id(source: str) -> str:
    return f"{WORKFLOW_FILE}#out/{source}"


def _source_id(source: str, outputs: Mapping[str, str]) -> str:
    """Return the formal parameter from which a port takes its product."""
    owner, _, name = source.rpartition(".")
    if owner == "inputs":
        return _input_id(name)
    if source not in outputs:
        raise RecordError(
            f"the record says that {source} was taken, which no step that ran gave: "
            "`orthoflow verify` says what else does not fit"
        )
    return outputs[source]


def _connection(identifier: str, source: str, target: str) -> Entity:
    return {
        "@id": identifier,
        "@type": "ParameterConnection",
        "sourceParameter": ref(source),
        "targetParameter": ref(target),
    }


def _joined(known: JsonValue, more: Iterable[str]) -> list[JsonValue]:
    """Add references to a list of references, each once."""
    before = (
        [str(item["@id"]) for item in known if isinstance(item, dict)]
        if isinstance(known, list)
        else []
    )
    return refs((*before, *more))


def _media_type(name: str) -> str:
    return (
        _MEDIA_TYPES.get(Path(name).suffix.lower())
        or mimetypes.guess_type(name)[0]
        or "application/octet-stream"
    )
