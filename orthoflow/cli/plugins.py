"""`orthoflow plugins`: list, show and check methods, and write a plugin."""

from __future__ import annotations

import dataclasses
import inspect
import json
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import click

from orthoflow.catalog.catalog import Catalog, KindEntry, MethodEntry, ProductEntry
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.cli.commands import (
    EXIT_CELL_FAILED,
    EXIT_GOOD,
    Command,
    LazyGroup,
    current_session,
    json_option,
)
from orthoflow.cli.tables import counted, echo, echo_json, echo_table

_SUMMARIES: Final = {
    "list": "List all methods, and the plugins that cannot be loaded.",
    "show": "Show a method's parameters, ports, origin and citations.",
    "new": "Write a working plugin with tests, as a basis for your own.",
    "check": "Run the conformance suite on a method.",
}

# Number of parameters of a method that are shown in the first table.
_FIRST_SHOWN: Final = 5

plugins: Final[click.Command] = LazyGroup(
    name="plugins",
    help="List, show and check methods, or write your own plugin.",
    summaries=_SUMMARIES,
    target="orthoflow.cli.plugins:plugins_{}",
)


@click.command("list", cls=Command)
@json_option
def plugins_list(*, as_json: bool) -> int:
    """List methods, kinds and product types, and plugins that cannot be loaded.

    With --debug, the tracebacks of such plugins are shown.
    """
    found = _listing(discover_catalog())
    if as_json:
        echo_json(found)
        return EXIT_GOOD
    for section, columns in (
        ("methods", ("id", "state")),
        ("kinds", ("name", "takes", "gives")),
        ("products", ("name",)),
    ):
        names = (*columns, "distribution", "summary")
        header = (section.removesuffix("s"), *names[1:])
        rows = [
            {**one, "takes": ", ".join(one.get("in", ())), "gives": ", ".join(one.get("out", ()))}
            for one in found[section]
        ]
        echo_table(header, [[one[name] for name in names] for one in rows])
        echo()
    problems = [one["problem"] for rows in found.values() for one in rows if one["problem"]]
    if problems:
        echo("problems:", *(f"- {problem}" for problem in problems))
    if current_session().debug:
        echo(*(line for one in found["broken"] for line in ["", *one["traceback"].split("\n")]))
    return EXIT_GOOD


def _listing(catalog: Catalog) -> dict[str, list[dict[str, Any]]]:
    methods = [entry.looked_at() for entry in catalog.methods.values()]
    return {
        "methods": [
            {"id": one.spec.id, "kind": one.spec.kind, **_announced(one)} for one in methods
        ],
        "kinds": [
            {
                "name": name,
                "in": dict(one.spec.inputs),
                "out": dict(one.spec.outputs),
                "is_source": one.spec.is_source,
                **_announced(one),
            }
            for name, one in catalog.kinds.items()
        ],
        "products": [{"name": name, **_announced(one)} for name, one in catalog.products.items()],
        "broken": [
            {
                "plugin": one.entry_point,
                "module": one.module,
                "distribution": one.distribution.name,
                "version": one.distribution.version,
                "problem": str(one),
                "traceback": one.traceback,
            }
            for one in catalog.broken
        ],
    }


def _announced(entry: MethodEntry | KindEntry | ProductEntry) -> dict[str, object]:
    return {
        "state": entry.state,
        "problem": entry.problem,
        "distribution": entry.distribution.name,
        "version": entry.distribution.version,
        "summary": entry.spec.summary,
    }


@click.command("show", cls=Command)
@click.argument("method_id", metavar="ID")
@json_option
def plugins_show(method_id: str, *, as_json: bool) -> int:
    """Show the method ID, e.g. plane.hough2d: parameters, ports, origin and citations.

    The exit code is 2 if the method does not exist, and 4 if it cannot be used; with --debug, the
    traceback is shown.
    """
    described = _described(discover_catalog().method(method_id))
    if as_json:
        echo_json(described)
    else:
        _print_method(described)
    return EXIT_GOOD


def _described(entry: MethodEntry) -> dict[str, Any]:
    from orthoflow.files.documents import type_text
    from orthoflow.sdk import port_specs
    from orthoflow.sdk.units import unit_of

    method = entry.load()
    schema = method.Params.model_json_schema()
    return {
        "id": entry.spec.id,
        "summary": entry.spec.summary,
        "description": inspect.cleandoc(method.__doc__ or ""),
        "state": entry.state,
        "distribution": entry.distribution.name,
        "version": entry.distribution.version,
        "target": entry.spec.target,
        "result_version": method.result_version,
        "determinism": method.determinism,
        "citations": list(method.citations),
        "metrics": [dataclasses.asdict(one) for one in method.metric_specs()],
        "params": [
            {
                "name": name,
                "type": type_text(field, schema.get("$defs", {})),
                "default": field.get("default"),
                "unit": unit_of(name),
                "description": field.get("description", ""),
            }
            for name, field in schema.get("properties", {}).items()
        ],
        "in": [
            {"port": one.name, "product": one.type_name, "required": one.required}
            for one in port_specs(method.In).values()
        ],
        "out": [
            {"port": one.name, "product": one.type_name} for one in port_specs(method.Out).values()
        ],
    }


def _print_method(method: Mapping[str, Any]) -> None:
    echo(f"{method['id']}: {method['summary']}", "")
    if text := method["description"]:
        echo(*text.split("\n"), "")
    echo(f"distribution  {method['distribution']} {method['version']}")
    echo(f"state         {method['state']}", f"class         {method['target']}")
    echo(f"determinism   {method['determinism']}, result version {method['result_version']}")
    echo(*(f"citation      {citation}" for citation in method["citations"]), "")
    ports = [
        (way, one["port"], one["product"], "" if one.get("required", True) else "optional")
        for way in ("in", "out")
        for one in method[way]
    ]
    echo_table(("port", "name", "product", ""), ports)
    if method["metrics"]:
        echo()
        echo_table(
            ("metric", "unit", "better", "description"),
            [
                (one["name"], one["unit"], one["better"], _metric_text(one))
                for one in method["metrics"]
            ],
        )
    echo(*([""] if method["params"] else ["", "no parameters"]))
    # Methods declare the parameters that users set most often first.
    first, others = method["params"][:_FIRST_SHOWN], method["params"][_FIRST_SHOWN:]
    for title, params in (("parameter", first), ("other parameters", others)):
        if others and title != "parameter":
            echo()
        echo_table(
            (title, "type", "default", "unit", "description"),
            [
                (
                    one["name"],
                    one["type"],
                    "" if one["default"] is None else json.dumps(one["default"]),
                    one["unit"],
                    one["description"],
                )
                for one in params
            ],
        )


def _metric_text(spec: Mapping[str, str]) -> str:
    label = re.sub(r"\{\d\}", "...", spec["label"])
    return ": ".join(part for part in (label, spec["description"]) if part)


@click.command("new", cls=Command)
@click.argument("name", metavar="NAME")
@click.option("--kind", default="", metavar="KIND", help="Kind of the method, e.g. plane.")
@click.option(
    "--new-kind",
    default="",
    metavar="KIND",
    help="Name of a new kind, instead of --kind, e.g. mark.",
)
@click.option(
    "--takes",
    default="cloud",
    show_default=True,
    metavar="TYPES",
    help="Comma-separated input product types of the new kind.",
)
@click.option(
    "--gives",
    default="",
    metavar="TYPES",
    help="Comma-separated output product types of the new kind; the plugin defines those that do "
    "not exist yet.  [default: KINDs]",
)
@click.option(
    "--folder",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    default=Path(),
    help="Parent folder of the new folder NAME; by default the working directory.",
)
@json_option
def plugins_new(
    name: str,
    kind: str,
    new_kind: str,
    takes: str,
    gives: str,
    folder: Path,
    *,
    as_json: bool,
) -> int:
    """Write a plugin NAME, e.g. my-detector, that can be installed and passes its tests.

    `orthoflow plugins list` shows the kinds and product types. The method is a simple example,
    to be replaced by your own. With `--new-kind`, the plugin also defines a kind, and a product
    type if `--gives` names a new one.
    """
    from orthoflow.scaffold import Project, write_project

    if bool(kind) == bool(new_kind):
        raise click.UsageError(
            "pass either --kind, the kind of the method (see `orthoflow plugins list`), or "
            "--new-kind"
        )
    catalog = discover_catalog()
    taken, given = (
        dict.fromkeys(part.strip() for part in types.split(",") if new_kind)
        for types in (takes, gives or f"{new_kind}s")
    )
    own = [name for name in given if name not in catalog.products]
    if len(own) > 1:
        raise click.UsageError(
            f"--gives {gives}: {' and '.join(own)} do not exist, but a new plugin can define only "
            "one product type; `orthoflow plugins list` shows the existing ones"
        )
    project = Project(
        name=name,
        kind=new_kind or kind,
        takes=tuple(taken),
        gives=tuple(name for name in given if name not in own),
        product=own[0] if own else "",
    )
    written = write_project(project, folder, catalog)
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
    help="File with digests of golden results; a missing method is added.",
)
@click.option(
    "--quick",
    is_flag=True,
    help="Skip (and list) checks that need more than two runs of the method.",
)
@json_option
def plugins_check(method_id: str, *, as_json: bool, golden: Path | None, quick: bool) -> int:
    """Run every conformance check that applies to the method ID, and report violated rules.

    `--quick` runs the checks that are useful during development: parameters, outputs, unmodified
    inputs, progress and cancellation, runs on one core and on two, and rejection of invalid clouds.
    The full set, for use before publication, adds a run in a new process and an empty folder,
    random input, and known properties of the example.

    A problem that prevents all runs is reported once, and the other checks are skipped. The exit
    code is 1 if a rule is violated, and 4 if the method cannot be loaded.
    """
    from orthoflow.testing import conformance_cases

    results: list[dict[str, str]] = []
    with sharing_kernels(method_id):
        for case in conformance_cases(method_id, golden=golden):
            is_left_out = quick and not case.check.is_quick
            problem = "" if is_left_out else case.problem()
            name, rule = case.check.name, case.check.rule
            first = next((one["check"] for one in results if one["problem"] == problem != ""), "")
            state = "broken" if problem else "left out" if is_left_out else "kept"
            state, text = (
                ("skipped", f"stopped by the same problem as {first}")
                if first
                else (state, problem)
            )
            results.append({"check": name, "state": state, "rule": rule, "problem": problem})
            if not as_json:
                echo(f"{state:{8 if quick else 7}} {name}: {text or rule}")
    counts = Counter(result["state"] for result in results)
    if as_json:
        echo_json({"method": method_id, "checks": results})
    else:
        words = {
            "kept": f"{method_id} meets {counted(counts['kept'], 'rule')}",
            "broken": f"violates {counts['broken']}",
            "skipped": f"{counts['skipped']} skipped",
            "left out": f"{counts['left out']} left out (--quick)",
        }
        parts = [text for state, text in words.items() if state == "kept" or counts[state]]
        echo("", ", ".join(parts))
    return EXIT_CELL_FAILED if counts["broken"] else EXIT_GOOD


@contextmanager
def sharing_kernels(method_id: str) -> Iterator[None]:
    """While the block runs, use and extend this user's cache of compiled kernels."""
    from orthoflow.engine.kernels import VARIABLE, kernel_folder, kernels_in
    from orthoflow.engine.keys import method_facts

    if VARIABLE in os.environ:
        yield
        return
    facts = method_facts(method_id, discover_catalog())
    with kernels_in(kernel_folder(facts.kernels)):
        yield
