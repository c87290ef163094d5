"""`orthoflow warm`: compile what runs would compile, before there is a run."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from orthoflow.cli.commands import EXIT_CELL_FAILED, EXIT_GOOD, Command, json_option
from orthoflow.cli.tables import counted, duration, echo, echo_json, size

if TYPE_CHECKING:
    from orthoflow.catalog.catalog import Catalog
    from orthoflow.engine.plan import RunPlan
    from orthoflow.engine.results import CellResult
    from orthoflow.engine.store import Store
    from orthoflow.workflow.expand import Cell

# Shipped recipes that between them run our methods on simulated rooms, and what makes these small.
_COARSE: Final = ("room.scan_step_m=0.05", "wall.gsd_m=0.05")
_WITH_PHOTOS: Final = ("room.scan_step_m=0.004", "room.photo_gsd_m=0.003")
_RECIPES: Final[Mapping[str, tuple[str, ...]]] = {
    "direct": _COARSE,
    "quickstart": _WITH_PHOTOS,
    "plane-methods": ("room.scan_step_m=0.02",),
    "orient-methods": _WITH_PHOTOS,
    "ortho-methods": _WITH_PHOTOS,
}
_UNKNOWN: Final = "no simulated room uses it: it is compiled when it first runs"


@click.command(cls=Command)
@click.argument("workflow", metavar="[WORKFLOW]", required=False)
@json_option
def warm(workflow: str | None, *, as_json: bool) -> int:
    """Compile the kernels of all our methods, or of those in WORKFLOW, on small simulated rooms.

    Runs of this user then find them, instead of compiling. They are kept in the user's cache
    (~/.cache/orthoflow), or in the folder that the variable NUMBA_CACHE_DIR names, as long as
    nobody else may write there; never in a store.
    """
    warmed = _warm(workflow)
    if as_json:
        echo_json(asdict(warmed))
    else:
        _print(warmed)
    return EXIT_CELL_FAILED if warmed.failed else EXIT_GOOD


@dataclass(frozen=True, kw_only=True)
class Warmed:
    """What one call did.

    Attributes:
        folder: where the kernels are.
        n_compiled: kernels that were compiled, each type of arguments for itself.
        n_before: kernels that were there already.
        size_bytes: of all of them.
        wall_s: how long it took.
        methods: that ran.
        failed: method -> why it could not be run, where that is no missing library.
        left_out: method -> why nothing was compiled for it.
    """

    folder: str
    n_compiled: int
    n_before: int
    size_bytes: int
    wall_s: float
    methods: tuple[str, ...]
    failed: Mapping[str, str]
    left_out: Mapping[str, str]


@dataclass(frozen=True)
class _Call:
    """A method with the words and switches among its parameters, and the inputs that it gets.

    Numbers decide what kernels compute, not which.
    """

    method: str
    words: tuple[tuple[str, str | bool], ...] = ()
    ports: frozenset[str] = frozenset()

    @classmethod
    def of(cls, cell: Cell) -> _Call:
        """Return the call of a cell."""
        words = [
            (name, value)
            for name, value in sorted(cell.params_set.items())
            if isinstance(value, str | bool)
        ]
        return cls(cell.method, tuple(words), frozenset(cell.inputs))


def _warm(workflow: str | None) -> Warmed:
    from orthoflow.catalog.discovery import discover_catalog
    from orthoflow.engine.durability import size_of
    from orthoflow.engine.kernels import all_kernels

    started, folder, catalog = time.monotonic(), all_kernels(), discover_catalog()
    wanted = _calls_of(workflow, catalog) if workflow is not None else None
    n_before = _n_kernels(folder)
    results = _results(catalog, wanted)
    reasons = {method: result for method, result in results.items() if result.status != "ok"}
    missing = {method for method, result in reasons.items() if result.exit_code == 4}
    unknown = sorted({call.method for call in wanted or ()} - set(results))
    return Warmed(
        folder=str(folder),
        n_compiled=_n_kernels(folder) - n_before,
        n_before=n_before,
        size_bytes=size_of(folder),
        wall_s=round(time.monotonic() - started, 1),
        methods=tuple(sorted(results.keys() - reasons.keys())),
        failed={name: reasons[name].error_message for name in sorted(reasons.keys() - missing)},
        left_out={
            **{name: reasons[name].error_message for name in sorted(missing)},
            **dict.fromkeys(unknown, _UNKNOWN),
        },
    )


def _calls_of(workflow: str, catalog: Catalog) -> frozenset[_Call]:
    from orthoflow.workflow.document import load_workflow
    from orthoflow.workflow.expand import expand_cells

    loaded = load_workflow(workflow, catalog)
    calls = {_Call.of(cell) for cell in expand_cells(loaded, catalog)}
    # Where no recipe has just these inputs or words, what comes near.
    near = {replace(call, ports=frozenset()) for call in calls}
    return frozenset(calls | near | {_Call(call.method) for call in calls})


def _results(catalog: Catalog, wanted: Collection[_Call] | None) -> dict[str, CellResult]:
    """Run the recipes in a store that goes away; give one result per method, a good one first."""
    from orthoflow.engine.plan import RunOptions, plan_run
    from orthoflow.engine.store import Store
    from orthoflow.workflow.document import load_workflow
    from orthoflow.workflow.expand import expand_cells

    found: dict[str, CellResult] = {}
    methods = None if wanted is None else {call.method for call in wanted}
    seen: set[_Call] = set()
    with tempfile.TemporaryDirectory(prefix="orthoflow-warm-") as scratch:
        store = Store(Path(scratch) / "store")
        for recipe, sets in _recipes().items():
            loaded = load_workflow(recipe, catalog, sets=sets)
            cells = _new_cells(expand_cells(loaded, catalog), wanted, seen)
            plan = plan_run(cells, loaded, catalog, store, RunOptions())
            for method, result in _executed(plan, Path(scratch) / recipe.stem, store):
                if methods is None or method in methods:
                    is_better = method not in found or found[method].status != "ok"
                    found[method] = result if is_better else found[method]
    return found


def _recipes() -> dict[Path, tuple[str, ...]]:
    from orthoflow.workflow.source import (
        shipped_workflow,
    )

    return {shipped_workflow(name): sets for name, sets in _RECIPES.items()}


def _new_cells(
    cells: Iterable[Cell], wanted: Collection[_Call] | None, seen: set[_Call]
) -> tuple[Cell, ...]:
    """The cells that may need other kernels than those before, and all that these need."""
    from orthoflow.engine.plan import needed_addresses

    by_address = {cell.address: cell for cell in cells}
    chosen: set[str] = set()
    for address, cell in by_address.items():
        call = _Call.of(cell)
        near = replace(call, ports=frozenset())
        call = call if wanted is None or call in wanted else near
        is_wanted = wanted is None or call in wanted
        if is_wanted and call not in seen and not cell.skip_reason:
            seen.update((call, near))
            chosen.add(address)
    for address in reversed(by_address):
        if address in chosen:
            chosen.update(needed_addresses(by_address[address]))
    return tuple(cell for address, cell in by_address.items() if address in chosen)


def _executed(plan: RunPlan, folder: Path, store: Store) -> list[tuple[str, CellResult]]:
    from orthoflow.cli.progress import make_progress
    from orthoflow.engine.scheduler import execute

    if not plan.cells:
        return []
    with make_progress(plan.cells) as progress:
        results = execute(plan, folder, store, progress.take).results
    return [
        (item.cell.method, results[item.cell.address])
        for item in plan.cells
        if results[item.cell.address].status != "skipped"
    ]


def _n_kernels(folder: Path) -> int:
    return sum(1 for _ in folder.rglob("*.nbc"))


def _print(warmed: Warmed) -> None:
    for method, reason in {**warmed.left_out, **warmed.failed}.items():
        echo(f"{method}: {reason}")
    before = f", {warmed.n_before} were there" if warmed.n_before else ""
    echo(
        f"compiled {counted(warmed.n_compiled, 'kernel')} of "
        f"{counted(len(warmed.methods), 'method')} in {duration(warmed.wall_s)}{before}",
        f"runs of this user find them: {warmed.folder}, {size(warmed.size_bytes)}",
    )
