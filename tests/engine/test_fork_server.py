"""What the server of steps does between steps: it learns, loads, and ends with who asks."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from orthoflow.engine import fork_server
from orthoflow.engine.step_processes import StepProcess

LIBRARIES = ("lib_a", "lib_b", "json")


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[fork_server._Server, socket.socket]]:
    """A server, and the end of the line that a coordinator holds."""
    monkeypatch.setattr(fork_server, "_LIBRARIES", LIBRARIES)
    monkeypatch.setattr(fork_server, "_IDLE_S", 0.01)
    with ExitStack() as stack:
        theirs, ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        reading, writing = os.pipe()
        stack.callback(os.close, reading)
        stack.callback(os.close, writing)
        for end in (theirs, ours):
            stack.callback(end.close)
        server = fork_server._Server(control=ours, coordinator=reading)
        for learnt in server.learnt:
            stack.callback(learnt.close)
        stack.callback(server.selector.close)
        yield server, theirs


def test_a_server_learns_libraries_that_it_knows_and_has_not(
    ends: tuple[fork_server._Server, socket.socket],
) -> None:
    server, _ = ends
    server._learn()
    assert server.wanted == []
    # One is loaded already, and one is none that a server loads.
    server.learnt[1].send(b"lib_a json lib_x")
    server._learn()
    assert server.wanted == ["lib_a"]
    server.learnt[1].send(b"lib_a lib_b")
    server._learn()
    assert server.wanted == ["lib_a", "lib_b"]


def test_an_idle_server_loads_what_it_wants_and_then_ends(
    ends: tuple[fork_server._Server, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    server, _ = ends
    loaded: list[str] = []
    monkeypatch.setattr(fork_server, "load_library", loaded.append)
    server.learnt[1].send(b"lib_b")
    server.wanted = ["lib_a"]
    server.serve()
    assert sorted(loaded) == ["lib_a", "lib_b"]
    assert server.wanted == []


def test_a_server_ends_where_nobody_can_ask_any_more(
    ends: tuple[fork_server._Server, socket.socket],
) -> None:
    server, theirs = ends
    server.wanted = []
    theirs.close()
    assert server._fork() is False
    server.serve()


def test_a_step_has_ended_when_its_server_says_so_or_is_gone() -> None:
    for said, code in ((3, 3), (-11, -11), (None, -9)):
        reports, given = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with given:
            step = StepProcess(reports, os.getpid())
            assert step.has_ended() is False
            assert (step.wait(0.001), step.returncode) == (False, None)
            if said is not None:
                given.send(fork_server.NUMBER.pack(said))
        assert step.has_ended() is True
        assert step.returncode == code
        # It has ended, whatever else is heard.
        assert step.wait(0.0) is True
        step.close()
