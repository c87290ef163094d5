"""Steps are forked from servers that have libraries loaded, one per process that runs workflows."""

from __future__ import annotations

import itertools
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from orthoflow.engine.fork_server import load_library
from tests.engine_world import World, has_ended, start_coordinator

STEPS = "steps:\n  first: {use: make.range}\n"
AROUND = STEPS + "  second: {use: work.around, in: {numbers: first.numbers}}\n"
COMPARED = (
    STEPS
    + """
  second:
    in: {numbers: first.numbers}
    variants:
      one: {use: work.around, params: {steps: 1}}
      two: {use: work.around, params: {steps: 2}}
compare: {design: product}
"""
)
SLOW = STEPS + ("  second: {use: work.slow, in: {numbers: first.numbers}, params: {steps: 2000}}\n")


@dataclass(frozen=True)
class Around:
    """What a step has found around it."""

    pid: int
    keeper: int
    session: int
    has_library: bool
    number: int
    file_limit: int
    cores: int
    spins_log2: int


_numbers = itertools.count()


def around(world: World) -> Around:
    """Run a step anew that looks around itself."""
    outcome = world.run(AROUND, sets=[f"second.steps={next(_numbers)}"])
    assert outcome.results["second"].error_message == ""
    return Around(*(int(value) for value in world.values(outcome, "second")))


def servers() -> list[int]:
    """Fork servers that this process has started and that live."""
    me, found = str(os.getpid()), []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            arguments = path.read_bytes().split(b"\0")
            parent = (path.parent / "stat").read_text().rpartition(")")[2].split()[1]
        except OSError:
            continue
        if b"orthoflow.engine.fork_server" in arguments and parent == me:
            found.append(int(path.parent.name))
    return found


def test_the_next_run_finds_the_server_and_libraries_that_steps_loaded(world: World) -> None:
    first = around(world)
    before = servers()
    second = around(world)
    assert servers() == before
    assert second.pid != first.pid
    # A step is alone in its session with what it starts, and its keeper leads that.
    assert second.session == second.keeper != os.getsid(0)
    for _ in range(100):
        if around(world).has_library:
            break
    else:
        pytest.fail("no step ever found the library that those before it had loaded")


def test_what_compared_steps_loaded_is_loaded_before_the_next_one_not_beside_it(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Of no other test: a server of its own, which has loaded nothing.
    monkeypatch.setenv("OPENBLAS_LOOP", "1")
    outcome = world.run(COMPARED)
    loaded = [world.values(outcome, f"second@second={name}")[3] for name in ("one", "two")]
    assert loaded == [0.0, 1.0]


def test_numba_is_ready_where_steps_are_forked_from_and_its_extensions_are_left_to_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from numba.core import entrypoints
    from numba.core.registry import cpu_target

    asked, entry_points = [], entrypoints.importlib_metadata.entry_points
    monkeypatch.setattr(
        entrypoints.importlib_metadata, "entry_points", lambda: asked.append(1) or entry_points()
    )
    load_library("numba")
    assert "numba.np.arraymath" in sys.modules
    assert not asked
    # As the first kernel of a step does.
    cpu_target.target_context.refresh()
    assert asked == [1]


@pytest.mark.parametrize("turns", ["20", "26"], ids=["by default", "as somebody wants it"])
def test_the_threads_of_algebra_spin_hardly_or_as_long_as_is_said(
    world: World, monkeypatch: pytest.MonkeyPatch, turns: str
) -> None:
    monkeypatch.delenv("OPENBLAS_THREAD_TIMEOUT", raising=False)
    if turns != "20":
        monkeypatch.setenv("OPENBLAS_THREAD_TIMEOUT", turns)
    assert around(world).spins_log2 == int(turns)


def test_steps_have_what_the_coordinator_has_when_they_start(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    around(world)
    monkeypatch.setenv("TOY_NUMBER", "12")
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (500, before[1]))
    try:
        found = around(world)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert (found.number, found.file_limit) == (12, 500)
    monkeypatch.delenv("TOY_NUMBER")
    assert around(world).number == -1


def test_what_libraries_read_when_they_are_loaded_takes_a_server_of_its_own(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    around(world)
    before = servers()
    # Machines may have set one already: another one than that.
    other = "Nehalem" if os.environ.get("OPENBLAS_CORETYPE") == "Haswell" else "Haswell"
    monkeypatch.setenv("OPENBLAS_CORETYPE", other)
    around(world)
    assert len(servers()) == len(before) + 1


@pytest.mark.parametrize("folders", [None, "/opt/a:/opt/b"])
def test_opencv_loaded_here_takes_no_server_of_its_own(
    world: World, monkeypatch: pytest.MonkeyPatch, folders: str | None
) -> None:
    monkeypatch.delenv("LD_LIBRARY_PATH", raising=False)
    if folders:
        monkeypatch.setenv("LD_LIBRARY_PATH", folders)
    around(world)
    before = servers()
    told = subprocess.run(
        [sys.executable, "-c", "import cv2, os; print(os.environ['LD_LIBRARY_PATH'])"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    assert told != folders
    monkeypatch.setenv("LD_LIBRARY_PATH", told)
    around(world)
    assert servers() == before


def test_a_killed_server_is_replaced(world: World) -> None:
    around(world)
    for server in servers():
        os.kill(server, signal.SIGKILL)
        has_ended(server)
    around(world)
    assert servers()


def test_a_copy_of_the_process_has_servers_of_its_own(world: World) -> None:
    around(world)
    ours = servers()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            around(world)
            status = 0 if servers() and not set(servers()) & set(ours) else 2
        finally:
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert servers() == ours
    around(world)


def test_a_server_dies_with_the_process_that_started_it(world: World) -> None:
    process = start_coordinator(world, SLOW, "run")
    of_process = f"/proc/{process.pid}/task/{process.pid}/children"
    deadline = time.monotonic() + 60
    while not (children := Path(of_process).read_text().split()):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.kill()
    process.communicate()
    assert all(has_ended(int(child)) for child in children)


def test_a_server_without_the_process_that_started_it_ends_at_once() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        done = subprocess.run(
            [sys.executable, "-m", "orthoflow.engine.fork_server", str(theirs.fileno()), "1"],
            pass_fds=(theirs.fileno(),),
            capture_output=True,
            check=False,
            timeout=60,
        )
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


def test_a_step_that_gets_no_process_fails_alone(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("orthoflow.engine.step_processes.sys.executable", "/bin/false")
    monkeypatch.setenv("OMP_TEST", "another server")
    outcome = world.run(STEPS)
    assert outcome.results["first"].error_message == (
        "no process could be started for method make.range of toy-plugin 1.0: the machine has too "
        "little memory or allows too few processes"
    )


def test_an_environment_may_be_larger_than_a_socket_takes(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(10):
        monkeypatch.setenv(f"TOY_FILLER_{number}", "x" * 100_000)
    monkeypatch.setenv("TOY_NUMBER", "31")
    assert around(world).number == 31


def test_a_fork_that_fails_costs_no_other_step(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    around(world)
    before = servers()

    def refuse(server: object, request: int, pipe: int, log: int) -> None:
        raise ChildProcessError

    with monkeypatch.context() as patch:
        patch.setattr("orthoflow.engine.step_processes._Server.fork", refuse)
        outcome = world.run(AROUND, sets=[f"second.steps={next(_numbers)}"])
    assert outcome.results["second"].error_message.startswith("no process could be started for")
    assert servers() == before
