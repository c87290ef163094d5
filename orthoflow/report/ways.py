"""Where on the page cells stand: the baseline first, others behind the row of their way."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from orthoflow.records.runs import Run
from orthoflow.report.combinations import combinations_of
from orthoflow.report.figures import baseline_addresses


@dataclass(frozen=True, kw_only=True)
class Way:
    """One combination of variants, a row of the comparison.

    Attributes:
        anchor: where the page tells of it.
        name: the variants in words.
        cells: addresses of the cells that are shown here.
        elsewhere: address -> anchor of the combination above that shows it; empty for what stands
            in the page's own sections.
    """

    anchor: str
    name: str
    cells: tuple[str, ...]
    elsewhere: Mapping[str, str]


def ways(run: Run, prefix: str) -> tuple[Way, ...]:
    """Return the combinations of a run, each cell with the first that it belongs to.

    Args:
        run: the run.
        prefix: what the anchors begin with.
    """
    places = dict.fromkeys(baseline_addresses(run), "")
    found = []
    for index, one in enumerate(combinations_of(run)):
        anchor = f"{prefix}way-{index + 1}"
        addresses = [cell.address for cell in one.varied_cells]
        own = tuple(address for address in addresses if address not in places)
        found.append(
            Way(
                anchor=anchor,
                name=one.name,
                cells=own,
                elsewhere={address: places[address] for address in addresses if address not in own},
            )
        )
        places |= dict.fromkeys(own, anchor)
    return tuple(found)


def improved_on(run: Run, addresses: Collection[str]) -> frozenset[str]:
    """Cells whose result a later step of the same kind takes further: a first orientation, say."""
    found: set[str] = set()
    for address in addresses:
        kind = run.cells[address].method.partition(".")[0]
        for before in run.upstream(address):
            is_alike = before.method.partition(".")[0] == kind
            if before.address != address and before.address in addresses and is_alike:
                found.add(before.address)
    return frozenset(found)
