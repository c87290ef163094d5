"""`orthoflow plugins list`: every method, and what is wrong with plugins that do not load."""

from __future__ import annotations

import click

from orthoflow.catalog import Catalog, discover_catalog
from orthoflow.cli.failures import EXIT_GOOD
from orthoflow.cli.options import Command, json_option
from orthoflow.cli.tables import echo_json, echo_table


@click.command("list", cls=Command)
@json_option
def plugins_list(*, as_json: bool) -> int:
    """List methods, kinds and product types, and what is wrong with plugins that do not load.

    `orthoflow plugins show PLUGIN` prints the traceback of one that is broken.
    """
    catalog = discover_catalog()
    if as_json:
        echo_json(_as_json(catalog))
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
    click.echo()
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
    click.echo()
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
        click.echo("\nwhat is wrong:")
    for problem in problems:
        click.echo(f"- {problem}")
    for broken in catalog.broken:
        click.echo(f"`orthoflow plugins show {broken.entry_point}` prints its traceback")
    return EXIT_GOOD


def _as_json(catalog: Catalog) -> dict[str, object]:
    return {
        "methods": [
            {
                "id": entry.spec.id,
                "kind": entry.spec.kind,
                "state": entry.state,
                "problem": entry.problem,
                "distribution": entry.distribution.name,
                "version": entry.distribution.version,
                "summary": entry.spec.summary,
            }
            for entry in catalog.methods.values()
        ],
        "kinds": [
            {
                "name": name,
                "state": kind.state,
                "problem": kind.problem,
                "distribution": kind.distribution.name,
                "version": kind.distribution.version,
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
                "state": product.state,
                "problem": product.problem,
                "distribution": product.distribution.name,
                "version": product.distribution.version,
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
