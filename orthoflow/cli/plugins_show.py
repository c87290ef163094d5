"""`orthoflow plugins show`: a method's parameters, ports, origin and citations."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import click

from orthoflow.catalog import BrokenPlugin, MethodEntry, discover_catalog
from orthoflow.cli.failures import EXIT_GOOD, EXIT_PLUGIN_MISSING
from orthoflow.cli.options import Command, json_option
from orthoflow.cli.tables import echo_json, echo_table

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

    Of a plugin that does not load, ID may be its name; its traceback is shown. Ends with 2 when
    there is no such method, with 4 when its plugin does not load.
    """
    catalog = discover_catalog()
    for broken in catalog.broken:
        if method_id in (broken.entry_point, broken.distribution.name):
            _print_broken(broken, as_json=as_json)
            return EXIT_PLUGIN_MISSING
    entry = catalog.method(method_id)
    description = describe_method(entry)
    if as_json:
        echo_json(description)
    else:
        _print(entry, entry.load())
    return EXIT_GOOD


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


def _print_broken(broken: BrokenPlugin, *, as_json: bool) -> None:
    if as_json:
        echo_json({"state": "broken", "problem": str(broken), "traceback": broken.traceback})
        return
    click.echo(f"{broken}\n")
    click.echo(f"distribution  {broken.distribution}")
    click.echo("state         broken")
    click.echo(f"module        {broken.module}\n")
    click.echo(broken.traceback.rstrip())


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
