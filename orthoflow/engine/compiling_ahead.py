"""What later steps need is compiled while earlier ones run, on cores that have nothing else to do.

A plugin's package may hold `kernels.json`: for each of its methods the kernels that Python calls,
with the types of their arguments. Those of the methods that a run still has before it are compiled
by a process of lowest priority into the folder that the steps read. A step that comes too early
compiles for itself, or waits for the one kernel that is being compiled (`geometry.kept_kernels`);
what else it needs is left to it from then on, or both would go through one list, one waiting for
the other. Beside a step whose times are compared nothing is compiled: its core shares memory and
cache. `python -m orthoflow.engine.compiling_ahead` is that process; it ends with the coordinator.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import json
import os
import subprocess
import sys
import threading
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final

from orthoflow.engine.compiled_code import DONE
from orthoflow.engine.environment import python_path
from orthoflow.engine.executors import COMPILED_CODE
from orthoflow.engine.keys import MethodFacts

FORETOLD: Final = "kernels.json"
_NICENESS: Final = 19

# Module, name and types of the arguments of a kernel, as `geometry.kernel_types` writes them.
_Kernel = list[Any]


@dataclass
class AheadCompiler:
    """The processes that compile for one run.

    Attributes:
        is_wanted: whether there is a core besides the one that a step needs, while none is there.
    """

    is_wanted: bool
    _processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def begin(
        self, folders: Mapping[Path, Iterable[MethodFacts]], *, is_backwards: bool = False
    ) -> None:
        """Begin; nothing fails for it.

        Args:
            folders: where compiled kernels are kept -> methods in the order of their steps.
            is_backwards: whether the last kernel of a method comes first, where the method runs
                already and begins with the first.
        """
        self.is_wanted = False
        for folder, methods in folders.items():
            orders = _orders(folder, methods)
            if is_backwards:
                orders = {name: kernels[::-1] for name, kernels in orders.items()}
            if orders:
                with suppress(OSError):
                    self._processes.append(_start(folder, orders))

    def leave(self, method: str) -> None:
        """Leave what is not begun of a method's kernels to its step, which begins now."""
        for process in self._processes:
            assert process.stdin is not None  # noqa: S101 - it is a pipe
            with suppress(OSError):
                os.write(process.stdin.fileno(), f"{method}\n".encode())

    def hold(self) -> None:
        """End them until a later `begin`; a kernel that is half compiled is begun anew then."""
        self.is_wanted |= bool(self._processes)
        self.close()

    def close(self) -> None:
        """End them: what is not compiled by now no step of this run needs."""
        for process in self._processes:
            assert process.stdin is not None  # noqa: S101 - it is a pipe
            process.stdin.close()
            process.kill()
            process.wait()
        self._processes.clear()


def _orders(folder: Path, methods: Iterable[MethodFacts]) -> dict[str, list[_Kernel]]:
    """Give the name of the file that says it is done -> kernels, for methods that have none."""
    orders = {}
    for facts in methods:
        kernels = _foretold(facts.target.partition(".")[0]).get(facts.method)
        if kernels:
            digest = hashlib.sha256(json.dumps(kernels).encode()).hexdigest()
            name = f"{facts.method}.{digest[:8]}{DONE}"
            if not (folder / name).exists():
                orders[name] = kernels
    return orders


@cache
def _foretold(package: str) -> Mapping[str, list[_Kernel]]:
    """Give method -> its kernels, as the package of a plugin tells them; nothing of it is run."""
    try:
        spec = importlib.util.find_spec(package)
        folders = (spec.submodule_search_locations or ()) if spec is not None else ()
        path = next(Path(folder) / FORETOLD for folder in folders)
        told = json.loads(path.read_bytes())
        return {name: [told["kernels"][k] for k in ks] for name, ks in told["methods"].items()}
    except (ImportError, LookupError, OSError, StopIteration, TypeError, ValueError):
        return {}


def _start(folder: Path, orders: Mapping[str, list[_Kernel]]) -> subprocess.Popen[bytes]:
    # Its length is bounded by no pipe's buffer.
    with os.fdopen(os.memfd_create("orders"), "wb") as stream:
        stream.write(json.dumps(orders).encode())
        stream.flush()
        stream.seek(0)
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "orthoflow.engine.compiling_ahead", str(stream.fileno())],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={
                **os.environ,
                COMPILED_CODE: str(folder),
                "PYTHONHASHSEED": "0",
                "PYTHONPATH": python_path(),
            },
            pass_fds=(stream.fileno(),),
            start_new_session=True,
        )


def compile_all(
    folder: Path, orders: Mapping[str, list[_Kernel]], left: Collection[str] = ()
) -> None:
    """Compile the kernels of each method, and say of each that it is done.

    A kernel that is not there as it was foretold is left to the step that needs it.

    Args:
        folder: where this process keeps what it compiles.
        orders: name of the file to leave -> kernels.
        left: methods whose steps have begun, which may become more meanwhile.
    """
    from orthoflow.geometry.kernel_types import type_of  # noqa: PLC0415 - loads the compiler

    for name, kernels in orders.items():
        method = name.removesuffix(DONE).rpartition(".")[0]
        for module, kernel, arguments in kernels:
            if method in left:
                break
            with suppress(Exception):
                found = getattr(importlib.import_module(module), kernel)
                found.compile(tuple(map(type_of, arguments)))
        else:
            with suppress(OSError):
                (folder / name).touch()


def _listen(left: set[str]) -> None:
    """Hear which methods are left; end this process when nobody is there who could tell."""
    for line in sys.stdin:
        left.add(line.rstrip("\n"))
    os._exit(0)


def main(arguments: list[str]) -> None:
    """Compile what the coordinator orders."""
    os.nice(_NICENESS)
    left: set[str] = set()
    threading.Thread(target=_listen, args=(left,), daemon=True).start()
    with os.fdopen(int(arguments[0]), "rb") as stream:
        orders = json.load(stream)
    compile_all(Path(os.environ[COMPILED_CODE]), orders, left)


if __name__ == "__main__":
    main(sys.argv[1:])
