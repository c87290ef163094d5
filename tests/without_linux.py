"""Forbids our code what only Linux or Unix has: modules, and names of `os`; libraries keep theirs.

    python -m pytest -p tests.without_linux tests/geometry tests/files tests/products ...

runs tests as a system without these would; the text of this module does the same for a command.
"""

import builtins
import importlib
import os
import sys
from types import ModuleType
from typing import Any

MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"}
NAMES = (
    *("fork", "forkpty", "getresuid", "killpg", "memfd_create", "nice", "O_PATH", "pidfd_open"),
    *("posix_fallocate", "pread", "pwrite", "sched_getaffinity", "setsid", "waitid"),
    *("fchdir", "O_DIRECTORY", "O_NOFOLLOW"),
)


def _require_known(name: str, caller: object) -> None:
    if name in MODULES and str(caller).startswith("orthoflow"):
        raise ModuleNotFoundError(f"No module named {name!r} on this system", name=name)


def _forbid() -> None:
    plain_import, plain_import_module = builtins.__import__, importlib.import_module

    def import_(name: str, globals: Any = None, *more: Any, **named: Any) -> Any:
        _require_known(name, (globals or {}).get("__name__"))
        return plain_import(name, globals, *more, **named)

    def import_module(name: str, package: str | None = None) -> ModuleType:
        _require_known(name, sys._getframe(1).f_globals.get("__name__"))
        return plain_import_module(name, package)

    builtins.__import__, importlib.import_module = import_, import_module
    for name in NAMES:
        if hasattr(os, name):
            delattr(os, name)


_forbid()
