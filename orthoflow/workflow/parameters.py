"""Parameters of method calls, with values from the file, `--set`, sweeps and defaults."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, TypeAlias

from pydantic import ValidationError

from orthoflow.catalog.discovery import NAME_PATTERN
from orthoflow.catalog.guarding import UserInterrupt, guarded
from orthoflow.errors import ArgumentError, did_you_mean
from orthoflow.files.documents import meant_parameter, mistakes
from orthoflow.files.yaml_positions import Location
from orthoflow.products.product import JsonValue
from orthoflow.sdk.hooks import KindSpec
from orthoflow.sdk.lines import describe_error
from orthoflow.sdk.methods import Method
from orthoflow.workflow.model import MOST_SWEPT, CallSection, Reference, StepVariant, SweepSection
from orthoflow.workflow.source import InvalidWorkflowError, ProblemLog, validate

Report: TypeAlias = Callable[[str], None]

SWEEP: Final = "sweep"
# Maximum length of a name in characters; see `NAME_PATTERN`.
_LETTERS: Final = 32


@dataclass(frozen=True, kw_only=True)
class DraftCall:
    """A method call as written in the file, with its location.

    Attributes:
        location: location of the mapping that contains `use`.
        name: name of the variant; empty for a step without variants.
        call: content of the mapping; after the expansion of sweeps, without the swept parameters.
        method: class of the method; None if the method cannot be loaded.
        kind: kind of the method, which may be known even if the method cannot be loaded.
        swept: parameter -> value, if a sweep created this variant.
        family: name of the variant in the file, if a sweep created this variant.
        is_unswept: whether the file sweeps a parameter, but the command line sets a single value.
    """

    location: Location
    name: str
    call: CallSection
    method: type[Method] | None
    kind: KindSpec | None
    swept: Mapping[str, JsonValue] | None = None
    family: str = ""
    is_unswept: bool = False

    @property
    def id(self) -> str:
        """Method id; empty if it is missing from the file."""
        return self.call.use or ""

    @property
    def is_source(self) -> bool:
        """Whether the kind of the call does not allow variants."""
        return self.kind is not None and self.kind.is_source

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the method's parameters."""
        return tuple(self.method.Params.model_fields) if self.method else ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names by which `--set` may refer to the call.

        The name of the method refers to the call of a step without variants, so that
        `plane.hough2d.cell_m` works in recipes with and without variants. The name of a variant in
        the file refers to all variants that a sweep created from it.
        """
        method = self.id.partition(".")[2]
        before = (self.family or method,) if self.swept else ()
        return (*before, self.name or method)


@dataclass(frozen=True, kw_only=True)
class DraftStep:
    """A step as written in the file, with its location."""

    location: Location
    name: str
    calls: tuple[DraftCall, ...]
    inputs: Mapping[str, tuple[Reference, ...]]
    only_if: Reference | None
    unless: Reference | None
    is_varied: bool


@dataclass(frozen=True, kw_only=True)
class Override:
    """One parameter of one method call, set from the command line or by a dataset.

    Attributes:
        report: function that reports a problem at its position.
        keys: parameter name, followed by keys inside the value if it is a mapping.
        value: value as JSON.
    """

    report: Report
    keys: tuple[str, ...]
    value: JsonValue


# (step, variant) -> overrides; the variant is empty for a step without variants.
Overrides: TypeAlias = dict[tuple[str, str], tuple[Override, ...]]


def overrides_of_options(
    sets: Sequence[str], steps: Sequence[DraftStep], log: ProblemLog
) -> Overrides:
    """Find the method calls to which each `--set` applies; report options that match no call."""
    assigned: Overrides = {}
    for text in sets:
        report = partial(log.report_option, f"--set {text}")
        try:
            parts, value = _parse(text)
            _assign(assigned, report, parts, value, steps)
        except ArgumentError as error:
            report(str(error))
    return assigned


def overrides_of_settings(
    settings: Mapping[str, JsonValue],
    location: Location,
    steps: Sequence[DraftStep],
    log: ProblemLog,
    *,
    is_column: bool = False,
) -> Overrides:
    """Find the method calls to which each `step.parameter: value` in a mapping applies.

    Args:
        settings: the mapping.
        location: location of the mapping in the document.
        steps: steps of the workflow.
        log: log to which problems are added.
        is_column: whether the keys are columns of a table, in which case problems refer only to the
            key and are therefore reported once.
    """
    assigned: Overrides = {}
    for key, value in settings.items():
        here = (*location, key)
        shown = (key,) if is_column else here
        parts = key.split(".")
        if len(parts) < 2 or not all(parts):
            message = "expected step.parameter or step.variant.parameter"
            log.report(here, message, at_key=True, shown=shown)
            continue
        try:
            _assign(assigned, partial(log.report, here), parts, value, steps)
        except ArgumentError as error:
            log.report(here, str(error), at_key=True, shown=shown)
    return assigned


def joined(*several: Mapping[tuple[str, str], tuple[Override, ...]]) -> Overrides:
    """Join overrides; later overrides take precedence."""
    found: Overrides = {}
    for overrides in several:
        for call, own in overrides.items():
            found[call] = (*found.get(call, ()), *own)
    return found


def _parse(text: str) -> tuple[list[str], JsonValue]:
    key, mark, raw = text.partition("=")
    parts = key.strip().split(".")
    if not mark or len(parts) < 2 or not all(parts):
        raise ArgumentError("expected step.parameter=value or step.variant.parameter=value")
    if not raw.strip():
        raise ArgumentError("expected a value after the equals sign")
    log = ProblemLog(file="the value")
    log.parse(raw)
    try:
        log.raise_any()
    except InvalidWorkflowError as error:
        # A value that contains a space is already quoted; otherwise, the shell would have split it.
        way_out = "" if " " in raw.strip() else "; quote it"
        raise ArgumentError(
            f"the value cannot be read as YAML: {error.problems[0].message}{way_out}"
        ) from error
    return parts, log.get(())


def _assign(
    assigned: Overrides,
    report: Report,
    parts: list[str],
    value: JsonValue,
    steps: Sequence[DraftStep],
) -> None:
    by_name = {step.name: step for step in steps}
    step = by_name.get(parts[0])
    if step is None:
        raise ArgumentError(
            f"there is no step {parts[0]}{did_you_mean(parts[0], by_name)}; steps: "
            f"{', '.join(by_name)}"
        )
    calls, keys = _select_calls(step, parts[1:])
    # If a method cannot be loaded, accept any parameter.
    chosen = [call for call in calls if call.method is None or keys[0] in call.parameters]
    if not chosen:
        known = sorted({name for call in calls for name in call.parameters})
        who = " or ".join(dict.fromkeys(call.id for call in calls))
        meant = meant_parameter(keys[0], known, value) or did_you_mean(keys[0], known)
        raise ArgumentError(
            f"there is no parameter {keys[0]} in {who}{meant}; known: {', '.join(known) or 'none'}"
        )
    if any(keys[0] in (call.swept or ()) for call in chosen):
        raise ArgumentError(
            f"{keys[0]} is swept in step {step.name}, so its variants set the values; remove the "
            "sweep or this setting"
        )
    override = Override(report=report, keys=tuple(keys), value=value)
    for call in chosen:
        name = (step.name, call.name)
        assigned[name] = (*assigned.get(name, ()), override)


def _select_calls(step: DraftStep, parts: list[str]) -> tuple[tuple[DraftCall, ...], list[str]]:
    if len(parts) == 1:
        return step.calls, parts
    head, *rest = parts
    if named := tuple(call for call in step.calls if head in call.names):
        return named, rest
    if any(head in call.parameters for call in step.calls):
        return step.calls, parts
    names = dict.fromkeys(name for call in step.calls for name in call.names)
    raise ArgumentError(
        f"step {step.name} has no variant {head}{did_you_mean(head, names)}; it has "
        f"{', '.join(names)}"
    )


def resolve_call(
    draft: DraftCall,
    overrides: Sequence[Override],
    log: ProblemLog,
    blame: Report | None = None,
) -> StepVariant:
    """Check the parameters of a method call and add the defaults.

    The check is strict: the string "0.003" is not accepted as a number.

    Args:
        draft: the method call.
        overrides: overrides, applied in order to the parameters in the file.
        log: log for problems with the parameters in the file.
        blame: function that reports problems instead of `log`, for a call that is valid without the
            overrides.

    Returns:
        The call, without resolved parameters if these are invalid or the method is unknown.
    """
    as_set: dict[str, JsonValue] = deepcopy(draft.call.params)
    for override in overrides:
        _put(as_set, override)
    return StepVariant(
        name=draft.name,
        method=draft.id,
        params=_resolved(draft, as_set, overrides, log, blame),
        params_set=as_set,
        repeat=draft.call.repeat,
        cores=draft.call.resources.cores,
        timeout_s=draft.call.timeout,
        swept=draft.swept or {},
        family=draft.family,
    )


def _resolved(
    draft: DraftCall,
    as_set: Mapping[str, JsonValue],
    overrides: Sequence[Override],
    log: ProblemLog,
    blame: Report | None,
) -> Mapping[str, JsonValue]:
    if draft.method is None:
        return {}
    model = draft.method.Params
    params = (*draft.location, "params")
    reports = {override.keys[0]: override.report for override in overrides}
    try:
        with guarded():
            checked = model.model_validate_json(json.dumps(as_set), strict=True)
            resolved: dict[str, JsonValue] = checked.model_dump(mode="json")
            # Check the defaults like given values, because the resolved parameters must pass
            # another validation.
            model.model_validate_json(json.dumps(resolved), strict=True)
    except ValidationError as error:
        for loc, message, _ in mistakes(error, model, dict(as_set), draft.id):
            name = str(loc[0]) if loc else ""
            if report := reports.get(name, blame):
                # The position of a report identifies the parameter but not a key inside its value.
                # For datasets, it does not even identify the parameter.
                inside = ProblemLog(file="").path(loc) or f"the parameters of {draft.id}"
                is_named = name in reports and len(loc) == 1
                report(message if is_named else f"{inside}: {message}")
            elif not log.has(params):
                log.report((*draft.location, "use"), message, shown=(*params, *loc))
            else:
                log.report((*params, *loc), message, at_key=bool(loc))
        return {}
    except UserInterrupt:
        raise
    except BaseException as error:  # noqa: BLE001 - a third party's validator may raise anything
        message = f"checking the parameters of {draft.id} failed: {describe_error(error)}"
        log.report_plugin(params, message)
        return {}
    return resolved


def _put(params: dict[str, JsonValue], override: Override) -> None:
    *outer, last = override.keys
    place = params
    for key in outer:
        inner = place.setdefault(key, {})
        if not isinstance(inner, dict):
            override.report(f"{key} is not a mapping, so keys in it cannot be set")
            return
        place = inner
    # Copy the value, because several calls may share it and later settings may modify it.
    place[last] = deepcopy(override.value)


# Parameter -> swept values, each with a function that reports a problem with it.
_Sweeps: TypeAlias = dict[str, list[tuple[JsonValue, Report]]]


def expand_sweeps(
    steps: Sequence[DraftStep], overrides: Overrides, log: ProblemLog
) -> tuple[tuple[DraftStep, ...], Overrides]:
    """Replace each call with swept parameters by one variant per combination of values.

    If `--set` sets a swept parameter, its value, which may be another sweep, replaces the sweep.

    Returns:
        The steps with these variants, and the overrides of their calls, which include the swept
        values.
    """
    expanded: list[DraftStep] = []
    kept: Overrides = {}
    for step in steps:
        calls: list[DraftCall] = []
        taken = {call.name for call in step.calls}
        is_swept = False
        for written in step.calls:
            sweeps, others = _sweeps_of(written, overrides.get((step.name, written.name), ()), log)
            call = _without_sweeps(written)
            if sweeps and _may_vary(step, call, log):
                is_swept = True
                for variant, values in _variants(call, sweeps, taken):
                    calls.append(variant)
                    kept[step.name, variant.name] = (*values, *others)
            else:
                calls.append(replace(call, is_unswept=call != written))
                kept[step.name, call.name] = others
        expanded.append(replace(step, calls=tuple(calls), is_varied=step.is_varied or is_swept))
    return tuple(expanded), kept


def _sweeps_of(
    draft: DraftCall, overrides: Sequence[Override], log: ProblemLog
) -> tuple[_Sweeps, tuple[Override, ...]]:
    found: _Sweeps = {}
    for name, value in draft.call.params.items():
        if _is_sweep(value):
            location = (*draft.location, "params", name)
            swept = validate(SweepSection, value, log, location)
            found[name] = [
                (one, partial(log.report, (*location, SWEEP, index)))
                for index, one in enumerate(swept.sweep if swept else ())
            ]
    others: list[Override] = []
    for override in overrides:
        parameter, *inside = override.keys
        value = override.value
        if inside == [SWEEP]:
            value, inside = {SWEEP: value}, []
        if not inside and _is_sweep(value):
            try:
                swept_values = SweepSection.model_validate(value).sweep
                found[parameter] = [(one, override.report) for one in swept_values]
            except ValidationError:
                override.report(
                    f"expected {{{SWEEP}: [VALUE, VALUE, ...]}} with 2 to {MOST_SWEPT} values and "
                    "no other keys"
                )
            continue
        found.pop(parameter, None)
        others.append(override)
    once = {name: _once(values) for name, values in found.items() if values}
    return once, tuple(others)


def _is_sweep(value: JsonValue) -> bool:
    return isinstance(value, dict) and SWEEP in value


def _once(values: list[tuple[JsonValue, Report]]) -> list[tuple[JsonValue, Report]]:
    kept: dict[str, tuple[JsonValue, Report]] = {}
    for value, report in values:
        text = _canonical(value)
        if text in kept:
            comma = (
                ("; if it is part of a decimal number, write a decimal point: 0.5")
                if value == 0
                else ""
            )
            report(f"{json.dumps(value)} occurs twice in the sweep; remove one of them{comma}")
        kept.setdefault(text, (value, report))
    return list(kept.values())


def _canonical(value: JsonValue) -> str:
    # Treat 1 and 1.0 as the same number.
    whole = int(value) if isinstance(value, float) and value.is_integer() else value
    return json.dumps(whole, sort_keys=True)


def _without_sweeps(draft: DraftCall) -> DraftCall:
    kept = {name: value for name, value in draft.call.params.items() if not _is_sweep(value)}
    if len(kept) == len(draft.call.params):
        return draft
    return replace(draft, call=draft.call.model_copy(update={"params": kept}))


def _may_vary(step: DraftStep, draft: DraftCall, log: ProblemLog) -> bool:
    if not draft.is_source:
        return True
    log.report(
        (*draft.location, "use"),
        f"{draft.id} is a source, so its parameters cannot be swept; use datasets instead: {{a: "
        f"{{set: {{{step.name}.<parameter>: VALUE}}}}, ...}}",
        shown=(*draft.location, "params"),
    )
    return False


def _variants(
    draft: DraftCall, sweeps: _Sweeps, taken: set[str]
) -> Iterator[tuple[DraftCall, tuple[Override, ...]]]:
    combinations = [
        dict(zip(sweeps, chosen, strict=True)) for chosen in itertools.product(*sweeps.values())
    ]
    names = variant_names(
        draft.name, [{name: value for name, (value, _) in one.items()} for one in combinations]
    )
    for name, one in zip(names, combinations, strict=True):
        free = next(text for text in _numbered(name) if text not in taken)
        taken.add(free)
        overrides = tuple(
            Override(report=report, keys=(parameter,), value=value)
            for parameter, (value, report) in one.items()
        )
        swept = {parameter: value for parameter, (value, _) in one.items()}
        yield replace(draft, name=free, swept=swept, family=draft.name), overrides


def _numbered(name: str) -> Iterator[str]:
    yield name
    for count in itertools.count(2):
        yield f"{name[: _LETTERS - len(str(count)) - 1]}-{count}"


def variant_names(before: str, combinations: Sequence[Mapping[str, JsonValue]]) -> list[str]:
    """Name the combinations of a sweep by their exact values or, if this is impossible, by indices.

    The names do not depend on the order of the combinations.

    Args:
        before: name of the variant in the file; empty for a step without variants.
        combinations: parameter -> value, with the same parameters in each.

    >>> variant_names("", [{"tolerance_m": 0.02}, {"tolerance_m": 1e-07}])
    ['tolerance_m-0_02', 'tolerance_m-1em07']
    >>> variant_names("fine", [{"mode": "A b"}, {"mode": "c"}])
    ['fine-sweep-1', 'fine-sweep-2']
    """
    head = [before] if before else []
    names = [
        "-".join([*head, *(f"{name.lower()}-{_word(value)}" for name, value in one.items())])
        for one in combinations
    ]
    is_stated = all(_word(value) for one in combinations for value in one.values())
    is_short = all(re.fullmatch(NAME_PATTERN, name) for name in names)
    if is_stated and is_short and len({*names}) == len(names):
        return names
    # Number the combinations in the order of their values, so that their order in the list does not
    # matter.
    keys = [[_ordered(one[name]) for name in sorted(one)] for one in combinations]
    in_order = sorted(range(len(keys)), key=keys.__getitem__)
    before = before[: _LETTERS - len(f"-{SWEEP}-{len(keys)}")]
    head = [before] if before else []
    return ["-".join([*head, SWEEP, str(1 + in_order.index(k))]) for k in range(len(keys))]


def _ordered(value: JsonValue) -> tuple[int, float, str]:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return 0, float(value), ""
    return 1, 0.0, _canonical(value)


def _word(value: JsonValue) -> str:
    """Return a value in a form that is allowed in names; empty if there is no exact form."""
    if value is None or isinstance(value, bool):
        return {True: "true", False: "false", None: "none"}[value]
    if isinstance(value, int | float):
        # Names must not contain points and signs.
        text = _canonical(value).lower()
        return text.replace("+", "").replace("-", "m").replace(".", "_")
    if isinstance(value, str):
        return value if re.fullmatch(r"[a-z0-9_]+(-[a-z0-9_]+)*", value) else ""
    items = [_word(one) for one in value] if isinstance(value, list) else []
    is_flat = not any(isinstance(one, list) for one in value)
    return "-".join(items) if is_flat and items and all(items) else ""
