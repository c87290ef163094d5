"""Reading the `steps` section into drafts that still know their places in the file."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Final

from orthoflow.catalog import Catalog
from orthoflow.errors import PluginError, WorkflowError
from orthoflow.files.yaml_positions import (
    Entry,
    Listing,
    Position,
    Table,
    Text,
    Value,
    describe,
    join,
)
from orthoflow.sdk.hooks import KindSpec
from orthoflow.workflow.expectations import (
    NAME,
    expect_named,
    expect_table,
    expect_text,
    expect_whole_number,
)
from orthoflow.workflow.methods import MethodInfo, describe_method
from orthoflow.workflow.model import INPUTS, Reference
from orthoflow.workflow.problems import ProblemLog

_CALL_KEYS: Final = ("use", "params", "repeat", "resources", "timeout")
_STEP_KEYS: Final = ("use", "in", "params", "repeat", "resources", "timeout", "unless", "variants")
_REFERENCE: Final = re.compile(rf"({NAME})\.({NAME})")
_DURATION: Final = re.compile(r"(\d+(?:\.\d+)?) *(s|min|h)")
_SECONDS: Final = {"s": 1.0, "min": 60.0, "h": 3600.0}


@dataclass(frozen=True, kw_only=True)
class DraftReference:
    """A reference with its place."""

    position: Position
    path: str
    reference: Reference


@dataclass(frozen=True, kw_only=True)
class DraftPort:
    """A wired port with its place."""

    position: Position
    path: str
    name: str
    references: tuple[DraftReference, ...]


@dataclass(frozen=True, kw_only=True)
class DraftVariant:
    """A method call with its place.

    Attributes:
        position: of `use`, or of the step or variant when that is missing.
        path: of the mapping that holds `use`.
        name: of the variant, empty for a step without variants.
        method: id as written, empty when missing.
        info: the method, None when it cannot be loaded.
        kind: ports of its kind, known even when the method is not.
        params: as written.
    """

    position: Position
    path: str
    name: str
    method: str
    info: MethodInfo | None
    kind: KindSpec | None
    params: Table | None
    repeat: int
    cores: int | None
    timeout_s: float | None


@dataclass(frozen=True, kw_only=True)
class DraftStep:
    """A step with its place."""

    position: Position
    path: str
    name: str
    variants: tuple[DraftVariant, ...]
    ports: tuple[DraftPort, ...]
    unless: DraftReference | None
    is_varied: bool


def read_steps(value: Value, catalog: Catalog, log: ProblemLog) -> tuple[DraftStep, ...]:
    """Read all steps; what is wrong with them goes to the log."""
    entries = expect_named(value, "steps", log)
    if isinstance(value, Table) and not value.entries:
        log.add(value.position, "steps", "a workflow needs at least one step")
    reader = _StepReader(catalog=catalog, log=log)
    return tuple(step for entry in entries if (step := reader.read(entry)) is not None)


@dataclass(frozen=True, kw_only=True)
class _StepReader:
    catalog: Catalog
    log: ProblemLog

    def read(self, entry: Entry) -> DraftStep | None:
        path = join("steps", entry.key)
        if entry.key == INPUTS:
            self.log.add(entry.position, path, "a step cannot be called inputs, which names files")
            return None
        table = expect_table(entry.value, path, self.log, _STEP_KEYS)
        if table is None:
            return None
        is_varied = table.get("variants") is not None
        if is_varied:
            variants = self._variants(table, path)
        else:
            variants = (self._call(entry.position, "", table, path),)
        unless = table.get("unless")
        wires = table.get("in")
        return DraftStep(
            position=entry.position,
            path=path,
            name=entry.key,
            variants=variants,
            ports=self._ports(wires.value, join(path, "in")) if wires else (),
            unless=self._reference(unless.value, join(path, "unless")) if unless else None,
            is_varied=is_varied,
        )

    def _variants(self, table: Table, path: str) -> tuple[DraftVariant, ...]:
        for key in _CALL_KEYS:
            if misplaced := table.get(key):
                self.log.add(
                    misplaced.position,
                    join(path, key),
                    f"with variants, {key} belongs into each of them",
                )
        section = table.get("variants")
        entries = expect_named(section.value, join(path, "variants"), self.log) if section else ()
        if section and isinstance(section.value, Table) and not section.value.entries:
            self.log.add(section.position, join(path, "variants"), "expected at least one variant")
        calls: list[DraftVariant] = []
        for entry in entries:
            variant_path = f"{path}.variants.{entry.key}"
            call = expect_table(entry.value, variant_path, self.log, _CALL_KEYS)
            if call is not None:
                calls.append(self._call(entry.position, entry.key, call, variant_path))
        self._check_kinds(calls)
        return tuple(calls)

    def _check_kinds(self, calls: list[DraftVariant]) -> None:
        kinds = [call.kind for call in calls if call.kind is not None]
        for call in calls:
            if call.kind is None:
                continue
            if call.kind.is_source:
                self.log.add(
                    call.position,
                    join(call.path, "use"),
                    f"{call.method} is a source, and sources take no variants; give it a step",
                )
            elif call.kind.name != kinds[0].name:
                self.log.add(
                    call.position,
                    join(call.path, "use"),
                    f"variants of a step must be of one kind, got {call.kind.name} beside "
                    f"{kinds[0].name}",
                )

    def _call(self, position: Position, name: str, table: Table, path: str) -> DraftVariant:
        use = table.get("use")
        method = expect_text(use.value, join(path, "use"), self.log) if use else None
        if use is None:
            self.log.add(position, path, "needs the key use, a method such as plane.hough2d")
        where = use.value.position if use else position
        info = self._method(method, where, join(path, "use")) if method else None
        kind = self.catalog.kinds.get((method or "").partition(".")[0])
        params = table.get("params")
        return DraftVariant(
            position=where,
            path=path,
            name=name,
            method=method or "",
            info=info,
            kind=kind.spec if kind is not None and kind.state == "fine" else None,
            params=expect_table(params.value, join(path, "params"), self.log) if params else None,
            repeat=self._repeat(table.get("repeat"), path, info),
            cores=self._cores(table.get("resources"), path),
            timeout_s=self._timeout(table.get("timeout"), path),
        )

    def _method(self, method: str, position: Position, path: str) -> MethodInfo | None:
        try:
            return describe_method(self.catalog, method)
        except WorkflowError as error:
            self.log.add(position, path, str(error))
        except PluginError as error:
            self.log.add_plugin(position, path, str(error))
        return None

    def _repeat(self, entry: Entry | None, path: str, info: MethodInfo | None) -> int:
        if entry is None:
            return 1
        path = join(path, "repeat")
        repeat = expect_whole_number(entry.value, path, self.log, minimum=1)
        if info is not None and info.method.determinism == "exact" and (repeat or 1) > 1:
            self.log.add(
                entry.position,
                path,
                f"{info.id} gives the same result every time, so repeating it tells nothing; "
                f"remove repeat",
            )
        return repeat or 1

    def _cores(self, entry: Entry | None, path: str) -> int | None:
        if entry is None:
            return None
        path = join(path, "resources")
        table = expect_table(entry.value, path, self.log, ("cores",))
        cores = table.get("cores") if table else None
        if cores is None:
            return None
        return expect_whole_number(cores.value, join(path, "cores"), self.log, minimum=1)

    def _timeout(self, entry: Entry | None, path: str) -> float | None:
        if entry is None:
            return None
        raw = entry.value.value if isinstance(entry.value, Text) else None
        seconds = 0.0
        if isinstance(raw, int | float) and not isinstance(raw, bool):
            seconds = float(raw)
        elif isinstance(raw, str) and (match := _DURATION.fullmatch(raw)):
            seconds = float(match[1]) * _SECONDS[match[2]]
        if math.isfinite(seconds) and seconds > 0:
            return seconds
        self.log.add(
            entry.value.position,
            join(path, "timeout"),
            f"expected a time such as 90s, 30min, 2h or a number of seconds above 0, got "
            f"{describe(entry.value)}",
        )
        return None

    def _ports(self, value: Value, path: str) -> tuple[DraftPort, ...]:
        table = expect_table(value, path, self.log)
        return tuple(
            DraftPort(
                position=entry.position,
                path=join(path, entry.key),
                name=entry.key,
                references=self._references(entry.value, join(path, entry.key)),
            )
            for entry in table or ()
        )

    def _references(self, value: Value, path: str) -> tuple[DraftReference, ...]:
        if not isinstance(value, Listing):
            reference = self._reference(value, path)
            return (reference,) if reference else ()
        if not value.items:
            self.log.add(value.position, path, "expected at least one reference, got an empty list")
        references = (
            self._reference(item, f"{path}[{index}]") for index, item in enumerate(value.items)
        )
        return tuple(reference for reference in references if reference)

    def _reference(self, value: Value, path: str) -> DraftReference | None:
        raw = value.value if isinstance(value, Text) else None
        match = _REFERENCE.fullmatch(raw) if isinstance(raw, str) else None
        if match is None:
            message = f"expected step.port or inputs.name, got {describe(value)}"
            self.log.add(value.position, path, message)
            return None
        return DraftReference(
            position=value.position, path=path, reference=Reference(source=match[1], name=match[2])
        )
