"""Processes of steps as the coordinator sees them: forked from servers that have libraries loaded.

There is one server per number of threads and per set of what libraries read when they are loaded.
Servers outlive a run, so that the next one in the same process finds them warm; they end with this
process, or when nobody has asked for a minute.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Final

from orthoflow.engine.environment import python_path
from orthoflow.engine.fork_server import NO_PROCESS, NUMBER, StepRequest
from orthoflow.engine.kernels import VARIABLE, kernel_folder, private_folder
from orthoflow.engine.tasks import Task
from orthoflow.errors import StepFailedError
from orthoflow.system import resource

_THREAD_VARIABLES: Final = (
    "BLIS_NUM_THREADS",
    "GDAL_NUM_THREADS",
    "GOTO_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
    "RAYON_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
# A server serves steps alone that agree in these: libraries read them when they are loaded.
_READ_AT_LOADING: Final = (
    "BLIS_",
    "GDAL_",
    "GOTO_",
    "HDF5_",
    "KMP_",
    "LD_",
    "MALLOC_",
    "MKL_",
    "MPL",
    "NPY_",
    "NUMBA_",
    "NUMEXPR_",
    "OMP_",
    "OPENBLAS_",
    "OPENCV_",
    "PROJ_",
    "PYTHON",
    "RAYON_",
    "VECLIB_",
)
# OpenCV puts it before LD_LIBRARY_PATH once it is loaded, for processes that it starts itself.
_OF_OPENCV: Final = "/cv2/../../lib64"
# These differ from store to store and are told to each step.
_READ_LATER: Final = (VARIABLE, "MPLCONFIGDIR", "PYTHONPATH")
# Threads of OpenBLAS, of which numpy and scipy bring a set each, spin for 2**26 turns of the clock
# when they begin and after each product: some 0.05 s of processor time. 2**20 are less than 1 ms.
_SLEEPS_SOON: Final = {"OPENBLAS_THREAD_TIMEOUT": "20"}
_START_S: Final = 120.0
_SILENT_S: Final = 30.0
_LIMITS: Final = tuple(
    getattr(resource, name) for name in dir(resource) if name.startswith("RLIMIT_")
)


class StepProcess:
    """The keeper of a step, which ends as the step has ended.

    Attributes:
        pid: its process id; signals may be sent until `close`.
        returncode: as `subprocess` has it, None as long as it runs.
    """

    def __init__(self, reports: socket.socket, pid: int) -> None:
        """Take what a server has forked."""
        self._reports = reports
        self.pid = pid
        self.returncode: int | None = None
        self._silent_since: float | None = None
        # Its number is its own until `close`, whether it lives or not.
        self._process: int | None = None
        with contextlib.suppress(OSError):
            self._process = os.pidfd_open(pid)

    @property
    def descriptor(self) -> int:
        """Becomes readable when it ends."""
        return self._reports.fileno()

    def has_ended(self) -> bool:
        """Whether it has ended."""
        return self.wait(0)

    def wait(self, timeout_s: float) -> bool:
        """Wait for its end; False when it goes on."""
        if self.returncode is None and _is_readable(self._reports, timeout_s):
            code = _hear(self._reports)
            # When the server is killed, it takes its keepers with it.
            self.returncode = -signal.SIGKILL if code is None else code
        elif self._process is not None and _is_readable(self._process, 0):
            self._wait_for_word()
        return self.returncode is not None

    def _wait_for_word(self) -> None:
        """Give up a server that stands still, and does not tell how the keeper has ended."""
        self._silent_since = self._silent_since or time.monotonic()
        if self.returncode is None and time.monotonic() - self._silent_since > _SILENT_S:
            self.returncode = -signal.SIGKILL

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal to the keeper alone."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, number)

    def signal_group(self, number: signal.Signals) -> None:
        """Send a signal to the keeper and to all that did not leave its group."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, number)

    def close(self) -> None:
        """Let the server reap it: its number may belong to others from now on."""
        self._reports.close()
        if self._process is not None:
            os.close(self._process)


def start_step(task: Task, pipe: int, log: int) -> StepProcess:
    """Start the process of a task.

    Args:
        task: its file is written, its scratch folder exists.
        pipe: descriptor for what the step says.
        log: descriptor for what it prints.

    Raises:
        StepFailedError: this machine gives no process more.
    """
    variables = _variables(task)
    request = StepRequest(
        task_file=str(task.task_file),
        folder=str(task.scratch),
        variables=variables,
        paths=python_path().split(os.pathsep),
        limits={limit: resource.getrlimit(limit) for limit in _LIMITS},
        is_compared=task.is_compared,
    )
    # Its length is bounded by no socket's buffer.
    with os.fdopen(os.memfd_create("request"), "wb") as stream:
        stream.write(json.dumps(asdict(request)).encode())
        stream.flush()
        # A server that was idle too long, or was killed, is found out by its silence.
        for _ in range(2):
            stream.seek(0)
            server = _servers.get(variables, log)
            try:
                process = server.fork(stream.fileno(), pipe, log)
            except ChildProcessError:
                # Not its fault; and other steps would die with it.
                break
            if process is not None:
                return process
            _servers.forget(server)
    raise StepFailedError(
        f"no process could be started for {task.who}: the machine has too little memory or allows "
        f"too few processes"
    )


@dataclass(frozen=True)
class _Server:
    """A fork server of this process."""

    process: subprocess.Popen[bytes]
    control: socket.socket

    def fork(self, request: int, pipe: int, log: int) -> StepProcess | None:
        """Ask for a step; None when there is no answer.

        Raises:
            ChildProcessError: the server lives, but got no process for it.
        """
        reports, given = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with given:
            try:
                socket.send_fds(self.control, [b"s"], [request, given.fileno(), pipe, log])
            except OSError:
                reports.close()
                return None
        pid = _hear(reports) if _is_readable(reports, _START_S) else None
        if pid is not None and pid != NO_PROCESS:
            return StepProcess(reports, pid)
        reports.close()
        if pid == NO_PROCESS:
            raise ChildProcessError
        return None

    def close(self) -> None:
        """Kill it, and with it the steps that it has forked."""
        self.control.close()
        self.process.kill()
        self.process.wait()


class _Servers:
    """The fork servers of this process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._owner = os.getpid()
        self._of: dict[object, _Server] = {}
        atexit.register(self._close)

    def get(self, variables: Mapping[str, str], log: int) -> _Server:
        """Give the server for steps with such an environment; a new one may print into a log."""
        key = _read_at_loading(variables), os.getresuid(), frozenset(os.sched_getaffinity(0))
        with self._lock:
            if self._owner != os.getpid():
                # After a fork: they serve the process that started them.
                self._of, self._owner = {}, os.getpid()
            self._drop([old for old in self._of.values() if old.process.poll() is not None])
            if key not in self._of:
                self._of[key] = _start_server(variables, log)
            return self._of[key]

    def forget(self, server: _Server) -> None:
        """Close one that does not answer."""
        with self._lock:
            self._drop([server])

    def _drop(self, servers: list[_Server]) -> None:
        for server in servers:
            server.close()
        self._of = {key: server for key, server in self._of.items() if server not in servers}

    def _close(self) -> None:
        if self._owner == os.getpid():
            for server in self._of.values():
                server.close()
            self._of.clear()


_servers: Final = _Servers()


def _start_server(variables: Mapping[str, str], log: int) -> _Server:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    arguments = [sys.executable, "-P", "-m", "orthoflow.engine.fork_server"]
    with theirs:
        process = subprocess.Popen(
            [*arguments, str(theirs.fileno()), str(os.getpid())],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=dict(variables),
            pass_fds=(theirs.fileno(),),
            start_new_session=True,
        )
    return _Server(process, ours)


def _variables(task: Task) -> dict[str, str]:
    """Environment variables for the process of a task."""
    variables = _SLEEPS_SOON | _without_opencv(os.environ)
    # A setting of somebody who debugs kernels; for that there is --executor inline.
    variables.pop("NUMBA_DISABLE_JIT", None)
    variables |= dict.fromkeys(_THREAD_VARIABLES, str(task.cores))
    return variables | {
        "PYTHONPATH": python_path(),
        "PYTHONHASHSEED": "0",
        "PYTHONUNBUFFERED": "1",
        VARIABLE: str(kernel_folder(task.kernels)),
        "MPLBACKEND": "Agg",
        "MPLCONFIGDIR": str(private_folder("matplotlib")),
        "TMPDIR": str(task.scratch),
    }


def _without_opencv(variables: Mapping[str, str]) -> dict[str, str]:
    """Leave out what loading OpenCV here has changed: the next run needs no other server for it."""
    kept = dict(variables)
    folders = kept.pop("LD_LIBRARY_PATH", "").split(os.pathsep)
    folders = [folder for folder in folders if not folder.endswith(_OF_OPENCV)]
    if any(folders):
        kept["LD_LIBRARY_PATH"] = os.pathsep.join(folders)
    return kept


def _read_at_loading(variables: Mapping[str, str]) -> frozenset[tuple[str, str]]:
    return frozenset(
        (name, value)
        for name, value in variables.items()
        if name.startswith(_READ_AT_LOADING) and name not in _READ_LATER
    )


def _is_readable(source: socket.socket | int, timeout_s: float) -> bool:
    waiting = select.poll()
    waiting.register(source, select.POLLIN)
    return bool(waiting.poll(round(timeout_s * 1000)))


def _hear(reports: socket.socket) -> int | None:
    """Read a number; None when there is nobody to tell it any more."""
    try:
        message = reports.recv(NUMBER.size)
    except OSError:
        return None
    return int(NUMBER.unpack(message)[0]) if len(message) == NUMBER.size else None
