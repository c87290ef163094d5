"""The source of the toy plugin: two sources of numbers, and methods that fail in every way."""

from __future__ import annotations

HOOKS = """
from orthoflow.sdk.hooks import KindSpec, MethodSpec, ProductSpec, hookimpl
from toy_plugin.mischief_names import MISCHIEF

WORKS = ["add", "noise", "sign", "slow", "segfault", "abort", "eat", "hang", "stubborn", "quit",
         "leave", "raises", "refuses", "unreadable", "needs_library", "no_memory",
         "changes_input", "wrong_type", "wrong_out", "bad_param", "draws", "chatty", "unstorable",
         "spawns", "spawns_and_waits", "threads", "compiles", "loads",
         "bad_disk"]

@hookimpl
def orthoflow_kinds():
    return [
        KindSpec(name="make", summary="makes numbers", is_source=True),
        KindSpec(name="work", summary="works on numbers", inputs={"numbers": "numbers"},
                 outputs={"numbers": "numbers"}),
        KindSpec(name="thin", summary="makes few of many", inputs={"scan": "scan"},
                 outputs={"numbers": "numbers"}),
    ]

@hookimpl
def orthoflow_products():
    return [ProductSpec(type_name="numbers", target="toy_plugin.products:Numbers",
                        summary="numbers", publisher="toy_plugin.products:publish"),
            ProductSpec(type_name="scan", target="toy_plugin.products:Scan", summary="many")]

@hookimpl
def orthoflow_methods():
    makes = [MethodSpec(id=f"make.{name}", target=f"toy_plugin.makes:{name.title()}", summary="")
             for name in ("range", "file", "scan", "survey")]
    works = [MethodSpec(id=f"work.{name}", target=f"toy_plugin.works:{name}", summary="")
             for name in WORKS]
    thins = [MethodSpec(id=f"thin.{name}", target=f"toy_plugin.works:{name.title()}", summary="")
             for name in ("means", "sketch")]
    mischief = [MethodSpec(id=f"work.{name}", target=f"toy_plugin.mischief:{name}", summary="")
                for name in MISCHIEF]
    return [*makes, *works, *thins, *mischief]
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
class Scan(Product):
    type_name: ClassVar[str] = "scan"
    mapped: ClassVar[bool] = True
    embedded: ClassVar[bool] = False
    values: NDArray[np.float64]

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
from toy_plugin import products
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

class Scan(Method):
    id = "make.scan"

    class Params(MethodParams):
        count: int = Field(8000, ge=1, description="How many.")

    class In(Ports):
        pass

    class Out(Ports):
        scan: products.Scan

    def run(self, inputs, params, ctx):
        values = np.sqrt(np.arange(float(params.count)))
        return self.Out(scan=products.Scan(values=values))

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

class Survey(Method):
    id = "make.survey"

    class Params(MethodParams):
        pass

    class In(Ports):
        files: InputFiles

    class Out(Ports):
        scan: products.Scan

    def run(self, inputs, params, ctx):
        numbers = [float(word) for word in inputs.files.paths[0].read_text().split()]
        values = ctx.allocate("scan", "values", (1000 * len(numbers),), np.float64)
        values[:] = np.outer(numbers, np.sqrt(np.arange(1000.0))).ravel()
        return self.Out(scan=products.Scan(values=values))
"""

WORKS = """
import ctypes
import errno
import gc
import os
import resource
import signal
import subprocess
import sys
import threading
import time

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import InputError, MethodError
from orthoflow.sdk import Method, MethodParams, Ports
from toy_plugin.products import Numbers, Scan, Strangers

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
def compiles(values, params, ctx):
    # A kernel that takes so many seconds to compile.
    import numba
    from numba.extending import overload

    def slowly_typed(values):
        raise NotImplementedError

    waited = []

    @overload(slowly_typed)
    def typed(values):
        if not waited:
            waited.append(True)
            time.sleep(params.amount - 1)
            end_s = time.thread_time() + 1
            while time.thread_time() < end_s:
                pass
        return lambda values: values

    @numba.njit(nogil=True)
    def kernel(values):
        return slowly_typed(values) + 1.0

    started, started_cpu = ctx.clock_s(), ctx.processor_s()
    kernel(values)
    result = kernel(values)
    time.sleep(0.2)
    ctx.metric("kernel_s", ctx.clock_s() - started, "s")
    ctx.metric("kernel_cpu_s", ctx.processor_s() - started_cpu, "s")
    return result

@work("exact")
def loads(values, params, ctx):
    # A library that takes its time to load, and one that a daemon thread loads.
    started = ctx.clock_s()
    thread = threading.Thread(target=lambda: __import__("toy_plugin.aside"), daemon=True)
    thread.start()
    thread.join()
    from toy_plugin import heavy

    ctx.metric("loads_s", ctx.clock_s() - started, "s")
    searched = [item for item in gc.get_objects() if type(item).__name__ == "Loaded"]
    ctx.metric("n_searched", len(searched), "1")
    return values

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
    raise InputError("a.csv:2: no number\\na.csv:3: two numbers")

@work("exact")
def needs_library(values, params, ctx):
    import no_such_library

@work("exact")
def no_memory(values, params, ctx):
    return np.empty(1 << 46)

@work("exact")
def bad_disk(values, params, ctx):
    place = ctx.scratch / "x" if params.steps else "/elsewhere/x"
    raise OSError(int(params.amount), os.strerror(int(params.amount)), str(place))

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
def spawns_and_waits(values, params, ctx):
    sleeper = [sys.executable, "-c", "import time; time.sleep(600)"]
    child = subprocess.Popen(sleeper, start_new_session=True)
    ctx.log(f"started {child.pid}")
    child.wait()

@work("exact")
def threads(values, params, ctx):
    names = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS")
    cache = os.environ["NUMBA_CACHE_DIR"]
    print(cache, os.getcwd(), ctx.scratch)
    return np.array([ctx.cores, *[float(os.environ[name]) for name in names]])

class Means(Method):
    id = "thin.means"
    determinism = "exact"

    class Params(MethodParams):
        pass

    class In(Ports):
        scan: Scan

    class Out(Ports):
        numbers: Numbers

    def run(self, inputs, params, ctx):
        return self.Out(numbers=Numbers(values=inputs.scan.values.reshape(-1, 1000).mean(axis=1)))

class Sketch(Means):
    id = "thin.sketch"

    def run(self, inputs, params, ctx):
        ctx.figure("dot", b"\\x89PNG\\r\\n\\x1a\\n0123", "a dot")
        ctx.warn("the dot is small")
        ctx.metric("dots", 1, "1")
        return super().run(inputs, params, ctx)

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
