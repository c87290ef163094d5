"""What steps warned of, without what a later step has settled."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final, Protocol

from orthoflow_provenance.model import RecordedCell

# `unless photos decide later (face.photos)`: the method that settles a warning is named in it.
_LATER: Final = re.compile(r"\bunless [a-z ]+ later \(([a-z0-9_.-]+)\)")
# `view_from of read.scan`, with accents or without.
_OF_METHOD: Final = re.compile(r"(`?)(\w+)(`?) of ([a-z0-9_]+\.[a-z0-9_-]+)")
# Names of parameters; those of one word are words of sentences, too.
_PARAMETER: Final = re.compile(r"(?<![\w.])[a-z]+(?:_[a-z0-9]+)+(?![\w.])")


class Call(Protocol):
    """A cell, planned or recorded."""

    @property
    def step(self) -> str:
        """Name of its step."""

    @property
    def method(self) -> str:
        """Id of its method."""

    @property
    def params(self) -> Mapping[str, object]:
        """Resolved parameters."""


@dataclass(frozen=True, kw_only=True)
class SettingNames:
    """How parameters are called where they are set: `wall.margin_m`.

    Attributes:
        steps: method and parameter -> the only step that has them.
    """

    steps: Mapping[tuple[str, str], str]

    @classmethod
    def of(cls, calls: Iterable[Call]) -> SettingNames:
        """Look through the cells of a run."""
        found: dict[tuple[str, str], set[str]] = {}
        for call in calls:
            for name in call.params:
                found.setdefault((call.method, name), set()).add(call.step)
        return cls(steps={key: min(steps) for key, steps in found.items() if len(steps) == 1})

    def in_words(self, text: str, call: Call) -> str:
        """Name the parameters in what a cell says, its own and those of methods that it names."""

        def of_method(found: re.Match[str]) -> str:
            before, name, behind, method = found.groups()
            step = self.steps.get((method, name))
            return found[0] if step is None else f"{before}{step}.{name}{behind}"

        def own(found: re.Match[str]) -> str:
            return f"{call.step}.{found[0]}" if found[0] in call.params else found[0]

        return _PARAMETER.sub(own, _OF_METHOD.sub(of_method, text))


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
    names = SettingNames.of(cells)
    return tuple(
        (cell.address, names.in_words(text, cell))
        for cell in cells
        for text in cell.warnings
        if not any(
            (made.digest, method) in settled
            for method in _LATER.findall(text)
            for made in cell.outputs.values()
        )
    )
