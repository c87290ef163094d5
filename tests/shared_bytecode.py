"""Bytecode of sources and tests, made once by the processes that tests are spread over.

Each of them imports all tests before it runs any. Where nothing is compiled yet they would do it
side by side, the same files at the same time: each makes its share first.
"""

from __future__ import annotations

import compileall
import sys
from importlib.util import cache_from_source
from pathlib import Path
from typing import Final

import pytest
from _pytest.assertion import rewrite

_ROOT: Final = Path(__file__).resolve().parents[1]


def write_share(config: pytest.Config, number: int, count: int) -> None:
    """Make the bytecode of every `count`-th file from `number` on, where there is none.

    Files of tests get theirs with assertions rewritten, as pytest does when it imports them.
    """
    for path in _files()[number::count]:
        if path.name.startswith("test_") or path.name == "conftest.py":
            kept = Path(cache_from_source(str(path)))
            if not kept.with_name(path.stem + rewrite.PYC_TAIL).exists():
                _rewrite(config, path)
        else:
            compileall.compile_file(path, quiet=2)


def _files() -> list[Path]:
    folders = ("tests", "orthoflow", "plugins", "provenance")
    return sorted(path for folder in folders for path in (_ROOT / folder).rglob("*.py"))


def _rewrite(config: pytest.Config, path: Path) -> None:
    hook = config.pluginmanager.rewrite_hook
    if sys.dont_write_bytecode or not isinstance(hook, rewrite.AssertionRewritingHook):
        return
    try:
        rewritten, write, state = rewrite._rewrite_test, rewrite._write_pyc, rewrite.assertstate_key
    except AttributeError:  # a pytest that has other names for it: each process makes its own
        return
    folder = rewrite.get_cache_dir(path)
    if rewrite.try_makedirs(folder):
        digest, code = rewritten(path, config)
        write(config.stash[state], code, digest, folder / (path.stem + rewrite.PYC_TAIL))
