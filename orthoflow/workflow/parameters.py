"""Parameters of method calls: those of the file, those of `--set`, and the defaults."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby
from typing import Final, TypeAlias

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from orthoflow.catalog.foreign_code import foreign_code
from orthoflow.catalog.wording import describe_error, did_you_mean
from orthoflow.errors import ArgumentError
from orthoflow.files.yaml_positions import (
    Listing,
    Position,
    Table,
    Value,
    describe_scalar,
    join,
    plain,
    read_yaml,
)
from orthoflow.products.product import JsonValue
from orthoflow.workflow.format import CALL, PARAMS
from orthoflow.workflow.hints import meant_number, meant_parameter, written_form
from orthoflow.workflow.methods import MethodInfo
from orthoflow.workflow.problems import InvalidWorkflowError, ProblemLog
from orthoflow.workflow.steps import DraftStep, DraftVariant

Report: TypeAlias = Callable[[str], None]

# Keys of a call that are written among its parameters.
_BESIDE: Final = {key.name for key in CALL.keys} - {PARAMS.name}
# Letters of a value that a message repeats.
_SHOWN: Final = 60
# What pydantic calls a list or a mapping of another form, and a value of another type in one.
_OF_LISTS: Final = frozenset(
    ("tuple_type", "list_type", "dict_type", "missing", "too_long", "too_short")
)
_OF_LEAVES: Final = frozenset(
    ("float_type", "int_type", "string_type", "bool_type", "finite_number", "int_from_float")
)


@dataclass(frozen=True, kw_only=True)
class Override:
    """One parameter of one method call, set from the command line or by a dataset.

    Attributes:
        report: takes what is wrong with it, and knows its place.
        keys: parameter name, and keys inside it when it is a mapping.
        value: JSON.
    """

    report: Report
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
        report = partial(log.add_option, f"--set {text}")
        try:
            parts, value = _parse(text)
            for call, override in _targets(report, parts, value, steps):
                assigned.setdefault(call, []).append(override)
        except ArgumentError as error:
            report(str(error))
    return {call: tuple(overrides) for call, overrides in assigned.items()}


def assign_settings(
    settings: Table,
    path: str,
    steps: Sequence[DraftStep],
    log: ProblemLog,
    *,
    is_column: bool = False,
) -> Mapping[CallName, tuple[Override, ...]]:
    """Find the method calls that each `step.parameter: value` of a mapping means.

    Args:
        settings: the mapping.
        path: what stands before its keys in problems.
        steps: of the workflow.
        log: takes the problems.
        is_column: the keys are columns of a table; problems of these bear the key alone, so that
            they are told of once.
    """
    assigned: dict[CallName, list[Override]] = {}
    for entry in settings:
        here = entry.key if is_column else join(path, entry.key)
        parts = entry.key.split(".")
        if len(parts) < 2 or not all(parts):
            log.add(entry.position, here, "expected step.parameter or step.variant.parameter")
            continue
        report = partial(log.add, entry.value.position, join(path, entry.key))
        try:
            for call, override in _targets(report, parts, plain(entry.value), steps):
                assigned.setdefault(call, []).append(override)
        except ArgumentError as error:
            log.add(entry.position, here, str(error))
    return {call: tuple(overrides) for call, overrides in assigned.items()}


@dataclass(frozen=True, kw_only=True)
class ResolvedParams:
    """Parameters of a method call.

    Attributes:
        resolved: defaults included.
        as_set: as written in the file or set on the command line.
    """

    resolved: Mapping[str, JsonValue] = field(default_factory=dict)
    as_set: Mapping[str, JsonValue] = field(default_factory=dict)


def resolve_params(
    variant: DraftVariant,
    overrides: Sequence[Override],
    log: ProblemLog,
    blame: Report | None = None,
) -> ResolvedParams:
    """Check the parameters of a method call, strictly: the text "0.003" is not a number.

    Args:
        variant: the method call.
        overrides: put over what the file says, one after the other.
        log: takes the problems of what the file says.
        blame: takes these in the log's place, for a call that is fine without the overrides.
    """
    written = plain(variant.params) if variant.params else {}
    as_set: dict[str, JsonValue] = written if isinstance(written, dict) else {}
    for override in overrides:
        _put(as_set, override)
    info = variant.info
    if info is None:
        return ResolvedParams(as_set=as_set)
    try:
        with foreign_code(f"checking the parameters of {info.id}"):
            params = info.method.Params.model_validate_json(json.dumps(as_set), strict=True)
            resolved = params.model_dump(mode="json")
            # As the step will: a default may be refused once it is given like any other value.
            info.method.Params.model_validate_json(json.dumps(resolved), strict=True)
    except ValidationError as error:
        reports = {override.keys[0]: override.report for override in overrides}
        reporter = _Reporter(
            variant=variant, info=info, as_set=as_set, reports=reports, log=log, blame=blame
        )
        reporter.report_all(error.errors())
        return ResolvedParams(as_set=as_set)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # noqa: BLE001 - a stranger's validator may raise anything
        log.add_plugin(
            variant.position,
            f"{variant.path}.params",
            f"checking the parameters of {info.id} failed: {describe_error(error)}",
        )
        return ResolvedParams(as_set=as_set)
    return ResolvedParams(resolved=resolved, as_set=as_set)


def _put(params: dict[str, JsonValue], override: Override) -> None:
    *outer, last = override.keys
    place = params
    for key in outer:
        inner = place.setdefault(key, {})
        if not isinstance(inner, dict):
            override.report(f"{key} is no mapping, so nothing in it can be set")
            return
        place = inner
    # Several calls may take the same value, and later settings go into it.
    place[last] = deepcopy(override.value)


@dataclass(frozen=True, kw_only=True)
class _Reporter:
    """Turns pydantic's errors into problems of the file, of a `--set` or of a dataset."""

    variant: DraftVariant
    info: MethodInfo
    as_set: Mapping[str, JsonValue]
    reports: Mapping[str, Report]
    log: ProblemLog
    blame: Report | None

    def report_all(self, errors: Sequence[ErrorDetails]) -> None:
        """Report each; but what is wrong with the form of one list or mapping is one problem."""
        for first, group in groupby(errors, key=lambda details: details["loc"][:1]):
            told = list(group)
            if form := self._other_form(str(first[0]) if first else "", told):
                self._report(first, form)
                continue
            for details in told:
                self._report(details["loc"], self._message(details))

    def _other_form(self, name: str, errors: Sequence[ErrorDetails]) -> str:
        """Say how a parameter is written whose value has another form; empty where it has not."""
        field_info = self.info.method.Params.model_fields.get(name)
        kinds = {details["type"] for details in errors if len(details["loc"]) > 1}
        kinds |= {details["type"] for details in errors} - {"missing"}
        if field_info is None or not kinds & _OF_LISTS or not kinds <= _OF_LISTS | _OF_LEAVES:
            return ""
        form = written_form(field_info.annotation, field_info.description or "")
        given = json.dumps(self.as_set.get(name), ensure_ascii=False)
        given = given if len(given) <= _SHOWN else f"{given[:_SHOWN]} ..."
        return form and f"{name} is written {form}, got {given}"

    def _report(self, location: tuple[int | str, ...], message: str) -> None:
        name = str(location[0]) if location else ""
        inside = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
        if report := self.reports.get(name, self.blame):
            # It names the parameter itself, but nothing inside it, and datasets not even that.
            is_named = name in self.reports and len(location) == 1
            who = inside[1:] or f"the parameters of {self.info.id}"
            report(message if is_named else f"{who}: {message}")
            return
        self.log.add(self._position(location), f"{self.variant.path}.params{inside}", message)

    def _message(self, details: ErrorDetails) -> str:
        location = details["loc"]
        name = str(location[-1]) if location else ""
        match details["type"]:
            case "extra_forbidden":
                known = tuple(self.info.method.Params.model_fields) if len(location) == 1 else ()
                listed = f"; {self.info.id} has {', '.join(known) or 'none'}" if known else ""
                meant = meant_parameter(name, known, details["input"]) or did_you_mean(name, known)
                if known and name in _BESIDE:
                    meant = f" ({name} stands beside params, not in it)"
                return f"unknown parameter {name}{meant}{listed}"
            case "missing":
                return f"{self.info.id} needs parameter {name}"
            case "value_error" | "assertion_error":
                return str(details.get("ctx", {}).get("error", details["msg"]))
        words = details["msg"][:1].lower() + details["msg"][1:]
        meant = meant_number(name, details["input"]) if "number" in words else ""
        if len(location) == 1 and details["type"].endswith(("_type", "enum", "literal_error")):
            meant += self._swept(details["input"])
        return f"{words}, got {_shown(details['input'])}{meant}"

    def _swept(self, value: object) -> str:
        """Say how each value of a list is tried, to who wrote it in the place of one value."""
        is_source = self.variant.kind is not None and self.variant.kind.is_source
        if is_source or not isinstance(value, list) or len(value) < 2:
            return ""
        written = json.dumps(value)
        return f"; to try each: {{sweep: {written if len(written) <= _SHOWN else '[...]'}}}"

    def _position(self, location: tuple[int | str, ...]) -> Position:
        position = self.variant.position
        if self.variant.params is None:
            return position
        position = self.variant.params.position
        value: Value = self.variant.params
        for part in location:
            if isinstance(value, Table) and (entry := value.get(str(part))) is not None:
                position, value = entry.position, entry.value
            elif isinstance(value, Listing) and isinstance(part, int) and part < len(value.items):
                value = value.items[part]
                position = value.position
            else:
                break
        return position


def _shown(value: object) -> str:
    if isinstance(value, list):
        return "a list"
    return "a mapping" if isinstance(value, dict) else describe_scalar(value)


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
        # A shell would have parted it at the space.
        way_out = "" if " " in raw.strip() else "; quote it"
        raise ArgumentError(
            f"the value cannot be read as YAML: {error.problems[0].message}{way_out}"
        ) from error
    return parts, None if value is None else plain(value)


def _targets(
    report: Report, parts: list[str], value: JsonValue, steps: Sequence[DraftStep]
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
        who = " or ".join(dict.fromkeys(variant.call.method for variant in variants))
        meant = meant_parameter(keys[0], known, value) or did_you_mean(keys[0], known)
        raise ArgumentError(
            f"there is no parameter {keys[0]} in {who}{meant}; known: {', '.join(known) or 'none'}"
        )
    if any(keys[0] in variant.swept for variant in chosen):
        raise ArgumentError(
            f"{keys[0]} is swept in step {step.name}, so its variants have its values; take the "
            "sweep away, or this"
        )
    override = Override(report=report, keys=tuple(keys), value=value)
    return [(CallName(step=step.name, variant=variant.call.name), override) for variant in chosen]


def _select_variants(
    step: DraftStep, parts: list[str]
) -> tuple[tuple[DraftVariant, ...], list[str]]:
    if len(parts) == 1:
        return step.variants, parts
    head, *rest = parts
    if named := tuple(variant for variant in step.variants if head in _spoken_names(variant)):
        return named, rest
    if any(head in _parameters(variant) for variant in step.variants):
        return step.variants, parts
    names = dict.fromkeys(name for one in step.variants for name in _spoken_names(one))
    raise ArgumentError(
        f"step {step.name} has no variant {head}{did_you_mean(head, names)}; it has "
        f"{', '.join(names)}"
    )


def _spoken_names(variant: DraftVariant) -> tuple[str, ...]:
    # A step without variants answers to its method's name, so that `plane.hough2d.cell_m` works in
    # recipes with and without variants; what was swept answers to the name that it had before, too.
    method = variant.call.method.partition(".")[2]
    before = (variant.family or method,) if variant.swept else ()
    return (*before, variant.call.name or method)


def _parameters(variant: DraftVariant) -> tuple[str, ...]:
    return tuple(variant.info.method.Params.model_fields) if variant.info else ()


def _may_have(variant: DraftVariant, name: str) -> bool:
    # A method that cannot be loaded is a problem of its own and may have any parameter.
    return variant.info is None or name in _parameters(variant)
