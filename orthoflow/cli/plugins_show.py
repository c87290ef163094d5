"""`orthoflow plugins show`: a method's parameters, ports, origin and citations."""

from __future__ import annotations

import json
import traceback
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

from orthoflow.catalog import Catalog, DistributionInfo, MethodEntry, discover_catalog
from orthoflow.cli.failures import EXIT_GOOD, EXIT_PLUGIN_MISSING
from orthoflow.cli.options import Command, json_option
from orthoflow.cli.tables import echo_json, echo_table
from orthoflow.errors import PluginError

if TYPE_CHECKING:
    from orthoflow.sdk import Method, MethodParams, Ports

_UNITS = {
    "_m": "m",
    "_mm": "mm",
    "_px": "px",
    "_deg": "deg",
    "_rad": "rad",
    "_s": "s",
    "_mib": "MiB",
    "_grey": "grey levels",
    "_cells": "cells",
    "_share": "1",
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
        echo_json(describe_method(entry))
    else:
        _print(entry, entry.load())
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


def describe_method(entry: MethodEntry) -> dict[str, object]:
    """Give everything that a method says of itself, as JSON.

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
    click.echo(f"{failure.problem}\n")
    click.echo(f"distribution  {failure.distribution}")
    click.echo("state         broken")
    click.echo(f"from          {failure.target}")
    if failure.traceback:
        click.echo(f"\n{failure.traceback.rstrip()}")


def _print(entry: MethodEntry, method: type[Method]) -> None:
    click.echo(f"{entry.spec.id}: {entry.spec.summary}\n")
    if text := _docstring(method):
        click.echo(f"{text}\n")
    click.echo(f"distribution  {entry.distribution.name} {entry.distribution.version}")
    click.echo(f"state         {entry.state}")
    click.echo(f"class         {entry.spec.target}")
    click.echo(f"determinism   {method.determinism}, result version {method.result_version}")
    for citation in method.citations:
        click.echo(f"citation      {citation}")
    click.echo()
    ports = [
        *(
            ("in", port, type_name, "" if required else "optional")
            for port, type_name, required in _ports(method.In)
        ),
        *(("out", port, type_name, "") for port, type_name, _ in _ports(method.Out)),
    ]
    echo_table(("port", "name", "product", ""), ports)
    parameters = _parameters(method.Params)
    click.echo("" if parameters else "\nno parameters")
    echo_table(
        ("parameter", "type", "default", "unit", "description"),
        [
            (name, type_, json.dumps(default) if default is not None else "", unit, text)
            for name, type_, default, unit, text in parameters
        ],
    )


def _docstring(method: type[Method]) -> str:
    import inspect

    return inspect.cleandoc(method.__doc__ or "")


def _parameters(params: type[MethodParams]) -> list[tuple[str, str, object, str, str]]:
    schema = params.model_json_schema()
    definitions = schema.get("$defs", {})
    return [
        (
            name,
            _type_text(field, definitions),
            field.get("default"),
            _unit_of(name),
            field.get("description", ""),
        )
        for name, field in schema.get("properties", {}).items()
    ]


def _type_text(field: dict[str, object], definitions: dict[str, dict[str, object]]) -> str:
    """Say the type of a JSON Schema node in a few words, with its limits."""
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


def _unit_of(name: str) -> str:
    suffix = "_" + name.rpartition("_")[2] if "_" in name else ""
    return _UNITS.get(suffix, "")


def _ports(ports: type[Ports]) -> list[tuple[str, str, bool]]:
    from orthoflow.sdk import port_specs

    return [(spec.name, spec.type_name, spec.required) for spec in port_specs(ports).values()]
