"""Commands of the command line as processes, forked from one that has loaded it.

    python tests/forked_commands.py [libraries]

Loading takes most of the time of many a command; with `libraries`, all that the built-in methods
need is loaded as well. Reads orders from stdin, a JSON object per line:
`arguments`, `folder`, `environment`, `streams`, two files for what is written to stdout and stderr,
and `forgone`, numbers of rights of root that it gives up; answers each with the exit code.
A command has its import path, its surroundings and its end as `python -m orthoflow` has them, but
draws no charts; only what the interpreter, and the libraries that steps need if they are loaded,
read from the environment is as it was when the first command was asked for. The server that steps
are forked from serves all commands, unless they gave up rights.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import json
import os
import select
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from multiprocessing import forkserver
from multiprocessing.forkserver import ForkServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, Final

_TESTS: Final = str(Path(__file__).resolve().parents[1])
# What most runs or exports load after they have begun; networkx alone takes 0.3 s of each run.
_LOADED_LATE: Final = (
    *("orthoflow.engine.plan", "orthoflow.engine.scheduler", "orthoflow.records.archive"),
    *(
        "orthoflow.files.drawings.sheets",
        "orthoflow.files.drawings.dxf",
        "laspy",
        "matplotlib.style",
    ),
    *("networkx", "ezdxf", "reportlab.pdfgen.canvas", "pyproj", "prov.model"),
)
_PR_CAPBSET_DROP: Final = 24
_CAPABILITY_VERSION_3: Final = 0x20080522


def run_command(
    folder: Path,
    arguments: Sequence[object],
    environment: Mapping[str, str],
    timeout_s: float = 300,
    *,
    forgone: Sequence[int] = (),
) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder, without some of the rights of root, and wait for its end.

    Its steps keep a dot in the place of each chart.

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
        }
        # Without rights of root, also the libraries are loaded as that user loads them.
        server = _server(_framework_path(environment.get("PYTHONPATH", "")), loads=not forgone)
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
def _server(python_path: str, *, loads: bool) -> subprocess.Popen[str]:
    from tests.kept_memory import KEPT_MEMORY  # who is started has no `tests`

    server = subprocess.Popen(
        [sys.executable, __file__, *(["libraries"] if loads else [])],
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
    import orthoflow.records.compare
    import orthoflow.records.verify
    import orthoflow.records.write
    import orthoflow.workflow.document
    import orthoflow.workflow.views
    from orthoflow.engine.environment import cpu_name, git_commit
    from orthoflow.report.rendering import environment

    if sys.argv[1:]:
        import pkgutil
        from importlib import import_module

        import orthoflow_plugins

        import orthoflow.engine.preload

        for package in (orthoflow_plugins, orthoflow.cli):
            for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
                import_module(module.name)
        for name in _LOADED_LATE:
            import_module(name)

    cpu_name()
    git_commit()
    for name in environment().list_templates(["j2"]):
        environment().get_template(name)
    server = None
    for line in sys.stdin:
        order = json.loads(line)
        if _forks_steps(order) and server is None:
            server = _step_server()
        gc.freeze()
        process = os.fork()
        if process == 0:
            _become(order, server)
            # It ends through the interpreter, as any command does.
            orthoflow.cli.main()
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        sys.stdout.write(f"{code}\n")
        sys.stdout.flush()


# Any: an order is JSON that this module wrote itself.
def _forks_steps(order: dict[str, Any]) -> bool:
    """Whether the steps of a command are processes; it takes two seconds to load what they need."""
    words = order["arguments"]
    is_here = order["forgone"] or "inline" in " ".join(words)
    return words[0] in ("run", "replay") and not is_here


def _step_server() -> ForkServer:
    """A server of steps, which keep dots in the place of charts."""
    from orthoflow.engine.local import PRELOADED

    server, path = ForkServer(), os.environ["PYTHONPATH"]
    server.set_forkserver_preload([*PRELOADED, "tests.keep_dots"])
    os.environ.update(PYTHONSAFEPATH="1", PYTHONPATH=os.pathsep.join((path, _TESTS)))
    server.ensure_running()
    os.environ["PYTHONPATH"] = path
    return server


def _share(server: ForkServer) -> None:
    """Let this command use a server that its parent has started."""
    server.ensure_running = lambda: None  # type: ignore[method-assign]
    forkserver.set_forkserver_preload = lambda modules_names: None
    forkserver.ensure_running = server.ensure_running
    forkserver.connect_to_new_process = server.connect_to_new_process


def _become(order: dict[str, Any], server: ForkServer | None) -> None:
    nothing = os.open(os.devnull, os.O_RDONLY)
    out, err = (os.open(path, os.O_WRONLY | os.O_CREAT) for path in order["streams"])
    for descriptor, replaced in ((nothing, 0), (out, 1), (err, 2)):
        os.dup2(descriptor, replaced)
        os.close(descriptor)
    if order["forgone"]:
        _forgo(order["forgone"])
    elif server is not None:
        _share(server)
    sys.path[0] = _TESTS
    import tests.keep_dots  # noqa: F401

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
    _serve()
