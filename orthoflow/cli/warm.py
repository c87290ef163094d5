"""`orthoflow warm`: compile kernels before the first run."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from orthoflow.cli.commands import EXIT_CELL_FAILED, EXIT_GOOD, Command, json_option
from orthoflow.cli.tables import counted, echo, echo_json

if TYPE_CHECKING:
    from orthoflow.catalog.catalog import Catalog

# Together, these shipped recipes run all built-in methods on simulated rooms. The settings make the
# runs short.
_COARSE: Final = ("room.scan_step_m=0.05", "wall.gsd_m=0.05")
_WITH_PHOTOS: Final = ("room.scan_step_m=0.004", "room.photo_gsd_m=0.003")
RECIPES: Final[Mapping[str, tuple[str, ...]]] = {
    "direct": _COARSE,
    "quickstart": _WITH_PHOTOS,
    "plane-methods": ("room.scan_step_m=0.02",),
    "orient-methods": _WITH_PHOTOS,
    "ortho-methods": _WITH_PHOTOS,
}


@click.command(cls=Command)
@click.argument("workflow", metavar="[WORKFLOW]", required=False)
@json_option
def warm(workflow: str | None, *, as_json: bool) -> int:
    """Compile the kernels of all built-in methods, or of the methods in WORKFLOW.

    For this purpose, the methods are run on simulated rooms. Later runs by the same user then do
    not have to compile the kernels. Compiled kernels are kept in the
    user's cache (~/.cache/orthoflow), or in the folder given by the variable NUMBA_CACHE_DIR if
    only this user may write there; never in a store.
    """
    from orthoflow.catalog.discovery import discover_catalog
    from orthoflow.engine.kernels import all_kernels
    from orthoflow.workflow.document import load_workflow
    from orthoflow.workflow.expand import expand_cells

    folder, catalog = all_kernels(), discover_catalog()
    n_before = _n_kernels(folder)
    wanted = set(catalog.methods)
    if workflow is not None:
        asked = expand_cells(load_workflow(workflow, catalog), catalog)
        wanted = {cell.method for cell in asked}
    results = _results(catalog, wanted)
    n_compiled = _n_kernels(folder) - n_before
    failed = {method: reason for method, reason in results.items() if reason}
    if as_json:
        methods = sorted(results.keys() - failed.keys())
        found = {"folder": str(folder), "n_compiled": n_compiled, "n_before": n_before}
        echo_json({**found, "methods": methods, "failed": failed})
    else:
        for method, reason in failed.items():
            echo(f"{method}: {reason}")
        echo(f"compiled {counted(n_compiled, 'kernel')}, available to runs of this user: {folder}")
    return EXIT_CELL_FAILED if failed else EXIT_GOOD


def _results(catalog: Catalog, wanted: Collection[str]) -> dict[str, str]:
    from orthoflow.cli.progress import Progress
    from orthoflow.engine.plan import RunOptions, plan_run
    from orthoflow.engine.scheduler import execute
    from orthoflow.engine.store import Store
    from orthoflow.workflow.document import load_workflow
    from orthoflow.workflow.expand import expand_cells

    results: dict[str, str] = {}
    seen: set[object] = set()
    with tempfile.TemporaryDirectory(prefix="orthoflow-warm-") as scratch:
        store = Store(Path(scratch) / "store")
        for number, (recipe, sets) in enumerate(RECIPES.items()):
            loaded = load_workflow(recipe, catalog, sets=sets)
            cells = {cell.address: cell for cell in expand_cells(loaded, catalog)}
            chosen: set[str] = set()
            for address, cell in cells.items():
                # String and Boolean parameters and the inputs determine which kernels are used;
                # numbers do not.
                words = {k: v for k, v in cell.params_set.items() if isinstance(v, str | bool)}
                call = (cell.method, frozenset(words.items()), frozenset(cell.inputs))
                if cell.method in wanted and not cell.skip_reason and call not in seen:
                    seen.add(call)
                    chosen.add(address)
            for address in reversed(cells):
                if address in chosen:
                    chosen.update(cells[address].sources)
            kept = tuple(cell for address, cell in cells.items() if address in chosen)
            plan = plan_run(kept, loaded, catalog, store, RunOptions())
            with Progress(plan.cells) as progress:
                ended = execute(plan, Path(scratch) / str(number), store, progress.take).results
            for cell in kept:
                if ended[cell.address].status != "skipped":
                    results.setdefault(cell.method, ended[cell.address].error_message)
    return results


def _n_kernels(folder: Path) -> int:
    return sum(1 for _ in folder.rglob("*.nbc"))
