"""Fixtures that several test modules share."""

from __future__ import annotations

import gc
import multiprocessing.util
import os
import signal
import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, ExitStack, suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from _pytest.doctest import DoctestModule
from hypothesis import HealthCheck, settings

from orthoflow.engine.kernels import private_folder
from orthoflow.sdk import StepContext
from orthoflow.sdk.context import Drawing
from tests.kept_memory import KEPT_MEMORY
from tests.long_loops import IS_LONG
from tests.memory_folder import has_room, in_memory
from tests.optional import REASONS, is_allowed, skip
from tests.undrawn_charts import FIGURE, keep_dot

if TYPE_CHECKING:
    from tests.browser import Page
    from tests.engine_world import World

_ROOT = Path(__file__).resolve().parents[1]


# As the command line has it. A search for garbage goes through all that eight thousand tests and
# the libraries hold; with Python's own threshold that was a fifth of what detecting planes took.
gc.set_threshold(50_000, *gc.get_threshold()[1:])

# For what numba compiles, set before anything imports it: in the private cache of the user, for the
# tests and for the steps that they run.
os.environ.setdefault("NUMBA_CACHE_DIR", str(private_folder("numba")))

# The same settings as for steps, for the test processes, too: libraries read them when loaded.
os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "20")

# There is a process of tests for each core. With as many threads each, products of small matrices
# take several times longer: threads wait for each other on cores that others have. What methods
# give with two is compared by the conformance suite; steps have as many threads as cores, as ever.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Containers set it to keep images small. Each command that a test starts would compile the sources
# anew: 0.7 s instead of 0.5 to import what it needs.
if os.environ.pop("PYTHONDONTWRITEBYTECODE", ""):
    sys.dont_write_bytecode = False

# The same examples on every machine, however slow it is; the long loop draws others each time.
settings.register_profile(
    "everywhere",
    deadline=None,
    max_examples=100 if IS_LONG else 25,
    derandomize=not IS_LONG,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("everywhere")

_LACKING = "orthoflow/lacking-programs"
_SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int | None:
    """Spread tests over a process more than there are cores: one of them often waits."""
    if os.environ.get("PYTEST_XDIST_AUTO_NUM_WORKERS"):
        return None
    return len(os.sched_getaffinity(0)) + 1 if sys.platform == "linux" else None


def pytest_configure(config: pytest.Config) -> None:
    """Write into memory; the processes that tests are spread over write where this one does."""
    # Where a shell has started the tests in the background, interrupts are ignored.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # What servers of steps need lies elsewhere: they end later than the folder in memory.
    multiprocessing.util.get_temp_dir()
    config.pluginmanager.register(_Examples())  # a hook of this module sees files beside it only
    is_spread = "PYTEST_XDIST_WORKER" in os.environ
    if is_spread:  # it has read them; what it starts is as elsewhere
        for name in KEPT_MEMORY:
            os.environ.pop(name, None)
    elif config.getoption("tx", None):
        os.environ.update(KEPT_MEMORY)
    if not is_spread and config.option.basetemp is None and has_room():
        config.add_cleanup(_entered(in_memory()))


def _entered(context: AbstractContextManager[None]) -> Callable[[], object]:
    """Enter a context; give what leaves it."""
    stack = ExitStack()
    stack.enter_context(context)
    return stack.close


class _Examples:
    """Looks for examples in docstrings only where there are some: it imports what it looks at."""

    @pytest.hookimpl(wrapper=True)
    def pytest_collect_file(
        self, file_path: Path
    ) -> Generator[None, list[pytest.Collector], list[pytest.Collector]]:
        collectors = yield
        if any(isinstance(item, DoctestModule) for item in collectors) and (
            _ROOT / "tests" in file_path.parents or b">>>" not in file_path.read_bytes()
        ):
            return [item for item in collectors if not isinstance(item, DoctestModule)]
        return collectors


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Start with the longest modules, and with what other processes can do meanwhile.

    The others need no kernels: they run while the first process compiles those for tests/road.
    What takes longest else comes next, so that in the end no process waits for the other.
    """
    first = [
        # More than an hour of faults and kills, all in one process.
        *([("engine", "test_faults.py")] if IS_LONG else []),
        *(("road", "test_direct.py"), ("cli", "test_running.py")),
        *(("engine", "test_surroundings.py"), ("engine", "test_dask.py")),
    ]
    soon = [
        *(("plane", "test_detectors.py"), ("testing", "test_conformance.py")),
        ("orient", "test_pnp.py"),
    ]

    def turn(item: pytest.Item) -> int:
        module = item.path.parts[-2:]
        if module in first:
            return first.index(module)
        if module[0] == "road":
            return len(first)
        return len(first) + 1 + (soon.index(module) if module in soon else len(soon))

    items.sort(key=turn)
    if not IS_LONG:
        later = pytest.mark.skip(reason=f"{REASONS['long']} --long")
        for item in items:
            if item.get_closest_marker("long"):
                item.add_marker(later)
    if config.getoption("--with-programs") and config.cache is not None:
        lacking = set(config.cache.get(_LACKING, []))
        items[:] = [item for item in items if item.nodeid in lacking]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--strict-skips", action="store_true", help="fail where a test skips for an unlisted reason"
    )
    parser.addoption(
        "--with-programs",
        action="store_true",
        help="run those tests alone that the last run skipped for a program, and let none skip",
    )


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Keep which tests lacked a program, for `--with-programs`."""
    config = terminalreporter.config
    if config.getoption("--with-programs") or getattr(config, "cache", None) is None:
        return
    lacking = [
        report.nodeid
        for report in terminalreporter.stats.get("skipped", [])
        if REASONS["program"] in str(report.longrepr)
    ]
    config.cache.set(_LACKING, lacking)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Turn a skip into a failure where its reason is not on the list of `tests.optional`."""
    report = yield
    if report.skipped and isinstance(report.longrepr, tuple) and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2].removeprefix("Skipped: ")
        is_listed = is_allowed(reason) and not item.config.getoption("--with-programs")
        if item.config.getoption("--strict-skips") and not is_listed:
            report.outcome = "failed"
            report.longrepr = f"skipped for a reason that tests/optional.py does not list: {reason}"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Look for no garbage while tests are loaded: there is hardly any."""
    gc.disable()
    try:
        if session.config.args_source is pytest.Config.ArgsSource.TESTPATHS:
            _load_tests()
        return (yield)
    finally:
        gc.enable()


def _load_tests() -> None:
    """Load test modules from a different one on in each process that tests are spread over.

    All load all of them. Where nothing is compiled yet, each thus finds compiled what the others
    have begun with, instead of compiling the same modules at the same time.
    """
    process = os.environ.get("PYTEST_XDIST_WORKER")
    if process is not None:
        modules = sorted((_ROOT / "tests").rglob("test_*.py"))
        n_processes = int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
        start = int(process.removeprefix("gw")) * len(modules) // n_processes
        for path in modules[start:] + modules[:start]:
            name = ".".join(path.relative_to(_ROOT).with_suffix("").parts)
            with suppress(Exception):  # pytest reports it
                import_module(name)


def pytest_collection_finish() -> None:
    """Set aside what is loaded by now, in each process: it is never garbage."""
    gc.freeze()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real scans and photos beside the checkout, which never ships with it."""
    if not _SHARED.is_dir():
        skip("data", str(_SHARED.name))
    return _SHARED


@pytest.fixture(scope="session")
def new_page() -> Iterator[Callable[[], Page]]:
    """What opens a page in a browser; the one way to Chromium, for any test."""
    from tests.browser import IS_HERE, Page, started

    if not IS_HERE:
        skip("program", "Chromium, and playwright (the extra `browser`)")
    with started() as browser:
        yield lambda: Page(browser)


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    from tests.engine_world import toy_world

    with toy_world(tmp_path) as opened:
        yield opened


@pytest.fixture(scope="session")
def _open3d() -> None:
    """Skip where open3d does not load, with the sentence that a user would get."""
    from orthoflow_plugins.plane.comparators import load_open3d

    from orthoflow.errors import PluginError

    try:
        load_open3d("this test")
    except PluginError as error:
        skip("program", str(error))


@pytest.fixture(scope="session", autouse=True)
def _undrawn_charts() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StepContext, "figure", keep_dot)
        yield


@pytest.fixture
def charts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw charts in this test all the same."""
    monkeypatch.setattr(StepContext, "figure", FIGURE)


@pytest.fixture
def drawings(monkeypatch: pytest.MonkeyPatch) -> dict[str, Drawing]:
    """Keep the charts of this test by their names, undrawn."""
    kept: dict[str, Drawing] = {}

    def figure(_: StepContext, name: str, content: Drawing, caption: str = "") -> None:
        assert caption
        kept[name] = content

    monkeypatch.setattr(StepContext, "figure", figure)
    return kept
