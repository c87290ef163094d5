"""A run as a Provenance Run Crate: a folder that workflow archives and their tools understand."""

from __future__ import annotations

import json
import mimetypes
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow_provenance.document import RecordedCell, RunRecord

from orthoflow.engine.durability import writing_to
from orthoflow.engine.journal import RECORD_FILE, cell_file_name
from orthoflow.errors import RecordError
from orthoflow.products.product import JsonValue
from orthoflow.records import crate_entities as entities
from orthoflow.records.crate_entities import (
    RESOLVED_FILE,
    WORKFLOW_FILE,
    Entity,
    environment_file,
    ref,
    refs,
)
from orthoflow.records.datasets import pages_of
from orthoflow.records.published import PRODUCTS_FOLDER
from orthoflow.records.run_files import copy_files, creating, figure_files, path_inside
from orthoflow.records.runs import FIGURES_FOLDER, GRAPH_FILE, REPORT_FILE, Run
from orthoflow.records.signatures import SIGNATURE_SUFFIX
from orthoflow.records.verification import page_of
from orthoflow.version import DISTRIBUTION

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

    Input files are named by their digests, not copied: they may be large, and others' property.
    An embedded record has them, see `write_embedded`.

    Args:
        run: the run.
        folder: existing folder, empty but for `record`.
        license_text: URL or name of the license of the results.
        author: who made the results, by name or ORCID; empty where nobody says it.
        record: the run with another record, which lies in the folder already.

    Returns:
        The files, the description first.

    Raises:
        StoreError: the disk refuses.
        RecordError: a name in the record cannot be that of a file, a link stands in the place of
            a file, or a cell takes what none gave.
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
        # Halves of letters, which parameters may have, as JSON writes them.
        stream.write(text.encode("utf-8", "backslashreplace"))


def _copy_files(run: Run, folder: Path, record: Run) -> list[str]:
    """Copy record, report with its figures and published files; give their paths in the crate."""
    if record.path != folder / RECORD_FILE:
        with writing_to(folder):
            shutil.copyfile(record.path, folder / RECORD_FILE)
    pages = [REPORT_FILE, *pages_of(run).values()]
    wanted = [*pages]
    # Which the report leads to, where it was written with them.
    wanted += [f"{FIGURES_FOLDER}/{name}" for name in (GRAPH_FILE, *figure_files(run, run.cells))]
    signed: tuple[str, ...] = ()
    if record is run and run.path.name == RECORD_FILE:
        # Rasters that were made anew lie in a folder of their own.
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
        author: who made the results, by name or ORCID; empty where nobody says it.
    """
    crate = _Crate(
        record=record, files=tuple(files), license_text=license_text, author=author.strip()
    )
    return {"@context": _CONTEXT, "@graph": list(crate.graph())}


@dataclass(frozen=True, kw_only=True)
class _Crate:
    """One crate: the entities that stand for the run as a whole."""

    record: RunRecord
    files: tuple[str, ...]
    license_text: str
    author: str

    def graph(self) -> Iterator[Entity]:
        """Give all entities, the descriptor and the root first."""
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
        yield from entities.method_entities(self.record)
        yield from entities.cell_entities(self.record)

    @property
    def _cells(self) -> tuple[RecordedCell, ...]:
        return entities.ran(self.record)

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
            "mentions": refs((_RUN, *(entities.action_id(cell) for cell in self._cells))),
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
        return tuple(entities.file_id(file) for entry in self.record.inputs for file in entry.files)

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
            "hasPart": refs(tuple(entities.tool_id(cell) for cell in self._cells)),
            "step": refs(tuple(entities.step_id(cell) for cell in self._cells)),
            "input": refs(tuple(str(entity["@id"]) for entity in self._workflow_inputs())),
            "output": refs(tuple(_output_id(source) for source in self._final)),
            "connection": refs(tuple(f"#to-{_output_id(source)}" for source in self._final)),
            "buildInstructions": refs(self._environment_files()),
        }

    @property
    def _final(self) -> dict[str, tuple[RecordedCell, str]]:
        """Outputs that no other cell takes, by `address.port`."""
        taken = {product.source for cell in self._cells for product in cell.inputs.values()}
        return {
            f"{cell.address}.{port}": (cell, port)
            for cell in self._cells
            for port in cell.outputs
            if f"{cell.address}.{port}" not in taken
        }

    def _environment_files(self) -> tuple[str, ...]:
        return tuple(entities.environment_file(item) for item in self.record.environments)

    def _workflow_inputs(self) -> Iterator[Entity]:
        for entry in self.record.inputs:
            if entry.files:
                yield entities.formal(_input_id(entry.name), entry.name, "File")
        seen: set[str] = set()
        for cell in self._cells:
            step = entities.step_id(cell)
            for name in cell.params_set:
                identifier = entities.formal_id(step, name)
                if identifier not in seen and name in cell.params:
                    seen.add(identifier)
                    kind = entities.value_type(cell.params[name])
                    yield entities.formal(identifier, f"{cell.step}.{name}", kind)

    def _formals(self) -> Iterator[Entity]:
        yield from self._workflow_inputs()
        for source, (cell, port) in self._final.items():
            yield entities.formal(_output_id(source), source, "CreativeWork")
            tool = entities.formal_id(entities.tool_id(cell), f"out/{port}")
            yield _connection(f"#to-{_output_id(source)}", tool, _output_id(source))

    def _steps(self) -> Iterator[Entity]:
        environments = {
            item.id: entities.environment_file(item) for item in self.record.environments
        }
        outputs = {
            f"{cell.address}.{port}": entities.formal_id(entities.tool_id(cell), f"out/{port}")
            for cell in self._cells
            for port in cell.outputs
        }
        steps: dict[str, Entity] = {}
        connections: dict[str, Entity] = {}
        for position, cell in enumerate(self._cells):
            step, tool = entities.step_id(cell), entities.tool_id(cell)
            targets = {
                _source_id(product.source, outputs): entities.formal_id(tool, port)
                for port, product in cell.inputs.items()
            }
            targets |= {
                entities.formal_id(step, name): entities.formal_id(tool, name)
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
                    target = entities.formal_id(entities.tool_id(cell), port)
                    ports.setdefault(name, []).append(target)
        found: dict[str, Entity] = {}
        for entry in self.record.inputs:
            examples = (_input_id(entry.name), *ports.get(entry.name, ()))
            for file in entry.files:
                entity = found.setdefault(
                    entities.file_id(file),
                    {
                        "@id": entities.file_id(file),
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
            tool = entities.tool_id(cell)
            for port, product in cell.inputs.items():
                examples.setdefault(entities.product_id(product), []).append(
                    entities.formal_id(tool, port)
                )
            for port, product in cell.outputs.items():
                identifier = entities.product_id(product)
                source = f"{cell.address}.{port}"
                named = [entities.formal_id(tool, f"out/{port}")]
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
        results = [entities.product_id(cell.outputs[port]) for cell, port in self._final.values()]
        published = [name for name in self.files if name.startswith(f"{PRODUCTS_FOLDER}/")]
        content: Entity = {
            "@id": _RUN,
            "@type": "CreateAction",
            "name": f"run {record.run_id} of {record.name}",
            "description": f"{len(self._cells)} steps, seed {record.seed}",
            "instrument": ref(WORKFLOW_FILE),
            "startTime": record.started,
            "endTime": record.ended,
            "actionStatus": entities.status_of(is_ok=record.status == "ok"),
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
    """Say how somebody who has the crate alone looks at the record and checks the files."""
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
    """Formal parameter that a port takes its product from."""
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
