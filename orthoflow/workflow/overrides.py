"""`--set step[.variant].param=value`: overrides of parameters from the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from orthoflow.catalog import did_you_mean
from orthoflow.errors import ArgumentError
from orthoflow.files.yaml_positions import plain, read_yaml
from orthoflow.products.product import JsonValue
from orthoflow.workflow.problems import InvalidWorkflowError, ProblemLog
from orthoflow.workflow.steps import DraftStep, DraftVariant


@dataclass(frozen=True, kw_only=True)
class Override:
    """One parameter of one method call, set from the command line.

    Attributes:
        option: as typed, e.g. `--set wall.gsd_m=0.005`.
        keys: parameter name, and keys inside it when it is a mapping.
        value: JSON.
    """

    option: str
    keys: tuple[str, ...]
    value: JsonValue


@dataclass(frozen=True, kw_only=True)
class CallName:
    """Names a method call: step, and variant or nothing."""

    step: str
    variant: str


def assign_overrides(
    sets: Sequence[str], steps: Sequence[DraftStep], log: ProblemLog
) -> Mapping[CallName, tuple[Override, ...]]:
    """Find the method calls that each `--set` means; what fits nowhere goes to the log."""
    assigned: dict[CallName, list[Override]] = {}
    for text in sets:
        option = f"--set {text}"
        try:
            parts, value = _parse(text)
            for call, override in _targets(option, parts, value, steps):
                assigned.setdefault(call, []).append(override)
        except ArgumentError as error:
            log.add_option(option, str(error))
    return {call: tuple(overrides) for call, overrides in assigned.items()}


def _parse(text: str) -> tuple[list[str], JsonValue]:
    key, mark, raw = text.partition("=")
    parts = key.strip().split(".")
    if not mark or len(parts) < 2 or not all(parts):
        raise ArgumentError("expected step.parameter=value or step.variant.parameter=value")
    if not raw.strip():
        raise ArgumentError("expected a value behind the equals sign")
    log = ProblemLog(file="the value")
    value = read_yaml(raw, log)
    try:
        log.raise_any()
    except InvalidWorkflowError as error:
        raise ArgumentError(
            f"the value cannot be read as YAML: {error.problems[0].message}; quote it"
        ) from error
    return parts, None if value is None else plain(value)


def _targets(
    option: str, parts: list[str], value: JsonValue, steps: Sequence[DraftStep]
) -> list[tuple[CallName, Override]]:
    by_name = {step.name: step for step in steps}
    step = by_name.get(parts[0])
    if step is None:
        raise ArgumentError(
            f"there is no step {parts[0]}{did_you_mean(parts[0], by_name)}; steps: "
            f"{', '.join(by_name)}"
        )
    variants, keys = _select_variants(step, parts[1:])
    chosen = [variant for variant in variants if _may_have(variant, keys[0])]
    if not chosen:
        known = sorted({name for variant in variants for name in _parameters(variant)})
        who = " or ".join(dict.fromkeys(variant.method for variant in variants))
        raise ArgumentError(
            f"there is no parameter {keys[0]} in {who}{did_you_mean(keys[0], known)}; known: "
            f"{', '.join(known) or 'none'}"
        )
    override = Override(option=option, keys=tuple(keys), value=value)
    return [(CallName(step=step.name, variant=variant.name), override) for variant in chosen]


def _select_variants(
    step: DraftStep, parts: list[str]
) -> tuple[tuple[DraftVariant, ...], list[str]]:
    if len(parts) == 1:
        return step.variants, parts
    head, *rest = parts
    for variant in step.variants:
        # A step without variants answers to its method's name, so that `plane.hough2d.cell_m`
        # works in recipes with and without variants.
        if head == (variant.name or variant.method.partition(".")[2]):
            return (variant,), rest
    if any(head in _parameters(variant) for variant in step.variants):
        return step.variants, parts
    names = [variant.name or variant.method.partition(".")[2] for variant in step.variants]
    raise ArgumentError(
        f"step {step.name} has no variant {head}{did_you_mean(head, names)}; it has "
        f"{', '.join(names)}"
    )


def _parameters(variant: DraftVariant) -> tuple[str, ...]:
    return tuple(variant.info.method.Params.model_fields) if variant.info else ()


def _may_have(variant: DraftVariant, name: str) -> bool:
    # A method that cannot be loaded is a problem of its own and may have any parameter.
    return variant.info is None or name in _parameters(variant)
