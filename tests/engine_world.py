"""A small plugin of toy methods, installed as a real distribution in a temporary folder."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import PathDistribution
from pathlib import Path

from orthoflow.catalog import Catalog, discover_catalog
from orthoflow.engine import RunOptions, RunOutcome, RunPlan, Store, execute, plan_run
from orthoflow.engine.events import RunEvent
from orthoflow.errors import OrthoflowError
from orthoflow.workflow import expand_cells, load_workflow

HOOKS = """
from orthoflow.sdk.hooks import KindSpec, MethodSpec, ProductSpec, hookimpl

WORKS = ["add", "noise", "sign", "slow", "segfault", "abort", "eat", "hang", "stubborn", "quit",
         "leave", "raises", "refuses", "unreadable", "needs_library", "no_memory", "full_disk",
         "changes_input", "wrong_type", "wrong_out", "bad_param", "draws", "chatty", "unstorable",
         "spawns", "threads", "fills_mapped"]

@hookimpl
def orthoflow_kinds():
    return [
        KindSpec(name="make", summary="makes numbers", is_source=True),
        KindSpec(name="work", summary="works on numbers", inputs={"numbers": "numbers"},
                 outputs={"numbers": "numbers"}),
    ]

@hookimpl
def orthoflow_products():
    return [ProductSpec(type_name="numbers", target="toy_plugin.products:Numbers",
                        summary="numbers", publisher="toy_plugin.products:publish")]

@hookimpl
def orthoflow_methods():
    makes = [MethodSpec(id=f"make.{name}", target=f"toy_plugin.makes:{name.title()}", summary="")
             for name in ("range", "file")]
    works = [MethodSpec(id=f"work.{name}", target=f"toy_plugin.works:{name}", summary="")
             for name in WORKS]
    return makes + works
"""

PRODUCTS = """
from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.products.product import Product

@dataclass(frozen=True, kw_only=True)
class Numbers(Product):
    type_name: ClassVar[str] = "numbers"
    values: NDArray[np.float64]
    note: str = ""

@dataclass(frozen=True, kw_only=True)
class Strangers(Product):
    type_name: ClassVar[str] = "strangers"

def publish(product, folder, digest):
    (folder / "numbers.txt").write_text(f"{digest} {product.values.tolist()}")
"""

MAKES = """
import numpy as np
from pydantic import Field

from orthoflow.errors import InputError
from orthoflow.products import InputFiles
from orthoflow.sdk import Method, MethodParams, Ports
from toy_plugin.products import Numbers

class Range(Method):
    id = "make.range"

    class Params(MethodParams):
        count: int = Field(4, ge=1, description="How many.")

    class In(Ports):
        pass

    class Out(Ports):
        numbers: Numbers

    def run(self, inputs, params, ctx):
        ctx.metric("count", params.count, "1")
        return self.Out(numbers=Numbers(values=np.arange(float(params.count))))

class File(Method):
    id = "make.file"

    class Params(MethodParams):
        pass

    class In(Ports):
        files: InputFiles

    class Out(Ports):
        numbers: Numbers

    def run(self, inputs, params, ctx):
        try:
            values = [float(word) for word in inputs.files.paths[0].read_text().split()]
            return self.Out(numbers=Numbers(values=np.array(values)))
        except ValueError as error:
            raise InputError(f"{inputs.files.paths[0].name} must hold numbers: {error}") from error
"""

WORKS = """
import ctypes
import errno
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
from pydantic import Field

from orthoflow.errors import InputError, MethodError
from orthoflow.sdk import Method, MethodParams, Ports
from toy_plugin.products import Numbers, Strangers

class Work(Method):
    class Params(MethodParams):
        amount: float = Field(1.0, description="How much.")
        steps: int = Field(0, description="How many steps.")

    class In(Ports):
        numbers: Numbers

    class Out(Ports):
        numbers: Numbers

    def run(self, inputs, params, ctx):
        values = self.work(inputs.numbers.values, params, ctx)
        return self.Out(numbers=Numbers(values=np.asarray(values)))

def work(method):
    def named(function):
        class Named(Work):
            id = f"work.{function.__name__}"
            determinism = method
            def work(self, values, params, ctx):
                return function(values, params, ctx)
        Named.__name__ = function.__name__
        return Named
    return named

@work("exact")
def add(values, params, ctx):
    return values + params.amount

@work("seeded")
def noise(values, params, ctx):
    return values + params.amount * ctx.rng.standard_normal(values.shape)

@work("exact")
def sign(values, params, ctx):
    return np.sign(values)

@work("exact")
def slow(values, params, ctx):
    for index in range(params.steps):
        ctx.progress(index / params.steps, f"step {index}")
        time.sleep(0.05)
    return values + params.amount

@work("exact")
def segfault(values, params, ctx):
    ctypes.string_at(0)

@work("exact")
def abort(values, params, ctx):
    os.abort()

@work("exact")
def eat(values, params, ctx):
    hoard = []
    while True:
        hoard.append(np.ones(16 << 20 >> 3))
        time.sleep(0.001)

@work("exact")
def hang(values, params, ctx):
    while not ctx.cancelled():
        time.sleep(0.01)
    raise MethodError("gave up")

@work("exact")
def stubborn(values, params, ctx):
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    time.sleep(600)

@work("exact")
def quit(values, params, ctx):
    print("last words")
    os._exit(7)

@work("exact")
def leave(values, params, ctx):
    sys.exit("bye")

@work("exact")
def raises(values, params, ctx):
    return {}["missing"]

@work("exact")
def refuses(values, params, ctx):
    raise MethodError("no number is large enough")

@work("exact")
def unreadable(values, params, ctx):
    raise InputError("the numbers are unreadable")

@work("exact")
def needs_library(values, params, ctx):
    import no_such_library

@work("exact")
def no_memory(values, params, ctx):
    return np.empty(1 << 46)

@work("exact")
def full_disk(values, params, ctx):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(ctx.scratch / "x"))

@work("exact")
def changes_input(values, params, ctx):
    values += 1.0
    return values

@work("exact")
def draws(values, params, ctx):
    ctx.figure("dot", b"\\x89PNG\\r\\n\\x1a\\n0123", "a dot")
    ctx.warn("the dot is small")
    ctx.metric("dots", 1, "1")
    return values

@work("exact")
def chatty(values, params, ctx):
    print("on stdout")
    os.write(2, b"on stderr \\0 with NUL\\n")
    ctx.log("a line of log")
    return values

@work("exact")
def unstorable(values, params, ctx):
    return np.array([object()])

@work("exact")
def spawns(values, params, ctx):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    return np.array([float(child.pid)])

@work("exact")
def threads(values, params, ctx):
    names = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS")
    cache = os.environ["NUMBA_CACHE_DIR"]
    print(cache, os.getcwd(), ctx.scratch)
    return np.array([ctx.cores, *[float(os.environ[name]) for name in names]])

@work("exact")
def fills_mapped(values, params, ctx):
    array = ctx.allocate("numbers", "values", (8 << 20,), np.float64)
    array[:] = 1.0
    return array

class wrong_type(Work):
    id = "work.wrong_type"
    def run(self, inputs, params, ctx):
        return self.Out(numbers=Strangers())

class wrong_out(Work):
    id = "work.wrong_out"
    def run(self, inputs, params, ctx):
        return inputs.numbers

class bad_param(Work):
    id = "work.bad_param"
    def run(self, inputs, params, ctx):
        ctx.metric("nan", float("nan"), "1")
"""


@dataclass
class World:
    """A working folder with toy methods, a store and a workflow that tests rewrite."""

    folder: Path
    site: Path
    events: list[RunEvent] = field(default_factory=list)

    @property
    def store(self) -> Store:
        return Store(self.folder / "store")

    def catalog(self) -> Catalog:
        importlib.invalidate_caches()
        distribution = PathDistribution(self.site / "toy_plugin-1.0.dist-info")
        (entry_point,) = distribution.entry_points
        return discover_catalog([entry_point])

    def plan(self, steps: str, *, sets: Sequence[str] = (), **options: object) -> RunPlan:
        path = self.folder / "toy.yaml"
        path.write_text(f"orthoflow: 1\nname: toy\nseed: 7\n{steps}")
        catalog = self.catalog()
        workflow = load_workflow(path, catalog, sets=sets)
        cells = expand_cells(workflow, catalog)
        return plan_run(cells, workflow, catalog, self.store, RunOptions(**options))  # type: ignore[arg-type]

    def run(
        self,
        steps: str,
        *,
        into: str = "run",
        sets: Sequence[str] = (),
        store: Store | None = None,
        **options: object,
    ) -> RunOutcome:
        plan = self.plan(steps, sets=sets, **options)
        self.events.clear()
        return execute(plan, self.folder / into, store or self.store, self.events.append)

    def status(self, steps: str, **options: object) -> dict[str, tuple[str, str]]:
        plan = self.plan(steps, **options)  # type: ignore[arg-type]
        return {item.cell.address: (item.status, item.reason) for item in plan.cells}

    def values(self, outcome: RunOutcome, address: str) -> list[float]:
        from toy_plugin.products import Numbers

        digest = outcome.results[address].outputs["numbers"].digest
        return [float(x) for x in self.store.get_product(digest, Numbers).values]


@contextmanager
def toy_world(folder: Path) -> Iterator[World]:
    """Install the toys below a folder and make them importable while the block runs."""
    site = folder / "site"
    if not site.exists():
        install_toys(site)
    sys.path.insert(0, str(site))
    forget_toys()
    try:
        yield World(folder=folder, site=site)
    finally:
        sys.path.remove(str(site))
        forget_toys()


def start_coordinator(world: World, steps: str, into: str) -> subprocess.Popen[bytes]:
    """Run a workflow in a process of its own, which tests may kill."""
    (world.folder / "steps.txt").write_text(steps)
    root = Path(__file__).resolve().parents[1]
    paths = [str(root / part) for part in ("", "plugins", "provenance")]
    return subprocess.Popen(
        [sys.executable, "-m", "tests.engine_world", str(world.folder), into],
        cwd=root,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )


def install_toys(site: Path) -> None:
    """Write the toy plugin with its metadata, as an installer does."""
    package = site / "toy_plugin"
    package.mkdir(parents=True)
    files = {"hooks": HOOKS, "products": PRODUCTS, "makes": MAKES, "works": WORKS, "__init__": ""}
    for name, text in files.items():
        (package / f"{name}.py").write_text(text)
    info = site / "toy_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[orthoflow.plugins]\ntoys = toy_plugin.hooks\n")


def forget_toys() -> None:
    """Let the next import see the plugin as it lies on the disk."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "toy_plugin"]:
        del sys.modules[name]


def _main(folder: Path, into: str) -> None:
    with toy_world(folder) as world:
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        try:
            outcome = world.run((folder / "steps.txt").read_text(), into=into)
        except OrthoflowError as error:
            sys.stdout.write(f"{type(error).__name__}: {error}\n")
            sys.exit(error.exit_code)
        sys.exit(outcome.exit_code)


if __name__ == "__main__":
    _main(Path(sys.argv[1]), sys.argv[2])
