"""How far the products of two runs lie apart, in the units of their types."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from orthoflow_provenance.arrays import ArrayDifference, measure_payloads
from orthoflow_provenance.document import RecordedProduct

from orthoflow.errors import OrthoflowError
from orthoflow.geometry.levels import DEEPER
from orthoflow.products.product import JsonValue, Payload, Product, Tolerance
from orthoflow.records.runs import Run

if TYPE_CHECKING:
    from orthoflow.catalog.catalog import Catalog
    from orthoflow.engine.store import Store

Verdict = Literal["identical", "within tolerance", "different", "not measured"]


@dataclass(frozen=True, kw_only=True)
class Distance:
    """The largest difference among all fields of one unit.

    Attributes:
        unit: `m`, `px`, `grey`, `deg`, or `1` for plain numbers.
        largest: largest absolute difference in that unit; None where values cannot be subtracted
            (another shape or type, missing, NaN against a number).
        limit: what the type allows in the field that lies farthest apart.
        field: that field, e.g. `walls/0/depth_m`.
        n_values: how many values of the unit lie beyond their limit.
    """

    unit: str
    largest: float | None
    limit: float
    field: str
    n_values: int


@dataclass(frozen=True, kw_only=True)
class ProductDistance:
    """Two products that ought to be one.

    Attributes:
        cell: address of the cell that gave them.
        port: its output port.
        type_name: product type.
        verdict: `identical` (same bits), `within tolerance`, `different`, or `not measured` where
            the digests differ and the arrays of one of them are nowhere to be found.
        left: digest of the first, empty when it has none.
        right: digest of the second, empty when it has none.
        distances: one per unit in which they differ.
        reason: one sentence for `different` and `not measured`, else empty.
    """

    cell: str
    port: str
    type_name: str
    verdict: Verdict
    left: str
    right: str
    distances: tuple[Distance, ...] = ()
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class RunProducts:
    """The products of a run, from its record or a store.

    Attributes:
        run: the run.
        stores: where arrays may lie that the record names by digest only.
        own: address by which a cell is asked for -> its own one, where the two differ.
    """

    run: Run
    stores: tuple[Store, ...] = ()
    own: Mapping[str, str] = field(default_factory=dict)

    def outputs(self, address: str) -> Mapping[str, RecordedProduct]:
        """Outputs of a cell by port; empty where the run has no such cell."""
        cell = self.run.cells.get(self.own.get(address, address))
        return {} if cell is None else cell.outputs

    def digest(self, address: str, port: str) -> str:
        """Digest of an output, empty when the run has no such output."""
        output = self.outputs(address).get(port)
        return "" if output is None else output.digest

    def payload(self, address: str, port: str, cls: type[Product]) -> Payload | None:
        """Return arrays and metadata of an output; None when they are nowhere to be found."""
        output = self.outputs(address)[port]
        if output.embedded:
            return self.run.payload(self.own.get(address, address), port)
        for store in self.stores:
            if store.product_file(output.digest) is not None:
                return store.get_product(output.digest, cls).to_payload()
        return None


def product_distances(
    left: RunProducts, right: RunProducts, addresses: Sequence[str], catalog: Catalog
) -> tuple[ProductDistance, ...]:
    """Compare the outputs of cells that both runs have.

    Args:
        left: one run.
        right: the other.
        addresses: the cells, each in both runs.
        catalog: knows the product types and with them the tolerances.
    """
    found = []
    for address in addresses:
        ours, theirs = left.outputs(address), right.outputs(address)
        for port in dict.fromkeys((*ours, *theirs)):
            type_name = (ours.get(port) or theirs[port]).type_name
            found.append(_distance(left, right, (address, port, type_name), catalog))
    return tuple(found)


def _distance(
    left: RunProducts, right: RunProducts, what: tuple[str, str, str], catalog: Catalog
) -> ProductDistance:
    address, port, type_name = what
    digests = left.digest(address, port), right.digest(address, port)

    def verdict(
        said: Verdict, reason: str = "", distances: tuple[Distance, ...] = ()
    ) -> ProductDistance:
        return ProductDistance(
            cell=address,
            port=port,
            type_name=type_name,
            verdict=said,
            left=digests[0],
            right=digests[1],
            distances=distances,
            reason=reason,
        )

    if not all(digests):
        return verdict("different", "only one of the runs has it")
    if digests[0] == digests[1]:
        return verdict("identical")
    try:
        cls = catalog.product_class(type_name)
        payloads = [side.payload(address, port, cls) for side in (left, right)]
    except OrthoflowError as error:
        return verdict("not measured", f"the digests differ, and {error}")
    ours, theirs = payloads
    if ours is None or theirs is None:
        return verdict(
            "not measured",
            "the digests differ, and its arrays are in no record and no store at hand; run with "
            "--embed to keep them",
        )
    limits = {
        name: (_limit(name, tolerance, ours), tolerance.unit)
        for name, tolerance in cls.tolerances.items()
    }
    differences = [_named(found, ours) for found in measure_payloads(ours, theirs, limits)]
    beyond = [difference for difference in differences if difference.n_values]
    if not beyond:
        return verdict(
            "within tolerance" if differences else "identical", "", _by_unit(differences)
        )
    others = f"; {len(beyond) - 1} more fields differ" if len(beyond) > 1 else ""
    reason = f"{beyond[0].name}: {beyond[0].problem}{others}"
    return verdict("different", reason, _by_unit(differences))


def _named(difference: ArrayDifference, payload: Payload) -> ArrayDifference:
    """Tell a value that lies in a list by the name and the unit that stand beside it."""
    way = difference.name.split("/")
    beside: JsonValue = dict(payload.metadata)
    for part in way[:-1]:
        if isinstance(beside, dict):
            beside = beside.get(part)
        elif isinstance(beside, list) and part.isdecimal() and int(part) < len(beside):
            beside = beside[int(part)]
    if way[-1] != "value" or not isinstance(beside, dict) or "name" not in beside:
        return difference
    unit = beside.get("unit", difference.unit)
    return replace(difference, name=f"{beside['name']}, {difference.name}", unit=str(unit))


def _limit(name: str, tolerance: Tolerance, payload: Payload) -> float:
    """How far values of a field may lie apart; grey levels of 16 bits count in steps of 257."""
    is_deep = tolerance.unit == "grey" and any(
        array.dtype == np.uint16 and path.rpartition("/")[2] == name
        for path, array in payload.arrays.items()
    )
    return tolerance.limit * (DEEPER if is_deep else 1)


def _by_unit(differences: Sequence[ArrayDifference]) -> tuple[Distance, ...]:
    units = dict.fromkeys(difference.unit for difference in differences)
    return tuple(
        _farthest([difference for difference in differences if difference.unit == unit])
        for unit in units
    )


def _farthest(differences: Sequence[ArrayDifference]) -> Distance:
    worst = max(differences, key=lambda difference: difference.largest)
    return Distance(
        unit=worst.unit,
        largest=worst.largest if math.isfinite(worst.largest) else None,
        limit=worst.limit,
        field=worst.name,
        n_values=sum(difference.n_values for difference in differences),
    )
