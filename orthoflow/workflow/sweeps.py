"""Sweeps: parameters with several values, each of which makes a variant of its step."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

from orthoflow.errors import ArgumentError
from orthoflow.files.yaml_positions import Entry, Table, plain
from orthoflow.products.product import JsonValue
from orthoflow.workflow.format import PARAMS, SWEEP, SWEPT
from orthoflow.workflow.parameters import CallName, Override, Report
from orthoflow.workflow.problems import ProblemLog
from orthoflow.workflow.steps import DraftStep, DraftVariant
from orthoflow.workflow.swept_values import MOST_SWEPT

# As names of variants may be, see `catalog.NAME_PATTERN`.
_LETTERS: Final = 32
_Overrides = Mapping[CallName, tuple[Override, ...]]


@dataclass(frozen=True, kw_only=True)
class ExpandedSteps:
    """Steps whose sweeps have become variants.

    Attributes:
        steps: in the order of the file.
        overrides: of their calls, the swept values among them.
        has_sweeps: something is swept, so that there is something to compare.
    """

    steps: tuple[DraftStep, ...]
    overrides: _Overrides
    has_sweeps: bool


def expand_sweeps(
    steps: Sequence[DraftStep], overrides: _Overrides, log: ProblemLog
) -> ExpandedSteps:
    """Put a variant for each value in the place of every call that sweeps a parameter.

    What `--set` says of a swept parameter takes the place of the sweep, and may be one itself.
    """
    expanded: list[DraftStep] = []
    kept: dict[CallName, tuple[Override, ...]] = {}
    has_sweeps = False
    for step in steps:
        variants: list[DraftVariant] = []
        taken = {variant.call.name for variant in step.variants}
        is_swept = False
        for written in step.variants:
            name = CallName(step=step.name, variant=written.call.name)
            found, others = _sweeps_of(written, overrides.get(name, ()), log)
            variant = _without_sweeps(written)
            if found and _may_vary(step, variant, log):
                is_swept = True
                made = _variants(variant, found, taken)
                variants += [one for one, _ in made]
                for one, values in made:
                    call = CallName(step=step.name, variant=one.call.name)
                    kept[call] = (*values, *others)
            else:
                variants.append(replace(variant, is_unswept=variant != written))
                kept[name] = others
        has_sweeps |= is_swept
        expanded.append(
            replace(step, variants=tuple(variants), is_varied=step.is_varied or is_swept)
        )
    return ExpandedSteps(steps=tuple(expanded), overrides=kept, has_sweeps=has_sweeps)


_Values = list[tuple[JsonValue, Report]]


def _sweeps_of(
    variant: DraftVariant, overrides: Sequence[Override], log: ProblemLog
) -> tuple[dict[str, _Values], tuple[Override, ...]]:
    """What a call sweeps, and the overrides that sweep nothing."""
    found: dict[str, _Values] = {}
    for entry in variant.params or ():
        if _is_sweep(entry):
            path = f"{variant.path}.{PARAMS.name}.{entry.key}"
            table = SWEPT.read(entry.value, path, log)
            values = SWEEP.read(table, path, log) if table is not None else None
            found[entry.key] = [
                (
                    plain(value),
                    partial(log.add, value.position, f"{path}.{SWEEP.name}[{index}]"),
                )
                for index, value in enumerate(values or ())
            ]
    others: list[Override] = []
    for override in overrides:
        parameter, *inside = override.keys
        value = override.value
        if inside == [SWEEP.name]:
            value, inside = {SWEEP.name: value}, []
        if not inside and isinstance(value, dict) and SWEEP.name in value:
            try:
                found[parameter] = [(one, override.report) for one in _listed(value)]
            except ArgumentError as error:
                override.report(str(error))
            continue
        found.pop(parameter, None)
        others.append(override)
    once = {name: _once(values) for name, values in found.items() if values}
    return once, tuple(others)


def _once(values: _Values) -> _Values:
    """Leave out what stands there twice, and say so at its place."""
    kept: dict[str, tuple[JsonValue, Report]] = {}
    for value, report in values:
        # 1 and 1.0 are the same number.
        whole = int(value) if isinstance(value, float) and value.is_integer() else value
        text = json.dumps(whole, sort_keys=True)
        if text in kept:
            comma = "; if it begins numbers, decimals have a point: 0.5" if value == 0 else ""
            report(f"{json.dumps(value)} is swept twice; leave one of them out{comma}")
        kept.setdefault(text, (value, report))
    return list(kept.values())


def _is_sweep(entry: Entry) -> bool:
    return isinstance(entry.value, Table) and entry.value.get(SWEEP.name) is not None


def _without_sweeps(variant: DraftVariant) -> DraftVariant:
    """The call without what it sweeps, of which all was said."""
    if variant.params is None:
        return variant
    kept = tuple(entry for entry in variant.params if not _is_sweep(entry))
    return replace(variant, params=replace(variant.params, entries=kept))


def _listed(value: Mapping[str, JsonValue]) -> Sequence[JsonValue]:
    listed = value[SWEEP.name]
    if len(value) > 1 or not isinstance(listed, list) or not 2 <= len(listed) <= MOST_SWEPT:
        raise ArgumentError(
            f"expected {{{SWEEP.name}: [VALUE, VALUE, ...]}} with 2 to {MOST_SWEPT} values and "
            "nothing beside it"
        )
    return listed


def _may_vary(step: DraftStep, variant: DraftVariant, log: ProblemLog) -> bool:
    if variant.kind is None or not variant.kind.is_source:
        return True
    log.add(
        variant.position,
        f"{variant.path}.{PARAMS.name}",
        f"{variant.call.method} is a source, and sources take no variants, so nothing of it can be "
        f"swept; datasets can: {{a: {{set: {{{step.name}.<parameter>: VALUE}}}}, ...}}",
    )
    return False


def _variants(
    variant: DraftVariant, found: Mapping[str, _Values], taken: set[str]
) -> list[tuple[DraftVariant, tuple[Override, ...]]]:
    """All combinations of the values, each a variant with a name that says them."""
    made = []
    words = {name: [_word(value) for value, _ in values] for name, values in found.items()}
    parameters = _shortened(variant.call.name, words)
    for chosen in itertools.product(*(range(len(values)) for values in found.values())):
        at = dict(zip(found, chosen, strict=True))
        parts = [f"{parameters[name]}-{words[name][index]}" for name, index in at.items()]
        name = _unused("-".join([variant.call.name, *parts] if variant.call.name else parts), taken)
        taken.add(name)
        overrides = []
        for parameter, index in at.items():
            value, report = found[parameter][index]
            overrides.append(Override(report=report, keys=(parameter,), value=value))
        one = replace(
            variant,
            call=replace(variant.call, name=name),
            swept=tuple(found),
            family=variant.call.name,
        )
        made.append((one, tuple(overrides)))
    return made


def _shortened(before: str, words: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Cut names of parameters, never their values, so that all names of variants are short enough.

    >>> _shortened("", {"tolerance_m": ["0_02"]})
    {'tolerance_m': 'tolerance_m'}
    >>> _shortened("fine", {"sigma_corner_max_cells": ["100"], "sigma_wall_max_cells": ["5"]})
    {'sigma_corner_max_cells': 'sigma_corn', 'sigma_wall_max_cells': 'sigma_wall'}
    """
    fixed = sum(max(map(len, said)) + 2 for said in words.values()) - 1
    room = _LETTERS - fixed - (len(before) + 1 if before else 0)
    each = max(1, room // len(words))
    return {name: name.lower()[:each].rstrip("_") for name in words}


def _word(value: JsonValue) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "none"}[value]
    if isinstance(value, int | float):
        text = f"{value:g}"
        # A name has neither points nor signs.
        return text.replace("+", "").replace("-", "m").replace(".", "_")
    text = value if isinstance(value, str) else "-".join(_words(value))
    return re.sub(r"[^a-z0-9_-]+", "_", text.lower()).strip("_-")[:12] or "empty"


def _words(value: list[JsonValue] | dict[str, JsonValue]) -> list[str]:
    return [_word(one) for one in (value if isinstance(value, list) else value.values())]


def _unused(name: str, taken: set[str]) -> str:
    for count in itertools.count(1):
        behind = "" if count == 1 else f"-{count}"
        told = f"{name[: _LETTERS - len(behind)]}{behind}"
        if told not in taken:
            return told
    raise AssertionError("counting never ends")
