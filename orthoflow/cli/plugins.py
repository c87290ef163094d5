"""`orthoflow plugins`: list, show and check methods, and write a plugin."""

from __future__ import annotations

import dataclasses
import inspect
import json
import os
import re
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from orthoflow.catalog.catalog import Announced, Catalog, MethodEntry
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.catalog.distributions import DistributionInfo
from orthoflow.cli.commands import (
    EXIT_CELL_FAILED,
    EXIT_GOOD,
    EXIT_PLUGIN_MISSING,
    Command,
    LazyCommand,
    LazyGroup,
    json_option,
)
from orthoflow.cli.tables import counted, echo, echo_json, echo_table
from orthoflow.errors import PluginError

if TYPE_CHECKING:
    from orthoflow.sdk import Method, MethodParams, MetricSpec, Ports

_SUMMARIES: Final = {
    "list": "List every method, and what is wrong with plugins that do not load.",
    "show": "Show a method's parameters, ports, origin and citations.",
    "new": "Write a plugin of your own that works and passes its tests at once.",
    "check": "Run the conformance suite on a method.",
}

plugins: Final[click.Command] = LazyGroup(
    name="plugins",
    help="List, show and check methods, and write a plugin of your own.",
    lazy={
        name: LazyCommand(target=f"orthoflow.cli.plugins:plugins_{name}", summary=summary)
        for name, summary in _SUMMARIES.items()
    },
)


@click.command("list", cls=Command)
@json_option
def plugins_list(*, as_json: bool) -> int:
    """List methods, kinds and product types, and what is wrong with plugins that do not load.

    `orthoflow plugins show PLUGIN` prints the traceback of one that is broken.
    """
    catalog = discover_catalog()
    methods = {name: entry.looked_at() for name, entry in catalog.methods.items()}
    catalog = replace(catalog, methods=methods)
    if as_json:
        echo_json(_catalog_json(catalog))
        return EXIT_GOOD
    echo_table(
        ("method", "state", "distribution", "summary"),
        [
            (
                entry.spec.id,
                entry.state,
                f"{entry.distribution.name} {entry.distribution.version}",
                entry.spec.summary,
            )
            for entry in catalog.methods.values()
        ],
    )
    echo()
    echo_table(
        ("kind", "takes", "gives", "distribution", "summary"),
        [
            (
                name,
                "its methods' own" if kind.spec.is_source else ", ".join(kind.spec.inputs),
                "its methods' own" if kind.spec.is_source else ", ".join(kind.spec.outputs),
                str(kind.distribution),
                kind.spec.summary,
            )
            for name, kind in catalog.kinds.items()
        ],
    )
    echo()
    echo_table(
        ("product", "distribution", "summary"),
        [
            (name, str(product.distribution), product.spec.summary)
            for name, product in catalog.products.items()
        ],
    )
    problems = [
        *(kind.problem for kind in catalog.kinds.values() if kind.problem),
        *(product.problem for product in catalog.products.values() if product.problem),
        *(entry.problem for entry in catalog.methods.values() if entry.problem),
        *(str(broken) for broken in catalog.broken),
    ]
    if problems:
        echo("", "what is wrong:")
    for problem in problems:
        echo(f"- {problem}")
    for broken in catalog.broken:
        echo(f"`orthoflow plugins show {broken.entry_point}` prints its traceback")
    return EXIT_GOOD


def _catalog_json(catalog: Catalog) -> dict[str, object]:
    return {
        "methods": [
            {
                "id": entry.spec.id,
                "kind": entry.spec.kind,
                **_announced_json(entry),
                "summary": entry.spec.summary,
            }
            for entry in catalog.methods.values()
        ],
        "kinds": [
            {
                "name": name,
                **_announced_json(kind),
                "in": dict(kind.spec.inputs),
                "out": dict(kind.spec.outputs),
                "is_source": kind.spec.is_source,
                "summary": kind.spec.summary,
            }
            for name, kind in catalog.kinds.items()
        ],
        "products": [
            {
                "name": name,
                **_announced_json(product),
                "summary": product.spec.summary,
            }
            for name, product in catalog.products.items()
        ],
        "broken": [
            {
                "plugin": broken.entry_point,
                "module": broken.module,
                "distribution": broken.distribution.name,
                "version": broken.distribution.version,
                "problem": str(broken),
                "traceback": broken.traceback,
            }
            for broken in catalog.broken
        ],
    }


def _announced_json(entry: Announced) -> dict[str, object]:
    return {
        "state": entry.state,
        "problem": entry.problem,
        "distribution": entry.distribution.name,
        "version": entry.distribution.version,
    }


@click.command("show", cls=Command)
@click.argument("method_id", metavar="ID")
@json_option
def plugins_show(method_id: str, *, as_json: bool) -> int:
    """Show the method ID, e.g. plane.hough2d: parameters, ports, origin and citations.

    Of a plugin or a method that does not load, its traceback is shown; ID may then be the plugin's
    name. Ends with 2 when there is no such method, with 4 when it cannot be used.
    """
    catalog = discover_catalog()
    if failure := _failure(catalog, method_id):
        _print_failure(failure, as_json=as_json)
        return EXIT_PLUGIN_MISSING
    entry = catalog.method(method_id)
    if as_json:
        echo_json(_method_json(entry))
    else:
        _print_method(entry, entry.load())
    return EXIT_GOOD


@dataclass(frozen=True, kw_only=True)
class _Failure:
    """Why a plugin or a method cannot be loaded.

    Attributes:
        problem: one sentence.
        distribution: who brought it.
        target: the module or class that does not load.
        traceback: of what it raised; empty when it loads and breaks a rule.
    """

    problem: str
    distribution: DistributionInfo
    target: str
    traceback: str


def _failure(catalog: Catalog, name: str) -> _Failure | None:
    entry = catalog.methods.get(name)
    if entry is None:
        for broken in catalog.broken:
            if name in (broken.entry_point, broken.distribution.name) or broken.mentions(name):
                return _Failure(
                    problem=str(broken),
                    distribution=broken.distribution,
                    target=broken.module,
                    traceback=broken.traceback,
                )
    elif entry.state == "fine":
        try:
            entry.load()
        except PluginError as error:
            cause = error.__cause__
            return _Failure(
                problem=str(error),
                distribution=entry.distribution,
                target=entry.spec.target,
                traceback="".join(traceback.format_exception(cause)) if cause else "",
            )
    return None


def _method_json(entry: MethodEntry) -> dict[str, object]:
    """Return everything that a method declares, as JSON.

    Raises:
        PluginError: the method's class cannot be loaded.
    """
    method = entry.load()
    return {
        "id": entry.spec.id,
        "summary": entry.spec.summary,
        "description": _docstring(method),
        "state": entry.state,
        "distribution": entry.distribution.name,
        "version": entry.distribution.version,
        "target": entry.spec.target,
        "result_version": method.result_version,
        "determinism": method.determinism,
        "citations": list(method.citations),
        "metrics": [dataclasses.asdict(one) for one in method.metric_specs()],
        "params": [
            {"name": name, "type": type_, "default": default, "unit": unit, "description": text}
            for name, type_, default, unit, text in _parameters(method.Params)
        ],
        "in": [
            {"port": port, "product": type_name, "required": required}
            for port, type_name, required in _ports(method.In)
        ],
        "out": [{"port": port, "product": type_name} for port, type_name, _ in _ports(method.Out)],
    }


def _print_failure(failure: _Failure, *, as_json: bool) -> None:
    if as_json:
        echo_json(
            {
                "state": "broken",
                "problem": failure.problem,
                "distribution": failure.distribution.name,
                "version": failure.distribution.version,
                "target": failure.target,
                "traceback": failure.traceback,
            }
        )
        return
    echo(failure.problem, "")
    echo(f"distribution  {failure.distribution}")
    echo("state         broken")
    echo(f"from          {failure.target}")
    if failure.traceback:
        echo("", *failure.traceback.rstrip().split("\n"))


def _print_method(entry: MethodEntry, method: type[Method]) -> None:
    echo(f"{entry.spec.id}: {entry.spec.summary}", "")
    if text := _docstring(method):
        echo(*text.split("\n"), "")
    echo(f"distribution  {entry.distribution.name} {entry.distribution.version}")
    echo(f"state         {entry.state}")
    echo(f"class         {entry.spec.target}")
    echo(f"determinism   {method.determinism}, result version {method.result_version}")
    for citation in method.citations:
        echo(f"citation      {citation}")
    echo()
    ports = [
        *(
            ("in", port, type_name, "" if required else "optional")
            for port, type_name, required in _ports(method.In)
        ),
        *(("out", port, type_name, "") for port, type_name, _ in _ports(method.Out)),
    ]
    echo_table(("port", "name", "product", ""), ports)
    if method.metrics:
        echo()
        echo_table(
            ("metric", "unit", "better", "what it is"),
            [(one.name, one.unit, one.better, _metric_text(one)) for one in method.metric_specs()],
        )
    parameters = _parameters(method.Params)
    echo(*([""] if parameters else ["", "no parameters"]))
    echo_table(
        ("parameter", "type", "default", "unit", "description"),
        [
            (name, type_, json.dumps(default) if default is not None else "", unit, text)
            for name, type_, default, unit, text in parameters
        ],
    )


def _metric_text(spec: MetricSpec) -> str:
    label = re.sub(r"\{\d\}", "...", spec.label)
    return ": ".join(part for part in (label, spec.description) if part)


def _docstring(method: type[Method]) -> str:
    return inspect.cleandoc(method.__doc__ or "")


def _parameters(params: type[MethodParams]) -> list[tuple[str, str, object, str, str]]:
    from orthoflow.sdk.units import unit_of

    schema = params.model_json_schema()
    definitions = schema.get("$defs", {})
    return [
        (
            name,
            _type_text(field, definitions),
            field.get("default"),
            unit_of(name),
            field.get("description", ""),
        )
        for name, field in schema.get("properties", {}).items()
    ]


def _type_text(field: dict[str, object], definitions: dict[str, dict[str, object]]) -> str:
    """Describe the type of a JSON Schema node in a few words, with its limits."""
    reference = field.get("$ref")
    if isinstance(reference, str):
        return _type_text(definitions.get(reference.rpartition("/")[2], {}), definitions)
    if isinstance(choices := field.get("enum"), list):
        return " | ".join(str(choice) for choice in choices)
    if "const" in field:
        return str(field["const"])
    if isinstance(alternatives := field.get("anyOf"), list):
        return " | ".join(_type_text(option, definitions) for option in alternatives)
    if field.get("type") == "array":
        items = field.get("items")
        inner = f" of {_type_text(items, definitions)}" if isinstance(items, dict) else ""
        return f"array{inner}"
    limits = "".join(
        f" {sign} {field[key]}"
        for key, sign in (
            ("minimum", ">="),
            ("exclusiveMinimum", ">"),
            ("maximum", "<="),
            ("exclusiveMaximum", "<"),
        )
        if key in field
    )
    return f"{field.get('type', 'any')}{limits}"


def _ports(ports: type[Ports]) -> list[tuple[str, str, bool]]:
    from orthoflow.sdk import port_specs

    return [(spec.name, spec.type_name, spec.required) for spec in port_specs(ports).values()]


@click.command("new", cls=Command)
@click.argument("name", metavar="NAME")
@click.option("--kind", default="", metavar="KIND", help="Kind of the method, e.g. plane.")
@click.option(
    "--new-kind", default="", metavar="KIND", help="A kind of its own instead, e.g. mark."
)
@click.option(
    "--takes",
    default="cloud",
    show_default=True,
    metavar="TYPES",
    help="Product types that methods of the new kind take, with commas between them.",
)
@click.option(
    "--gives",
    default="",
    metavar="TYPE",
    help="Product type that they give, of the plugin's own.  [default: KINDs]",
)
@click.option(
    "--folder",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    default=Path(),
    help="Where the folder NAME is made; the current one unless given.",
)
@click.option("--author", default="The authors", help="For pyproject, licence and citation.")
@click.option("--licence", default="MIT", show_default=True, help="SPDX expression.")
@click.option("--citation", default="", help="Where the method comes from: DOI, title or URL.")
@json_option
def plugins_new(
    name: str, *, as_json: bool, folder: Path, new_kind: str, takes: str, gives: str, **about: str
) -> int:
    """Write a plugin NAME that installs, works and passes its tests at once, e.g. my-detector.

    `orthoflow plugins list` names the kinds and the product types. The method does something
    simple; put your own in its place. With `--new-kind` the plugin brings a kind and a product
    type, too.
    """
    from orthoflow.scaffold import Project, write_project

    if about["kind"] and new_kind:
        raise click.UsageError(
            f"--kind {about['kind']} (a kind that is there) and --new-kind {new_kind} (a kind of "
            "its own) exclude each other: leave one of them away"
        )
    if not (about["kind"] or new_kind):
        raise click.UsageError(
            "give --kind, the kind of the method (`orthoflow plugins list`), or --new-kind"
        )
    types = (part.strip() for part in takes.split(",")) if new_kind else ()
    project = Project(
        name=name,
        kind=new_kind or about["kind"],
        author=about["author"],
        licence=about["licence"],
        citation=about["citation"],
        product=(gives or f"{new_kind}s") if new_kind else "",
        takes=tuple(dict.fromkeys(types)),
    )
    written = write_project(project, folder, discover_catalog())
    if as_json:
        echo_json({"method": project.method_id, "files": [str(path) for path in written]})
        return EXIT_GOOD
    for path in written:
        echo(f"wrote {path}")
    echo(
        "",
        f"next: cd {name}, python -m pip install -e '.[test]', python -m pytest; "
        f"then write {project.package}/method.py",
    )
    return EXIT_GOOD


@click.command("check", cls=Command)
@click.argument("method_id", metavar="ID")
@click.option(
    "--golden",
    type=click.Path(path_type=Path, dir_okay=False),
    help="File of golden digests; a method that it lacks is added.",
)
@click.option(
    "--quick",
    is_flag=True,
    help="Leave out what takes more than two runs of the method, and name it.",
)
@json_option
def plugins_check(method_id: str, *, as_json: bool, golden: Path | None, quick: bool) -> int:
    """Run every conformance check that applies to the method ID, and report the rules it breaks.

    With `--quick` those while you write it: parameters, outputs, inputs left as they were, progress
    and cancelling, two runs on one core and on two, clouds that must be refused. The others, before
    you hand it on: a run in a new process and an empty folder, wild input, what is known of the
    example.

    What stops every run is reported once, and other rules are skipped. Ends with 1 when a rule
    is broken, with 4 when the method cannot be loaded. What still stands as `plugins new` wrote it
    is named, and breaks no rule.
    """
    from orthoflow.scaffold import unwritten
    from orthoflow.testing import conformance_cases

    results: list[dict[str, str]] = []
    with _sharing_kernels(method_id):
        for case in conformance_cases(method_id, golden=golden):
            is_left_out = quick and not case.check.is_quick
            problem = "" if is_left_out else case.problem()
            name, rule = case.check.name, case.check.rule
            first = next((one["check"] for one in results if one["problem"] == problem != ""), "")
            state = "broken" if problem else "left out" if is_left_out else "kept"
            state, text = (
                ("skipped", f"stopped by the same as {first}") if first else (state, problem)
            )
            results.append({"check": name, "state": state, "rule": rule, "problem": problem})
            if not as_json:
                echo(f"{state:{8 if quick else 7}} {name}: {text or rule}")
    counts = Counter(result["state"] for result in results)
    left = unwritten(method_id, discover_catalog())
    if as_json:
        echo_json({"method": method_id, "checks": results, "unwritten": list(left)})
    else:
        summed = [f"{method_id} keeps {counted(counts['kept'], 'rule')}"]
        summed += [f"breaks {counts['broken']}"] if counts["broken"] else []
        summed += [f"{counts['skipped']} skipped"] if counts["skipped"] else []
        summed += [f"{counts['left out']} left out (--quick)"] if counts["left out"] else []
        echo("", ", ".join(summed))
        if left:
            echo(f"warning: as `plugins new` wrote it, write your own: {', '.join(left)}")
    return EXIT_CELL_FAILED if counts["broken"] else EXIT_GOOD


@contextmanager
def _sharing_kernels(method_id: str) -> Iterator[None]:
    """Let the suite use what this user's runs have compiled, and leave them what it compiles."""
    from orthoflow.engine.kernels import VARIABLE, kernel_folder, kernels_in
    from orthoflow.engine.keys import method_facts

    if VARIABLE in os.environ:
        yield
        return
    facts = method_facts(method_id, discover_catalog())
    with kernels_in(kernel_folder(facts.kernels)):
        yield
