"""Access to the products of a run by type or digest, and creation of output folders."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from orthoflow.cli.commands import DEFAULT_STORE, echo_error
from orthoflow.errors import ArgumentError, StoreError
from orthoflow.untrusted_text import first_few

if TYPE_CHECKING:
    from orthoflow.products import Product
    from orthoflow.records import RecordedCell
    from orthoflow.records.runs import Run

    ProductT = TypeVar("ProductT", bound=Product)

_Wall = TypeVar("_Wall")

_MOST_NAMED: Final = 5

# Product type -> words for error messages about cells, and for those about runs.
_SAID: Final = {
    "cameras": ("orientations", "contains no oriented photos"),
    "layers": ("layers", "contains no layers (photos projected onto walls)"),
    "cloud": ("clouds", "contains no cloud"),
    "orthoimages": ("orthoimages", "contains no orthoimages"),
    "labels": ("labels of points", "contains no planes"),
}


def product_of(run: Run, digest: str, cls: type[ProductT], store: Path) -> ProductT:
    """Return a product from the record, or from the store if the record does not contain it.

    Raises:
        ArgumentError: neither the record nor the store contains the product.
    """
    from orthoflow.engine.store import Store

    for address, recorded in run.cells.items():
        for port, output in recorded.outputs.items():
            if output.digest == digest and output.embedded:
                return cls.from_payload(run.payload(address, port))
    try:
        return Store(store).get_product(digest, cls)
    except StoreError as error:
        raise ArgumentError(
            f"neither the record nor the store {store} contains the {cls.type_name} of this run "
            f"({error}): pass the store of the run with --store, or run the workflow with --embed"
        ) from error


def store_of(run: Run, given: Path) -> Path:
    """Return the store that contains the most products that are missing from the record.

    If `given` is the default, the stores in parents of the run folder are considered, too, because
    the user may export a run from another folder than the one where it was executed.
    """
    from orthoflow.engine.store import Store

    missing = {
        output.digest
        for recorded in run.cells.values()
        for output in recorded.outputs.values()
        if not output.embedded
    }
    above = [folder / DEFAULT_STORE for folder in run.home_folder.absolute().parents]
    stores = [given, *(above if given == DEFAULT_STORE else [])]
    return max(stores, key=lambda store: sum(map(Store(store).has_product, missing)))


def output_of(run: Run, type_name: str, cell: str | None) -> tuple[str, str]:
    """Return the cell and port of an output of a type.

    The cell is the selected one or, if none is selected, the last cell with such an output.

    If several cells have such an output, a note names the one that is used.

    Raises:
        ArgumentError: the selected cell, or every cell if none is selected, lacks such an output.
    """
    named, missing = _SAID[type_name]
    found = {
        address: port
        for address, recorded in run.cells.items()
        for port, output in recorded.outputs.items()
        if output.type_name == type_name
    }
    if cell is not None:
        run.cell(cell)
        if cell not in found:
            raise ArgumentError(
                f"the step {cell} has no {named}; steps with {named}: {', '.join(found) or 'none'}"
            )
        return cell, found[cell]
    if not found:
        raise ArgumentError(run.with_failure(f"the run {run.record.run_id} {missing}"))
    *others, last = found
    if others:
        few = first_few(others, most=_MOST_NAMED)
        echo_error(f"note: using the {named} of {last}; --step selects others: {few}")
    return last, found[last]


def wanted_wall(number: int, known: Mapping[int, _Wall], who: str, does: str) -> _Wall:
    """Return the wall with a number: the index of its plane in `planes.json`.

    Args:
        number: value of `--wall`.
        known: number -> wall.
        who: subject of the error message.
        does: verb of the error message, such as `shows` or `has`.

    Raises:
        ArgumentError: there is no such wall.
    """
    if number not in known:
        raise ArgumentError(
            f"--wall {number}: {who} {does} no wall {number}; it {does} "
            f"{', '.join(str(name) for name in known) or 'none'}"
        )
    return known[number]


def numbers_of(text: str, count: int, expected: str) -> list[float]:
    """Parse comma-separated numbers.

    Args:
        text: value of an option.
        count: required number of numbers.
        expected: the option and the format of its value, for the error message.

    Raises:
        ArgumentError: the text does not have this format.
    """
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise ArgumentError(f"{expected} separated by commas, got {text!r}")
    return values


def make_empty(folder: Path) -> None:
    """Create a folder and its parents.

    Raises:
        ArgumentError: the folder cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArgumentError(f"cannot create {folder}: {error.strerror}") from error


def branch_of(run: Run, address: str) -> dict[str, RecordedCell]:
    """Return the cells that can be combined with a cell.

    These are the cells whose variants, dataset and repeat do not contradict those of the cell.
    """
    chosen = run.cell(address)
    return {
        name: cell
        for name, cell in run.cells.items()
        if cell.repeat in {0, chosen.repeat}
        and all(
            chosen.assignment.get(key, value) == value for key, value in cell.assignment.items()
        )
    }


def last_product(
    run: Run, cells: Mapping[str, RecordedCell], cls: type[ProductT], store: Path
) -> ProductT | None:
    """Return the last product of a type among the outputs of cells; None if there is none.

    Raises:
        ArgumentError: neither the record nor the store contains the product.
    """
    found = [
        output.digest
        for cell in cells.values()
        for output in cell.outputs.values()
        if output.type_name == cls.type_name
    ]
    return product_of(run, found[-1], cls, store) if found else None
