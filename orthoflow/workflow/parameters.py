"""Checking a method call's parameters and filling in the defaults."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from orthoflow.catalog import did_you_mean
from orthoflow.files.yaml_positions import Listing, Position, Table, Value, describe_scalar, plain
from orthoflow.products.product import JsonValue
from orthoflow.workflow.methods import MethodInfo
from orthoflow.workflow.overrides import Override
from orthoflow.workflow.problems import ProblemLog
from orthoflow.workflow.steps import DraftVariant


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
    variant: DraftVariant, overrides: Sequence[Override], log: ProblemLog
) -> ResolvedParams:
    """Check the parameters of a method call, strictly: the text "0.003" is not a number."""
    written = plain(variant.params) if variant.params else {}
    as_set: dict[str, JsonValue] = written if isinstance(written, dict) else {}
    for override in overrides:
        _put(as_set, override, log)
    info = variant.info
    if info is None:
        return ResolvedParams(as_set=as_set)
    try:
        params = info.method.Params.model_validate_json(json.dumps(as_set), strict=True)
        resolved = params.model_dump(mode="json")
    except ValidationError as error:
        options = {override.keys[0]: override.option for override in overrides}
        reporter = _Reporter(variant=variant, info=info, options=options, log=log)
        for details in error.errors(include_url=False):
            reporter.report(details)
        return ResolvedParams(as_set=as_set)
    except Exception as error:  # noqa: BLE001 - a stranger's validator may raise anything
        log.add_plugin(
            variant.position,
            f"{variant.path}.params",
            f"checking the parameters of {info.id} failed: {type(error).__name__}: {error}",
        )
        return ResolvedParams(as_set=as_set)
    return ResolvedParams(resolved=resolved, as_set=as_set)


def _put(params: dict[str, JsonValue], override: Override, log: ProblemLog) -> None:
    *outer, last = override.keys
    place = params
    for key in outer:
        inner = place.setdefault(key, {})
        if not isinstance(inner, dict):
            log.add_option(override.option, f"{key} is no mapping, so nothing in it can be set")
            return
        place = inner
    place[last] = override.value


@dataclass(frozen=True, kw_only=True)
class _Reporter:
    """Turns pydantic's errors into problems of the file or of a `--set`."""

    variant: DraftVariant
    info: MethodInfo
    options: Mapping[str, str]
    log: ProblemLog

    def report(self, details: ErrorDetails) -> None:
        location = details["loc"]
        message = self._message(details)
        name = str(location[0]) if location else ""
        if name in self.options:
            self.log.add_option(self.options[name], message)
            return
        path = "".join(
            f"[{part}]" if isinstance(part, int) else f".{part}" for part in ("params", *location)
        )
        position = self._position(location)
        self.log.add(position, f"{self.variant.path}{path}", message)

    def _message(self, details: ErrorDetails) -> str:
        location = details["loc"]
        name = str(location[-1]) if location else "the parameters"
        match details["type"]:
            case "extra_forbidden":
                known = tuple(self.info.method.Params.model_fields) if len(location) == 1 else ()
                listed = f"; {self.info.id} has {', '.join(known) or 'none'}" if known else ""
                return f"unknown parameter {name}{did_you_mean(name, known)}{listed}"
            case "missing":
                return f"{self.info.id} needs parameter {name}"
            case "value_error" | "assertion_error":
                reason = str(details.get("ctx", {}).get("error", details["msg"]))
                return f"{name}: {reason}"
        words = details["msg"][:1].lower() + details["msg"][1:]
        return f"{name}: {words}, got {_shown(details['input'])}"

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
