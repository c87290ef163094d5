"""Reading the `steps` section into drafts that still know their places in the file."""

from __future__ import annotations

from dataclasses import dataclass

from orthoflow.catalog.catalog import Catalog
from orthoflow.errors import PluginError, WorkflowError
from orthoflow.files.yaml_positions import Entry, Position, Table, Value, join
from orthoflow.sdk.hooks import KindSpec
from orthoflow.workflow.format import (
    CALL,
    CORES,
    IF,
    IN,
    PARAMS,
    REPEAT,
    RESOURCES,
    STEP,
    STEPS,
    TIMEOUT,
    UNLESS,
    USE,
    VARIANTS,
    StepVariant,
)
from orthoflow.workflow.methods import MethodInfo, describe_method
from orthoflow.workflow.problems import ProblemLog
from orthoflow.workflow.shapes import PlacedPort, PlacedReference


@dataclass(frozen=True, kw_only=True)
class DraftVariant:
    """A method call with its place.

    Attributes:
        position: of `use`, or of the step or variant when that is missing.
        path: of the mapping that holds `use`.
        call: what is said of it, its parameters still unread; without a method where the file
            names none.
        info: the method, None when it cannot be loaded.
        kind: ports of its kind, known even when the method is not.
        params: as written.
        swept: names of the parameters whose values its name says.
        family: of a swept one, the name of the variant that it came from; empty without.
        is_unswept: the file sweeps it, and the command line gives it one value.
    """

    position: Position
    path: str
    call: StepVariant
    info: MethodInfo | None
    kind: KindSpec | None
    params: Table | None
    swept: tuple[str, ...] = ()
    family: str = ""
    is_unswept: bool = False


@dataclass(frozen=True, kw_only=True)
class DraftStep:
    """A step with its place."""

    position: Position
    path: str
    name: str
    variants: tuple[DraftVariant, ...]
    ports: tuple[PlacedPort, ...]
    only_if: PlacedReference | None
    unless: PlacedReference | None
    is_varied: bool


def read_steps(value: Value, catalog: Catalog, log: ProblemLog) -> tuple[DraftStep, ...]:
    """Read all steps; what is wrong with them goes to the log."""
    reader = _StepReader(catalog=catalog, log=log)
    entries = STEPS.shape.read(value, STEPS.name, log) or ()
    return tuple(step for entry in entries if (step := reader.read(entry)) is not None)


@dataclass(frozen=True, kw_only=True)
class _StepReader:
    catalog: Catalog
    log: ProblemLog

    def read(self, entry: Entry) -> DraftStep | None:
        path = join(STEPS.name, entry.key)
        table = STEP.read(entry.value, path, self.log)
        if table is None:
            return None
        is_varied = table.get(VARIANTS.name) is not None
        if is_varied:
            variants = self._variants(table, path)
        else:
            variants = (self._call(entry.position, "", table, path),)
        return DraftStep(
            position=entry.position,
            path=path,
            name=entry.key,
            variants=variants,
            ports=IN.read(table, path, self.log) or (),
            only_if=IF.read(table, path, self.log),
            unless=UNLESS.read(table, path, self.log),
            is_varied=is_varied,
        )

    def _variants(self, table: Table, path: str) -> tuple[DraftVariant, ...]:
        for key in CALL.keys:
            if misplaced := table.get(key.name):
                self.log.add(
                    misplaced.position,
                    join(path, key.name),
                    f"with variants, {key.name} belongs into each of them",
                )
        calls: list[DraftVariant] = []
        for entry in VARIANTS.read(table, path, self.log) or ():
            variant_path = f"{path}.{VARIANTS.name}.{entry.key}"
            call = CALL.read(entry.value, variant_path, self.log)
            if call is not None:
                calls.append(self._call(entry.position, entry.key, call, variant_path))
        self._check_kinds(calls)
        return tuple(calls)

    def _check_kinds(self, drafts: list[DraftVariant]) -> None:
        kinds = [draft.kind for draft in drafts if draft.kind is not None]
        for draft in drafts:
            if draft.kind is None:
                continue
            if draft.kind.is_source:
                self.log.add(
                    draft.position,
                    join(draft.path, USE.name),
                    f"{draft.call.method} is a source, and sources take no variants; give it a "
                    f"step",
                )
            elif draft.kind.name != kinds[0].name:
                self.log.add(
                    draft.position,
                    join(draft.path, USE.name),
                    f"variants of a step must be of one kind, got {draft.kind.name} beside "
                    f"{kinds[0].name}",
                )

    def _call(self, position: Position, name: str, table: Table, path: str) -> DraftVariant:
        use = table.get(USE.name)
        method = USE.read(table, path, self.log)
        if use is None:
            self.log.add(position, path, "needs the key use, a method such as plane.hough2d")
        where = use.value.position if use else position
        info = self._method(method, where, join(path, USE.name)) if method else None
        kind = self.catalog.kinds.get((method or "").partition(".")[0])
        return DraftVariant(
            position=where,
            path=path,
            call=StepVariant(
                name=name,
                method=method or "",
                repeat=REPEAT.read(table, path, self.log) or 1,
                cores=self._cores(table, path),
                timeout_s=TIMEOUT.read(table, path, self.log),
            ),
            info=info,
            kind=kind.spec if kind is not None and kind.state == "fine" else None,
            params=PARAMS.read(table, path, self.log),
        )

    def _method(self, method: str, position: Position, path: str) -> MethodInfo | None:
        try:
            return describe_method(self.catalog, method)
        except WorkflowError as error:
            self.log.add(position, path, str(error))
        except PluginError as error:
            self.log.add_plugin(position, path, str(error))
        return None

    def _cores(self, table: Table, path: str) -> int | None:
        resources = RESOURCES.read(table, path, self.log)
        if resources is None:
            return None
        return CORES.read(resources, join(path, RESOURCES.name), self.log)
