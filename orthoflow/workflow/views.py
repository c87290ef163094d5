"""Representations of a workflow: JSON for records, a JSON Schema for editors, and a flowchart."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

from pydantic import AfterValidator, BaseModel, Field, TypeAdapter, ValidationError
from pydantic.json_schema import GenerateJsonSchema

from orthoflow.catalog.catalog import Catalog
from orthoflow.errors import PluginError, WorkflowError
from orthoflow.products.product import JsonValue
from orthoflow.sdk.methods import Method, port_specs
from orthoflow.workflow.model import (
    FORMAT,
    INPUTS,
    Comparison,
    Dataset,
    StepVariant,
    SweepSection,
    Workflow,
    WorkflowFile,
    WorkflowInputSpec,
    WorkflowStep,
    check_name,
    factors_of,
    is_acyclic,
)

# The values are JSON.
Schema: TypeAlias = dict[str, Any]
_SWEEP: Final = {"$ref": "#/$defs/SweepSection"}
# If a sweep is allowed, these parts of a parameter's schema remain at the top level, where editors
# look for them.
_SHOWN: Final = ("description", "default")


class _Untitled(GenerateJsonSchema):
    """Omits the titles that pydantic generates from field names; they are useless in editors."""

    def field_title_should_be_set(self, schema: object) -> bool:
        return False


def workflow_schema(catalog: Catalog) -> dict[str, JsonValue]:
    """Return the JSON Schema (2020-12) of workflows, for editors and other programs.

    Methods that cannot be loaded are omitted. The schema is intended for completion. It checks less
    than `load_workflow`: it checks neither relations between keys nor whether references and ports
    match.
    """
    methods = list(_loadable(catalog))
    schema = WorkflowFile.model_json_schema(by_alias=True, schema_generator=_Untitled)
    defs: Schema = schema["$defs"]
    defs["SweepSection"] = SweepSection.model_json_schema(schema_generator=_Untitled)
    for info in methods:
        params = info.Params.model_json_schema(schema_generator=_Untitled)
        defs |= {
            f"{info.id}.{name}": _renamed(inner, info)
            for name, inner in params.pop("$defs", {}).items()
        }
        properties = params.get("properties", {})
        params["properties"] = {name: _or_sweep(inner) for name, inner in properties.items()}
        defs[info.id] = _renamed(params, info)
    # Steps and variants share one definition per method.
    defs["parameters"] = {
        "allOf": [
            {
                "if": {"required": ["use"], "properties": {"use": {"const": info.id}}},
                "then": {"properties": {"params": {"$ref": f"#/$defs/{info.id}"}}},
            }
            for info in methods
        ]
    }
    step, call = defs["StepSection"], defs["CallSection"]
    for section, chosen in (
        (step, methods),
        (call, [info for info in methods if not _is_source(info, catalog)]),
    ):
        use = section["properties"]["use"]
        section["properties"]["use"] = {
            "enum": [info.id for info in chosen],
            "description": use["description"],
        }
        section["allOf"] = [{"$ref": "#/$defs/parameters"}]
    schema["required"] = ["orthoflow", "steps"]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "orthoflow workflow",
        **schema,
    }


def _loadable(catalog: Catalog) -> Iterator[type[Method]]:
    for method_id in sorted(catalog.methods):
        try:
            yield catalog.method(method_id).load()
        except PluginError:
            continue


def _is_source(method: type[Method], catalog: Catalog) -> bool:
    kind = catalog.methods[method.id].kind
    return kind is not None and kind.is_source


def _renamed(schema: Any, info: type[Method]) -> Any:
    if isinstance(schema, dict):
        return {
            key: f"#/$defs/{info.id}.{value.rpartition('/')[2]}"
            if key == "$ref" and value != _SWEEP["$ref"]
            else _renamed(value, info)
            for key, value in schema.items()
        }
    return [_renamed(item, info) for item in schema] if isinstance(schema, list) else schema


def _or_sweep(schema: Schema) -> Schema:
    shown: Schema = {key: schema[key] for key in _SHOWN if key in schema}
    own = {key: value for key, value in schema.items() if key not in (*_SHOWN, "title")}
    choices = own.pop("anyOf") if set(own) == {"anyOf"} else [own]
    return {**shown, "anyOf": [*choices, _SWEEP]}


def mermaid(workflow: Workflow, catalog: Catalog) -> str:
    """Return a Mermaid flowchart with the inputs, steps, variants and connections.

    A dotted line shows a connection that may be unused because the port has several candidates, or
    an input on which a condition of the step depends. Ports that all methods of a step ignore are
    omitted.
    """
    # A name may be a reserved word of Mermaid, such as `end`, so names are used only as labels.
    nodes = {f"{INPUTS}.{name}": f"input{k}" for k, name in enumerate(workflow.inputs)}
    nodes |= {name: f"step{k}" for k, name in enumerate(workflow.steps)}
    lines = ["flowchart LR"]
    for name, spec in workflow.inputs.items():
        note = "<br/>optional" if spec.optional else ""
        if name in workflow.data_inputs:
            note = f"<br/>of {len(workflow.chosen_data)} datasets"
        lines.append(f'    {nodes[f"{INPUTS}.{name}"]}[/"{name}{note}"/]')
    for name, step in workflow.steps.items():
        label = "<br/>".join([f"<b>{name}</b>", *map(_call_label, step.variants)])
        lines.append(f'    {nodes[name]}["{label}"]')
    for step in workflow.steps.values():
        labels: dict[tuple[str, str], list[str]] = {}
        for source, arrow, label in _wires(step, catalog):
            labels.setdefault((source, arrow), []).append(label)
        for (source, arrow), ports in labels.items():
            text = ", ".join(dict.fromkeys(ports))
            lines.append(f'    {nodes[source]} {arrow}|"{text}"| {nodes[step.name]}')
    return "\n".join(lines) + "\n"


def _call_label(variant: StepVariant) -> str:
    name = f"{variant.name}: " if variant.name else ""
    repeat = f", {variant.repeat} times" if variant.repeat > 1 else ""
    return f"{name}{variant.method}{repeat}"


def _wires(step: WorkflowStep, catalog: Catalog) -> Iterator[tuple[str, str, str]]:
    taken = {
        port
        for variant in step.variants
        for port in port_specs(catalog.method(variant.method).load().In)
    }
    for port, references in step.inputs.items():
        for reference in references if port in taken else ():
            source = str(reference) if reference.is_input else reference.source
            yield source, "-->" if len(references) == 1 else "-.->", port
    for name, word in ((step.only_if, "if"), (step.unless, "unless")):
        if name:
            yield f"{INPUTS}.{name}", "-.->", word


_STEP: Final = TypeAdapter(WorkflowStep)
_PLACE: Final = "the resolved workflow"


class _ResolvedInput(BaseModel):
    files: tuple[str, ...]
    optional: bool

    def spec(self, name: str) -> WorkflowInputSpec:
        return WorkflowInputSpec(name=name, files=self.files, optional=self.optional)


class _ResolvedDataset(BaseModel):
    inputs: dict[str, _ResolvedInput]
    sets: dict[str, Any] = Field(alias="set")
    seeds: tuple[int, ...] = ()


_ResolvedName: TypeAlias = Annotated[str, AfterValidator(check_name)]


class _Resolved(BaseModel):
    """The resolved form of a workflow, which is untrusted because it is read from records."""

    orthoflow: Literal[1]
    name: _ResolvedName
    seed: int
    seeds: tuple[int, ...] = ()
    inputs: dict[_ResolvedName, _ResolvedInput]
    steps: dict[_ResolvedName, WorkflowStep]
    compare: Comparison | None
    overrides: tuple[str, ...]
    datasets: dict[_ResolvedName, _ResolvedDataset] = {}


def resolved_json(workflow: Workflow) -> str:
    """Return the workflow, including all defaults and overrides, as canonical JSON.

    Paths from the command line are reduced to their last part, because records must not contain
    folders of the user's machine.
    """
    document: dict[str, object] = {
        "orthoflow": FORMAT,
        "name": workflow.name,
        "seed": workflow.seed,
        "inputs": {name: _input_json(spec) for name, spec in workflow.inputs.items()},
        "steps": {
            name: _STEP.dump_python(step, mode="json", by_alias=True)
            for name, step in workflow.steps.items()
        },
        "compare": workflow.compare.model_dump() if workflow.compare else None,
        "overrides": list(workflow.overrides),
    }
    if workflow.seeds:
        document["seeds"] = list(workflow.seeds)
    if workflow.datasets:
        document["datasets"] = {
            item.name: {
                "inputs": {name: _input_json(spec) for name, spec in item.inputs.items()},
                "set": dict(item.sets),
                **({"seeds": list(item.seeds)} if item.seeds else {}),
            }
            for item in workflow.chosen_data
        }
    return json.dumps(
        document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def _input_json(spec: WorkflowInputSpec) -> JsonValue:
    def recorded(name: str) -> str:
        # The record contains the text of the workflow, and thus its paths, but not the absolute
        # paths in a table of datasets.
        is_private = spec.is_given or (spec.table and Path(name).is_absolute())
        return Path(name).name if is_private else name

    return {"files": [recorded(name) for name in spec.files], "optional": spec.optional}


def workflow_from_resolved(resolved: str, source: str) -> Workflow:
    """Restore a workflow from its resolved form in a record; no plugins are needed.

    Args:
        resolved: JSON text from `resolved_json`.
        source: text of the workflow file as written.

    Raises:
        WorkflowError: the text is not a resolved workflow, or its format is newer.
    """
    try:
        workflow = _from_resolved(_Resolved.model_validate_json(resolved, strict=True), source)
        _check_resolved(workflow)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise WorkflowError(f"{_PLACE} cannot be read: {place}: {first['msg']}") from error
    except (ValueError, KeyError, RecursionError) as error:
        raise WorkflowError(f"{_PLACE} cannot be read: {type(error).__name__} {error}") from error
    return workflow


def _from_resolved(document: _Resolved, source: str) -> Workflow:
    return Workflow(
        name=document.name,
        path=Path(f"{document.name}.yaml"),
        source=source,
        seed=document.seed,
        seeds=document.seeds,
        inputs={name: given.spec(name) for name, given in document.inputs.items()},
        steps={name: replace(step, name=name) for name, step in document.steps.items()},
        compare=document.compare,
        overrides=document.overrides,
        datasets={
            data: Dataset(
                name=data,
                inputs={name: item.spec(f"{name}@{data}") for name, item in given.inputs.items()},
                sets=given.sets,
                seeds=given.seeds,
            )
            for data, given in document.datasets.items()
        },
    )


def _check_resolved(workflow: Workflow) -> None:
    """Repeat the checks of a workflow file, because a record may have been changed.

    Raises:
        ValueError: a value is out of range, or refers to something that does not exist.
    """
    factors = factors_of(workflow)
    for dataset in workflow.datasets.values():
        if unknown := dataset.inputs.keys() - workflow.inputs.keys():
            raise ValueError(f"dataset {dataset.name} refers to an unknown input {min(unknown)!r}")
    if taken := factors & workflow.steps.keys():
        raise ValueError(f"a step must not be called {min(taken)}, which is reserved in addresses")
    for step in workflow.steps.values():
        _check_resolved_step(workflow, step)
    if not is_acyclic({name: step.upstream() for name, step in workflow.steps.items()}):
        raise ValueError("its steps form a cycle")
    compare = workflow.compare or Comparison()
    named = [pair for one in (compare.baseline, *compare.exclude) for pair in one.items()]
    for name, variant in named:
        if name not in factors and variant not in [
            one.name for one in workflow.steps[name].variants
        ]:
            raise ValueError(f"step {name} has no variant of the comparison")


def _check_resolved_step(workflow: Workflow, step: WorkflowStep) -> None:
    if not step.variants or not (step.is_varied or len(step.variants) == 1):
        raise ValueError(f"step {step.name} has {len(step.variants)} variants")
    if not step.is_varied and step.variants[0].name:
        raise ValueError(f"step {step.name} has a variant, but is marked as having none")
    for variant in step.variants if step.is_varied else ():
        check_name(variant.name)
    if len({variant.name for variant in step.variants}) != len(step.variants):
        raise ValueError(f"step {step.name} has two variants with the same name")
    if not step.conditions <= workflow.inputs.keys():
        raise ValueError(f"step {step.name} depends on an unknown input")
    for reference in step.references:
        known = workflow.inputs if reference.is_input else workflow.steps
        if (reference.name if reference.is_input else reference.source) not in known:
            raise ValueError(f"step {step.name} uses {reference}, which does not exist")
