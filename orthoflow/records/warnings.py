"""What steps warned of, without what a later step has settled."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Final

from orthoflow_provenance.model import RecordedCell

# `unless photos decide later (face.photos)`: the method that settles a warning is named in it.
_LATER: Final = re.compile(r"\bunless [a-z ]+ later \(([a-z0-9_.-]+)\)")
# `view_from of read.scan`, with accents or without.
_OF_METHOD: Final = re.compile(r"(`?)(\w+)(`?) of ([a-z0-9_]+\.[a-z0-9_-]+)")
# Names of parameters; those of one word are words of sentences, too.
_PARAMETER: Final = re.compile(r"(?<![\w.])[a-z]+(?:_[a-z0-9]+)+(?![\w.])")


def standing_warnings(cells: Iterable[RecordedCell]) -> tuple[tuple[str, str], ...]:
    """Address and sentence of each warning, but of those that a later method has settled.

    A warning that names a method that decides later is settled where that was given a product of
    the cell, and came to its end: what it leaves open it says itself. Parameters are named as
    they are set: `margin_m of raster.grid` is `wall.margin_m` where the step is called so.
    """
    cells = tuple(cells)
    settled = {
        (given.digest, cell.method)
        for cell in cells
        if cell.status == "ok"
        for given in cell.inputs.values()
    }
    steps = _steps(cells)
    return tuple(
        (cell.address, _as_set(text, cell, steps))
        for cell in cells
        for text in cell.warnings
        if not any(
            (made.digest, method) in settled
            for method in _LATER.findall(text)
            for made in cell.outputs.values()
        )
    )


def _steps(cells: Iterable[RecordedCell]) -> dict[tuple[str, str], str]:
    """Method and parameter -> the only step that has them."""
    found: dict[tuple[str, str], set[str]] = {}
    for cell in cells:
        for name in cell.params:
            found.setdefault((cell.method, name), set()).add(cell.step)
    return {key: next(iter(steps)) for key, steps in found.items() if len(steps) == 1}


def _as_set(text: str, cell: RecordedCell, steps: Mapping[tuple[str, str], str]) -> str:
    """Name parameters as `--set` takes them: those of the cell, and those of methods named."""

    def of_method(found: re.Match[str]) -> str:
        before, name, behind, method = found.groups()
        step = steps.get((method, name))
        return found[0] if step is None else f"{before}{step}.{name}{behind}"

    def own(found: re.Match[str]) -> str:
        return f"{cell.step}.{found[0]}" if found[0] in cell.params else found[0]

    return _PARAMETER.sub(own, _OF_METHOD.sub(of_method, text))
