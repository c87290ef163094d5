"""Compiled kernels are found by all that decides them, and reported while they compile."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path
from typing import Final

import numba
import pytest

from orthoflow.geometry import compiling
from orthoflow.geometry.compile_events import on_compiling
from orthoflow.geometry.compiling import content_digest

_KERNEL: Final = """
from typing import NamedTuple

from orthoflow.geometry.compiling import compiled, kernel_part
from numbers_of_it import FACTOR, turned


class Pair(NamedTuple):
    first: float
    second: float


@compiled
def answer(pair):
    return part(pair) + (lambda x: x * FACTOR)(1.0)


@kernel_part
def part(pair):
    return turned(pair.first)
"""
_PRINTED: Final = "print(answer(Pair(3.0, 5.0)), sum(answer.stats.cache_misses.values()))"
_NUMBERS: Final = """
from orthoflow.geometry.compiling import inlined, kernel_part

FACTOR = 10.0


@inlined
def turned(x):
    return doubled(x) + 1


@kernel_part
def doubled(x):
    return 2 * x
"""


def _digest(texts: dict[str, str], folder: Path) -> str:
    """Digest of the kernel as these modules define it."""
    for name, text in texts.items():
        (folder / f"{name}.py").write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        patch.setattr(sys, "dont_write_bytecode", True)
        for name in texts:
            patch.delitem(sys.modules, name, raising=False)
        try:
            return content_digest(importlib.import_module("kernel").answer.py_func)
        finally:
            for name in texts:
                sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("file", "before", "after", "is_same"),
    [
        ("numbers_of_it", "FACTOR = 10.0", "FACTOR = 20.0", False),  # a constant elsewhere
        ("numbers_of_it", "2 * x", "3 * x", False),  # two calls away
        ("numbers_of_it", "+ 1", "+ 2", False),
        ("numbers_of_it", "@inlined", "@kernel_part", False),
        ("kernel", "turned(pair.first)", "turned(pair.second)", False),
        ("kernel", "@compiled", "# A comment.\n\n\n@compiled", True),
        ("numbers_of_it", "FACTOR =", "OTHER = 1\nFACTOR =", True),
    ],
)
def test_the_digest_is_of_all_that_a_kernel_calls_and_of_nothing_else(
    tmp_path: Path, file: str, before: str, after: str, *, is_same: bool
) -> None:
    texts = {"kernel": _KERNEL, "numbers_of_it": _NUMBERS}
    edited = texts | {file: texts[file].replace(before, after)}
    assert edited != texts
    (tmp_path / "elsewhere").mkdir()
    digests = {_digest(texts, tmp_path), _digest(edited, tmp_path / "elsewhere")}
    assert len(digests) == (1 if is_same else 2)


def _answer(folder: Path, cache: Path, kernel: str) -> tuple[float, int]:
    """Value of the kernel and how many versions of it were compiled, by a new process."""
    folder.mkdir(exist_ok=True)
    (folder / "kernel.py").write_text(f"{kernel}\n{_PRINTED}")
    (folder / "numbers_of_it.py").write_text(_NUMBERS)
    command = [sys.executable, "-c", "import kernel"]
    env = {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(folder)}
    value, n_compiled = subprocess.check_output(command, cwd=folder, env=env, text=True).split()
    return float(value), int(n_compiled)


def test_versions_are_kept_side_by_side_for_checkouts_anywhere(tmp_path: Path) -> None:
    # Numba itself takes tuples for the same type whose fields changed places.
    edited = _KERNEL.replace("first: float\n    second: float", "second: float\n    first: float")
    cache = tmp_path / "cache"
    assert _answer(tmp_path / "a", cache, _KERNEL) == (7.0 + 10.0, 1)
    assert _answer(tmp_path / "a", cache, edited) == (11.0 + 10.0, 1)
    assert _answer(tmp_path / "b", cache, _KERNEL) == (7.0 + 10.0, 0)


def test_a_kernel_and_those_that_it_needs_are_reported_once() -> None:
    assert compiling.numba is numba
    namespace: dict[str, object] = {"njit": numba.njit}
    exec(
        "@njit\ndef inner(x):\n    return x + 1\n@njit\ndef outer(x):\n    return inner(x) * 2\n",
        namespace,
    )
    outer = namespace["outer"]
    reported: list[str] = []
    with on_compiling(reported.append):
        assert outer(1) == 4  # type: ignore[operator]
        assert outer(2) == 6  # type: ignore[operator]
    matches = [re.fullmatch(r"compiling (\w+) \((\d+) so far\)", text) for text in reported[:2]]
    (outer_name, first), (inner_name, second) = (
        match.groups() if match else ("", "") for match in matches
    )
    assert (outer_name, inner_name, reported[2:]) == ("outer", "inner", [""])
    # Whatever else this process compiled before is counted, too.
    assert int(second) == int(first) + 1
    assert namespace["inner"](1.5) == 2.5  # type: ignore[operator]
    assert len(reported) == 3
