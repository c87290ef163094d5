"""Commands of the command line as processes, forked from one that has loaded it.

    python tests/forked_commands.py

Loading takes most of the time of many a command. Reads orders from stdin, a JSON object per line:
`arguments`, `folder`, `environment`, `streams`, two files for what is written to stdout and stderr,
`forgone`, numbers of rights of root that it gives up, and `draws`; answers each with the exit code.
With `steps`, two numbers behind it, it serves steps as `orthoflow.engine.fork_server` does, but for
their charts.
A command has its import path, its surroundings and its end as `python -m orthoflow` has them; only
what the interpreter reads from the environment when it starts is as it was when the first command
was asked for. Libraries that a command has loaded are loaded here before the next one, and the
servers that steps are forked from serve all commands, unless they gave up rights.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import json
import os
import select
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, Final

_LARGEST: Final = 4096
# What a command asks its parent for: a server of steps that draw their charts, or not.
_DRAWN: Final = b"drawn"
_UNDRAWN: Final = b"undrawn"
_PR_CAPBSET_DROP: Final = 24
_CAPABILITY_VERSION_3: Final = 0x20080522


def run_command(
    folder: Path,
    arguments: Sequence[object],
    environment: Mapping[str, str],
    timeout_s: float = 300,
    *,
    forgone: Sequence[int] = (),
    draws: bool = True,
) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder, without some of the rights of root, and wait for its end.

    Where it does not draw, its steps keep a dot in the place of each chart.

    Raises:
        TimeoutExpired: it has not ended; it is killed with the process that it came from.
    """
    words = [*map(str, arguments)]
    with TemporaryDirectory(prefix="orthoflow-command-") as said:
        streams = [Path(said) / "stdout", Path(said) / "stderr"]
        order = {
            "arguments": words,
            "folder": str(folder),
            "environment": dict(environment),
            "streams": [*map(str, streams)],
            "forgone": [*forgone],
            "draws": draws,
        }
        server = _server(_framework_path(environment.get("PYTHONPATH", "")))
        assert server.stdin is not None
        assert server.stdout is not None
        server.stdin.write(json.dumps(order) + "\n")
        server.stdin.flush()
        if not select.select([server.stdout], [], [], timeout_s)[0]:
            _server.cache_clear()
            server.kill()
            raise subprocess.TimeoutExpired(words, timeout_s)
        code = int(server.stdout.readline())
        out, err = (path.read_text() for path in streams)
    return subprocess.CompletedProcess(words, code, out, err)


def _framework_path(python_path: str) -> str:
    """The folders of an import path that the framework comes from."""
    names = ("orthoflow", "orthoflow_plugins", "orthoflow_provenance")
    parts = python_path.split(os.pathsep)
    return os.pathsep.join(p for p in parts if any(Path(p, name).is_dir() for name in names))


@cache
def _server(python_path: str) -> subprocess.Popen[str]:
    from tests.kept_memory import KEPT_MEMORY  # who is started has no `tests`

    server = subprocess.Popen(
        [sys.executable, __file__],
        env={**os.environ, **KEPT_MEMORY, "PYTHONPATH": python_path},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    atexit.register(_close, server)
    return server


def _close(server: subprocess.Popen[str]) -> None:
    server.kill()
    server.communicate()


def _serve() -> None:
    import orthoflow.cli
    import orthoflow.records.comparison
    import orthoflow.records.distances
    import orthoflow.records.verification
    import orthoflow.records.writing
    import orthoflow.workflow.document
    import orthoflow.workflow.views
    from orthoflow.engine.environment import cpu_name, git_commit
    from orthoflow.report.pages import environment

    cpu_name()
    git_commit()
    for name in environment().list_templates(["j2"]):
        environment().get_template(name)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    servers = _StepServers(ours)
    for line in sys.stdin:
        gc.freeze()
        process = os.fork()
        if process == 0:
            ours.close()
            _become(json.loads(line), theirs)
            # It ends through the interpreter, as any command does.
            orthoflow.cli.main()
        code = servers.serve_until_end(process)
        sys.stdout.write(f"{code}\n")
        sys.stdout.flush()
        servers.load()


@dataclass
class _StepServers:
    """The servers of steps that commands ask for.

    Attributes:
        asked: where commands ask.
        wanted: libraries that commands have loaded.
    """

    asked: socket.socket
    wanted: list[str] = field(default_factory=list)
    _servers: dict[object, Any] = field(default_factory=dict)

    def serve_until_end(self, command: int) -> int:
        """Give a command what it asks for; its exit code."""
        end = os.pidfd_open(command)
        while True:
            ready = select.select([end, self.asked], [], [])[0]
            if self.asked in ready:
                self._answer()
            elif ready:
                os.close(end)
                return os.waitstatus_to_exitcode(os.waitpid(command, 0)[1])

    def load(self) -> None:
        """Load what commands have loaded, for those that follow."""
        from orthoflow.engine.fork_server import load_library

        for name in self.wanted:
            load_library(name)
        self.wanted.clear()

    def _answer(self) -> None:
        from orthoflow.engine import step_processes

        message, descriptors, _, _ = socket.recv_fds(self.asked, _LARGEST, 1)
        if not descriptors:
            self.wanted += [name for name in json.loads(message) if name not in sys.modules]
            return
        with os.fdopen(descriptors[0], "rb") as file:
            variables = json.load(file)
        start = step_processes._start_server if message == _DRAWN else _start_undrawn
        key = (message, step_processes._read_at_loading(variables))
        server = self._servers.get(key)
        if server is None or server.process.poll() is not None:
            log = os.open(os.devnull, os.O_WRONLY)
            server = self._servers[key] = start(variables, log)
            os.close(log)
        pid = str(server.process.pid).encode()
        socket.send_fds(self.asked, [pid], [server.control.fileno()])


def _start_undrawn(variables: Mapping[str, str], log: int) -> Any:
    """Start a server of steps that keep dots in the place of charts."""
    from orthoflow.engine import step_processes

    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        process = subprocess.Popen(
            [sys.executable, __file__, "steps", str(theirs.fileno()), str(os.getpid())],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=dict(variables),
            pass_fds=(theirs.fileno(),),
            start_new_session=True,
        )
    return step_processes._Server(process, ours)


def _serve_steps(arguments: list[str]) -> None:
    _draw_nothing()
    del sys.path[0]  # as with `python -P`

    from orthoflow.engine import fork_server

    fork_server.main(arguments)


def _draw_nothing() -> None:
    sys.path[0] = str(Path(__file__).resolve().parents[1])
    from tests.undrawn_charts import keep_dots_for_charts

    keep_dots_for_charts()


@dataclass(frozen=True)
class _Elsewhere:
    """The process of a server that others use, too, as `step_processes` sees its own."""

    pid: int

    def poll(self) -> int | None:
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return 0
        return None

    def kill(self) -> None:
        """Leave it to others."""

    def wait(self) -> int:
        return 0


def _share_servers(parent: socket.socket, asks: bytes) -> None:
    """Let this command ask its parent for servers of steps, and tell it at its end what it has."""
    from orthoflow.engine import fork_server, step_processes

    def ask(variables: Mapping[str, str], _: int) -> Any:
        with os.fdopen(os.memfd_create("variables"), "w+") as file:
            json.dump(dict(variables), file)
            file.seek(0)
            socket.send_fds(parent, [asks], [file.fileno()])
        pid, descriptors, _, _ = socket.recv_fds(parent, _LARGEST, 1)
        control = socket.socket(fileno=descriptors[0])
        return step_processes._Server(_Elsewhere(int(pid)), control)  # type: ignore[arg-type]

    def tell() -> None:
        if os.getpid() == command:
            names = [name for name in fork_server._LIBRARIES if name in sys.modules]
            parent.send(json.dumps(names).encode())

    command = os.getpid()
    atexit.register(tell)
    step_processes._start_server = ask


# Any: an order is JSON that this module wrote itself.
def _become(order: dict[str, Any], parent: socket.socket) -> None:
    nothing = os.open(os.devnull, os.O_RDONLY)
    out, err = (os.open(path, os.O_WRONLY | os.O_CREAT) for path in order["streams"])
    for descriptor, replaced in ((nothing, 0), (out, 1), (err, 2)):
        os.dup2(descriptor, replaced)
        os.close(descriptor)
    if order["forgone"]:
        _forgo(order["forgone"])
    else:
        _share_servers(parent, _DRAWN if order["draws"] else _UNDRAWN)
    if not order["draws"]:
        _draw_nothing()
    framework = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    os.environ.clear()
    os.environ.update(order["environment"])
    os.chdir(order["folder"])
    given = filter(None, order["environment"].get("PYTHONPATH", "").split(os.pathsep))
    sys.path[:] = [str(Path.cwd()), *given, *sys.path[1 + len([*framework]) :]]
    sys.path_importer_cache.clear()
    sys.argv[:] = ["orthoflow", *order["arguments"]]


class _Process(ctypes.Structure):
    _fields_: ClassVar = [("version", ctypes.c_uint32), ("process", ctypes.c_int)]


class _Rights(ctypes.Structure):
    _fields_: ClassVar = [(name, ctypes.c_uint32) for name in ("used", "allowed", "inherited")]


def _forgo(rights: Sequence[int]) -> None:
    """Give up rights of root (capabilities below 32) here and in all that this process starts."""
    libc = ctypes.CDLL(None, use_errno=True)
    for right in rights:
        libc.prctl(_PR_CAPBSET_DROP, right, 0, 0, 0)
    who, held = _Process(_CAPABILITY_VERSION_3, 0), (_Rights * 2)()
    assert libc.capget(ctypes.byref(who), held) == 0
    left = ~sum(1 << right for right in rights)
    held[0].used &= left
    held[0].allowed &= left
    assert libc.capset(ctypes.byref(who), held) == 0


if __name__ == "__main__":
    if sys.argv[1:]:
        _serve_steps(sys.argv[2:])
    else:
        _serve()
