"""What steps warned of, without what a later step has settled."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

from orthoflow_provenance.model import RecordedCell

# `unless photos decide later (face.photos)`: the method that settles a warning is named in it.
_LATER: Final = re.compile(r"\bunless [a-z ]+ later \(([a-z0-9_.-]+)\)")


def standing_warnings(cells: Iterable[RecordedCell]) -> tuple[tuple[str, str], ...]:
    """Address and sentence of each warning, but of those that a later method has settled.

    A warning that names a method that decides later is settled where that was given a product of
    the cell, and came to its end: what it leaves open it says itself.
    """
    cells = tuple(cells)
    settled = {
        (given.digest, cell.method)
        for cell in cells
        if cell.status == "ok"
        for given in cell.inputs.values()
    }
    return tuple(
        (cell.address, text)
        for cell in cells
        for text in cell.warnings
        if not any(
            (made.digest, method) in settled
            for method in _LATER.findall(text)
            for made in cell.outputs.values()
        )
    )
