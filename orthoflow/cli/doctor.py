"""`orthoflow doctor`: what is installed, what is missing, and what that costs."""

from __future__ import annotations

from pathlib import Path

import click

from orthoflow.cli.commands import (
    EXIT_GOOD,
    EXIT_PLUGIN_MISSING,
    Command,
    json_option,
    store_option,
)
from orthoflow.cli.diagnosis import Diagnosis, diagnose_libraries, diagnose_machine
from orthoflow.cli.tables import counted, echo, echo_json, echo_table
from orthoflow.version import __version__


@click.command(cls=Command)
@store_option
@json_option
def doctor(store: Path, *, as_json: bool) -> int:
    """Show what is installed, what is missing, and what that costs.

    Ends with 4 when something is missing without which nothing works.
    """
    findings = [*diagnose_machine(store), *diagnose_libraries(), *_diagnose_plugins()]
    broken_core = any(item.is_core and item.verdict == "missing" for item in findings)
    if as_json:
        echo_json(
            {
                "version": __version__,
                "ok": not broken_core,
                "findings": [
                    {
                        "name": item.name,
                        "verdict": item.verdict,
                        "found": item.found,
                        "for": item.use,
                        "cost": item.cost,
                        "core": item.is_core,
                    }
                    for item in findings
                ],
            }
        )
    else:
        _print(findings, broken_core=broken_core)
    return EXIT_PLUGIN_MISSING if broken_core else EXIT_GOOD


def _print(findings: list[Diagnosis], *, broken_core: bool) -> None:
    echo(f"orthoflow {__version__}", "")
    echo_table(
        ("what", "verdict", "found", "for"),
        [(item.name, item.verdict, item.found, item.use) for item in findings],
    )
    costs = [item for item in findings if item.cost]
    if costs:
        echo("", "What that costs:")
    for item in costs:
        echo(f"- {item.name}: {item.cost}")
    if broken_core:
        echo("", "something that everything needs is missing")
    elif costs:
        echo("", f"orthoflow works, with {counted(len(costs), 'restriction')}")
    else:
        echo("", "everything works")


def _diagnose_plugins() -> list[Diagnosis]:
    try:
        from orthoflow.catalog.discovery import discover_catalog

        catalog = discover_catalog()
    except ImportError as error:
        cost = "no method can be found; install what is missing"
        return [Diagnosis(name="plugins", verdict="missing", found=str(error), cost=cost)]
    findings = [
        Diagnosis(
            name="plugins",
            verdict="ok",
            found=counted(len(catalog.methods), "method"),
        )
    ]
    findings += [
        Diagnosis(
            name=f"plugin {broken.entry_point}",
            verdict="missing",
            found=f"{broken.distribution} fails to load",
            cost=f"its methods are missing: {broken.error}",
        )
        for broken in catalog.broken
    ]
    looked_at = [entry.looked_at() for entry in catalog.methods.values()]
    problems = dict.fromkeys(
        entry.problem
        for entry in (*catalog.products.values(), *catalog.kinds.values(), *looked_at)
        if entry.problem
    )
    findings += [
        Diagnosis(name="plugins", verdict="limited", found="not usable as it is", cost=problem)
        for problem in problems
    ]
    return findings
