"""Commands of the command line as processes, forked from one that has loaded it.

    python tests/forked_commands.py

Loading takes most of the time of many a command. Reads orders from stdin, a JSON object per line:
`arguments`, `folder`, `environment`, `streams`, two files for what is written to stdout and stderr,
and `forgone`, numbers of rights of root that it gives up; answers each with the exit code. A
command has its import path, its surroundings and its end as `python -m orthoflow` has them; only
what the interpreter reads from the environment when it starts is as it was when the first command
was asked for.
"""

from __future__ import annotations

import atexit
import ctypes
import json
import os
import select
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, Final

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
        server = _server(environment.get("PYTHONPATH", ""))
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


@cache
def _server(python_path: str) -> subprocess.Popen[str]:
    server = subprocess.Popen(
        [sys.executable, __file__],
        env={**os.environ, "PYTHONPATH": python_path},
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
    import orthoflow.records
    import orthoflow.workflow

    for line in sys.stdin:
        process = os.fork()
        if process == 0:
            _become(json.loads(line))
            # It ends through the interpreter, as any command does.
            orthoflow.cli.main()
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        sys.stdout.write(f"{code}\n")
        sys.stdout.flush()


# Any: an order is JSON that this module wrote itself.
def _become(order: dict[str, Any]) -> None:
    nothing = os.open(os.devnull, os.O_RDONLY)
    out, err = (os.open(path, os.O_WRONLY | os.O_CREAT) for path in order["streams"])
    for descriptor, replaced in ((nothing, 0), (out, 1), (err, 2)):
        os.dup2(descriptor, replaced)
        os.close(descriptor)
    if order["forgone"]:
        _forgo(order["forgone"])
    os.environ.clear()
    os.environ.update(order["environment"])
    os.chdir(order["folder"])
    sys.path[0] = str(Path.cwd())
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
