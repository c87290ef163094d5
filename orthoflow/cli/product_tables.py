"""Distances of products on the terminal: a table, and a sentence that sums it up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import click

from orthoflow.cli.tables import counted, echo_table, number

if TYPE_CHECKING:
    from orthoflow.records import Distance, ProductDistance

_VERDICTS: Final = ("identical", "within tolerance", "different", "not measured")
# How people say the units of tolerances; `1` stands for plain numbers.
_UNITS: Final = {"grey": " grey levels", "1": ""}


def echo_distances(distances: Sequence[ProductDistance]) -> None:
    """Print a row per product, the reasons of what differs, and how many there are of each."""
    echo_table(
        ("product", "type", "verdict", "largest differences"),
        [
            (
                f"{item.cell}.{item.port}",
                item.type_name,
                item.verdict,
                ", ".join(_distance_text(distance) for distance in item.distances),
            )
            for item in distances
        ],
    )
    for item in distances:
        if item.reason:
            click.echo(f"{item.cell}.{item.port} {item.verdict}: {item.reason}")
    click.echo(verdict_counts(distances))


def verdict_counts(distances: Sequence[ProductDistance]) -> str:
    """Say how many products there are of each verdict.

    >>> verdict_counts(())
    '0 products'
    """
    counts = [
        f"{count} {verdict}"
        for verdict in _VERDICTS
        if (count := sum(item.verdict == verdict for item in distances))
    ]
    return ": ".join([counted(len(distances), "product"), *([", ".join(counts)] if counts else [])])


def _distance_text(distance: Distance) -> str:
    unit = _UNITS.get(distance.unit, f" {distance.unit}")
    largest = "not comparable" if distance.largest is None else f"{number(distance.largest)}{unit}"
    return f"{largest} ({distance.field})"
