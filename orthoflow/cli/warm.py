"""`orthoflow warm`: compile kernels in advance of runs."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from orthoflow.cli.commands import EXIT_CELL_FAILED, EXIT_GOOD, Command, json_option
from orthoflow.cli.tables import counted, duration, echo, echo_json, size

if TYPE_CHECKING:
    from orthoflow.catalog.catalog import Catalog
    from orthoflow.engine.results import CellResult

# Shipped recipes that together run all built-in methods on simulated rooms, and settings that make
# the rooms small.
_COARSE: Final = ("room.scan_step_m=0.05", "wall.gsd_m=0.05")
_WITH_PHOTOS: Final = ("room.scan_step_m=0.004", "room.photo_gsd_m=0.003")
_RECIPES: Final[Mapping[str, tuple[str, ...]]] = {
    "direct": _COARSE,
    "quickstart": _WITH_PHOTOS,
    "plane-methods": ("room.scan_step_m=0.02",),
    "orient-methods": _WITH_PHOTOS,
    "ortho-methods": _WITH_PHOTOS,
}
_UNKNOWN: Final = "no simulated room uses it; it is compiled in its first run"


@click.command(cls=Command)
@click.argument("workflow", metavar="[WORKFLOW]", required=False)
@json_option
def warm(workflow: str | None, *, as_json: bool) -> int:
    """Compile the kernels of all built-in methods, or of those in WORKFLOW, on simulated rooms.

    Later runs of the same user then need not compile them. They are kept in the user's cache
    (~/.cache/orthoflow), or in the folder given by the variable NUMBA_CACHE_DIR if only this user
    may write there; never in a store.
    """
    warmed = _warm(workflow)
    if as_json:
        echo_json(asdict(warmed))
    else:
        _print(warmed)
    return EXIT_CELL_FAILED if warmed.failed else EXIT_GOOD


@dataclass(frozen=True, kw_only=True)
class Warmed:
    """Result of the command.

    Attributes:
        folder: folder of the kernels.
        n_compiled: number of compiled kernels; each combination of argument types counts.
        n_before: number of kernels that existed before.
        size_bytes: total size of the kernels.
        wall_s: duration.
        methods: methods that were run.
        failed: method -> reason of its failure, unless a library is missing.
        left_out: method -> reason why nothing was compiled for it.
    """

    folder: str
    n_compiled: int
    n_before: int
    size_bytes: int
    wall_s: float
    methods: tuple[str, ...]
    failed: Mapping[str, str]
    left_out: Mapping[str, str]


def _warm(workflow: str | None) -> Warmed:
    from orthoflow.catalog.discovery import discover_catalog
    from orthoflow.engine.durability import size_of
    from orthoflow.engine.kernels import all_kernels
    from orthoflow.workflow.document import load_workflow
    from orthoflow.workflow.expand import expand_cells

    started, folder, catalog = time.monotonic(), all_kernels(), discover_catalog()
    wanted = None
    if workflow is not None:
        cells = expand_cells(load_workflow(workflow, catalog), catalog)
        wanted = {cell.method for cell in cells}
    n_before = _n_kernels(folder)
    results = _results(catalog, wanted)
    reasons = {method: result for method, result in results.items() if result.status != "ok"}
    missing = {method for method, result in reasons.items() if result.exit_code == 4}
    unknown = sorted((wanted or set()) - set(results))
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


def _results(catalog: Catalog, wanted: Collection[str] | None) -> dict[str, CellResult]:
    """Run the recipes in a temporary store; return one result per method, preferably a success.

    Args:
        catalog: the installed plugins.
        wanted: methods to run, with all methods that they need; None for all.
    """
    from orthoflow.cli.progress import Progress
    from orthoflow.engine.plan import RunOptions, needed_addresses, plan_run
    from orthoflow.engine.scheduler import execute
    from orthoflow.engine.store import Store
    from orthoflow.workflow.document import load_workflow
    from orthoflow.workflow.expand import expand_cells

    found: dict[str, CellResult] = {}
    seen: set[object] = set()
    with tempfile.TemporaryDirectory(prefix="orthoflow-warm-") as scratch:
        store = Store(Path(scratch) / "store")
        for recipe, sets in _recipes().items():
            loaded = load_workflow(recipe, catalog, sets=sets)
            cells = {cell.address: cell for cell in expand_cells(loaded, catalog)}
            chosen: set[str] = set()
            for address, cell in cells.items():
                # Texts, flags and inputs decide which kernels are used; numbers do not.
                words = {k: v for k, v in cell.params_set.items() if isinstance(v, str | bool)}
                call = (cell.method, frozenset(words.items()), frozenset(cell.inputs))
                is_wanted = wanted is None or cell.method in wanted
                if is_wanted and not cell.skip_reason and call not in seen:
                    seen.add(call)
                    chosen.add(address)
            for address in reversed(cells):
                if address in chosen:
                    chosen.update(needed_addresses(cells[address]))
            if not chosen:
                continue
            kept = tuple(cell for address, cell in cells.items() if address in chosen)
            plan = plan_run(kept, loaded, catalog, store, RunOptions())
            with Progress(plan.cells) as progress:
                results = execute(plan, Path(scratch) / recipe.stem, store, progress.take).results
            for cell in kept:
                result = results[cell.address]
                is_better = cell.method not in found or found[cell.method].status != "ok"
                if result.status != "skipped" and (wanted is None or cell.method in wanted):
                    found[cell.method] = result if is_better else found[cell.method]
    return found


def _recipes() -> dict[Path, tuple[str, ...]]:
    from orthoflow.workflow.source import shipped_workflow

    return {shipped_workflow(name): sets for name, sets in _RECIPES.items()}


def _n_kernels(folder: Path) -> int:
    return sum(1 for _ in folder.rglob("*.nbc"))


def _print(warmed: Warmed) -> None:
    for method, reason in {**warmed.left_out, **warmed.failed}.items():
        echo(f"{method}: {reason}")
    before = f", {warmed.n_before} already existed" if warmed.n_before else ""
    echo(
        f"compiled {counted(warmed.n_compiled, 'kernel')} of "
        f"{counted(len(warmed.methods), 'method')} in {duration(warmed.wall_s)}{before}",
        f"available to runs of this user: {warmed.folder}, {size(warmed.size_bytes)}",
    )
