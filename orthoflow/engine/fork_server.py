"""The process that steps are forked from: libraries are loaded here once, not in every step.

`python -m orthoflow.engine.fork_server SOCKET COORDINATOR`. What every step needs is loaded by the
imports below. A step tells at its end which other libraries it has loaded; whenever nothing else is
asked for, they are loaded here too, for the steps after it; before a step whose times are compared,
and not beside it. Never a plugin: no code of a stranger
runs in the process that others come from. What begins threads when it is loaded is left to the
steps.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import selectors
import signal
import socket
import struct
import sys
import traceback
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

from orthoflow.engine.child import run_step
from orthoflow.engine.keeper import fork_kept
from orthoflow.engine.kernels import reload_numba_config
from orthoflow.system import address_space, resource

# One per message: pid of the keeper, then its end as `os.waitstatus_to_exitcode` has it.
NUMBER: Final = struct.Struct("=i")
# In the place of a pid, where the machine gave no process.
NO_PROCESS: Final = -1
# Of a request: its text, its socket, the pipe for what the step says, its log.
_N_DESCRIPTORS: Final = 4
_LARGEST_LIST: Final = 4096
_IDLE_S: Final = 60.0
_LIBRARIES: Final = (
    "cv2",
    "laspy",
    "matplotlib.backends.backend_agg",
    "matplotlib.figure",
    "networkx",
    "numba",
    "orthoflow.files.publishing",
    "orthoflow_provenance.arrays",
    "pandas",
    "PIL.GifImagePlugin",
    "PIL.Image",
    "PIL.JpegImagePlugin",
    "pye57",
    "rasterio",
    "ruamel.yaml",
    "scipy.interpolate",
    "scipy.linalg",
    "scipy.ndimage",
    "scipy.optimize",
    "scipy.signal",
    "scipy.sparse",
    "scipy.spatial",
    "scipy.stats",
)


@dataclass(frozen=True, kw_only=True)
class StepRequest:
    """What the coordinator asks for, as JSON.

    Attributes:
        task_file: of the task.
        folder: working directory.
        variables: all environment variables.
        paths: where modules are looked for.
        limits: resource -> soft and hard limit, as `resource.getrlimit` has them.
        is_compared: whether the times of the step stand beside those of others.
    """

    task_file: str
    folder: str
    variables: dict[str, str]
    paths: list[str]
    limits: dict[int, tuple[int, int]]
    is_compared: bool


def _messages() -> tuple[socket.socket, socket.socket]:
    """Give both ends of a way for messages that waits for nobody."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    for end in ends:
        end.settimeout(0)
    return ends


@dataclass
class _Server:
    """Forks steps for one coordinator, one after the other.

    Attributes:
        control: where requests come from.
        coordinator: descriptor of its process.
        learnt: steps tell names of libraries here.
        selector: over all of these and the keepers.
        keepers: process id -> socket of its task.
        wanted: libraries that steps have loaded and that are not here yet.
    """

    control: socket.socket
    coordinator: int
    learnt: tuple[socket.socket, socket.socket] = field(default_factory=_messages)
    selector: selectors.BaseSelector = field(default_factory=selectors.DefaultSelector)
    keepers: dict[int, socket.socket] = field(default_factory=dict)
    wanted: list[str] = field(default_factory=list)

    def serve(self) -> None:
        """Fork what is asked for, until the coordinator is gone or asks for nothing more."""
        for source in (self.control, self.coordinator, self.learnt[0]):
            self.selector.register(source, selectors.EVENT_READ, None)
        while True:
            ready = self.selector.select(0 if self.wanted else _IDLE_S)
            if not ready and self.wanted:
                load_library(self.wanted.pop(0))
            elif not ready and not self.keepers:
                return
            for key, _ in ready:
                if key.data is not None:
                    self._hear_of(*key.data)
                elif key.fileobj is self.learnt[0]:
                    self._learn()
                elif key.fd == self.coordinator or not self._fork():
                    return

    def _fork(self) -> bool:
        """Fork one step; False when nobody is left who could ask."""
        message, descriptors, _, _ = socket.recv_fds(self.control, 1, _N_DESCRIPTORS)
        if not message:
            return False
        text, task_socket, pipe, log = descriptors
        reports = socket.socket(fileno=task_socket)
        with os.fdopen(text, "rb") as stream:
            request = StepRequest(**json.load(stream))
        if request.is_compared:
            self._learn()
            while self.wanted:
                load_library(self.wanted.pop(0))
        try:
            keeper = os.fork()
        except OSError:
            keeper = NO_PROCESS
        if keeper == 0:
            self._become_step(request, reports, pipe, log)
        os.close(pipe)
        os.close(log)
        with suppress(OSError):
            reports.send(NUMBER.pack(keeper))
        if keeper == NO_PROCESS:
            reports.close()
            return True
        self.keepers[keeper] = reports
        process = os.pidfd_open(keeper)
        self.selector.register(process, selectors.EVENT_READ, (keeper, process))
        return True

    def _hear_of(self, keeper: int, process: int) -> None:
        """Tell how a keeper has ended; it is reaped once nobody can signal to its number more."""
        reports = self.keepers[keeper]
        if process >= 0:
            self.selector.unregister(process)
            os.close(process)
            info = os.waitid(os.P_PID, keeper, os.WEXITED | os.WNOWAIT)
            assert info is not None  # noqa: S101 - it waits
            is_exit = info.si_code == os.CLD_EXITED
            with suppress(OSError):
                reports.send(NUMBER.pack(info.si_status if is_exit else -info.si_status))
            self.selector.register(reports, selectors.EVENT_READ, (keeper, -1))
            return
        self.selector.unregister(reports)
        reports.close()
        os.waitpid(keeper, 0)
        del self.keepers[keeper]

    def _learn(self) -> None:
        with suppress(BlockingIOError):
            names = self.learnt[0].recv(_LARGEST_LIST).decode("ascii", "replace").split()
            known = {*sys.modules, *self.wanted}
            self.wanted += [name for name in names if name in _LIBRARIES and name not in known]

    def _become_step(
        self, request: StepRequest, reports: socket.socket, pipe: int, log: int
    ) -> None:
        """Go on as the keeper of a step and as the step; never returns."""
        try:
            server = os.getppid()
            os.setsid()
            for held in (reports, self.control, self.learnt[0], *self.keepers.values()):
                held.close()
            for key in list(self.selector.get_map().values()):
                if isinstance(key.fileobj, int):
                    os.close(key.fileobj)
            self.selector.close()
            os.dup2(log, 1)
            os.dup2(log, 2)
            os.close(log)
            _move_to(request)
            fork_kept(server)
            run_step(request.task_file, pipe, at_end=self._tell_libraries)
        except BaseException:  # noqa: BLE001 - nothing may get back into the server's loop
            traceback.print_exc()
        finally:
            os._exit(1)

    def _tell_libraries(self) -> None:
        names = [name for name in _LIBRARIES if name in sys.modules]
        with suppress(OSError):
            self.learnt[1].send(" ".join(names).encode())


def _move_to(request: StepRequest) -> None:
    """Take the coordinator's surroundings for this process."""
    for number, (soft, hard) in request.limits.items():
        with suppress(OSError, ValueError):
            resource.setrlimit(int(number), (soft, hard))
    os.environ.clear()
    os.environ.update(request.variables)
    sys.path[:] = request.paths
    importlib.invalidate_caches()
    reload_numba_config()
    os.chdir(request.folder)


def load_library(name: str) -> None:
    """Load a library for the processes that are forked from this one, as well as it can be.

    Steps say what is wrong with it.
    """
    if address_space() is not None:
        # Some crash where they get too little, and all steps with this process.
        return
    with suppress(Exception):
        importlib.import_module(name)
        if name == "numba":
            _ready_numba()
    gc.freeze()


def _ready_numba() -> None:
    """Let numba register what it can compile, as it does for the first kernel of a process.

    That takes longer than loading numba. Its extensions are code of strangers: they are left to
    each step, which looks for them again.
    """
    from numba.core import entrypoints  # noqa: PLC0415 - only where numba is loaded anyway
    from numba.core.registry import cpu_target  # noqa: PLC0415

    entrypoints._already_initialized = True  # noqa: SLF001 - numba has no other door for it
    try:
        cpu_target.target_context.refresh()
    finally:
        entrypoints._already_initialized = False  # noqa: SLF001


def main(arguments: list[str]) -> None:
    """Serve the coordinator that spawned this process."""
    control, coordinator = socket.socket(fileno=int(arguments[0])), int(arguments[1])
    control.set_inheritable(False)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        process = os.pidfd_open(coordinator)
    except ProcessLookupError:
        return
    if os.getppid() != coordinator:
        return
    gc.freeze()
    _Server(control, process).serve()


if __name__ == "__main__":
    main(sys.argv[1:])
