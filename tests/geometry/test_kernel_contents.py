"""Whatever changes a kernel's code changes its digest, and nothing else does."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numba
import orthoflow_plugins
import pytest
from numba.core import types

from orthoflow.geometry.kept_kernels import UntellableError, contents_digest, fields_of

OTHERS = """
import enum
import numpy as np
from typing import NamedTuple
from orthoflow.geometry.compiling import inlined, kernel_part
LIMIT = 7
TABLE = (1, (2.0, "three"))
ARRAY = np.arange(4.0)
UNUSED = 5
class Kind(enum.IntEnum):
    WALL = 1
    FLOOR = 2
class Grid(NamedTuple):
    rows: int
    columns: int
@kernel_part
def far(x):
    return x + 1
@inlined
def near(x):
    return far(x) * 2
@kernel_part
def unused(x):
    return x
"""
KERNELS = """
import kernel_contents_others as others
from kernel_contents_others import ARRAY, TABLE, Grid, Kind, near
from orthoflow.geometry.compiling import compiled
OWN = 3.5
@compiled
def asked(x, y=4):
    def inner(z):
        return z + OWN
    grid = Grid(1, 2)
    return inner(near(x)) + others.LIMIT + TABLE[0] + ARRAY[y] + Kind.WALL + grid.rows + behind(x)
@compiled
def behind(x):
    return 6 * x
"""


@pytest.fixture
def digest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Import both modules with something replaced in them, as a new process does; nothing runs."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def import_again(old: str = "", new: str = "") -> str:
        texts = {"kernel_contents_others": OTHERS, "kernel_contents_asked": KERNELS}
        assert not old or sum(text.count(old) for text in texts.values()) == 1
        for name, text in texts.items():
            (tmp_path / f"{name}.py").write_text(text.replace(old, new) if old else text)
            monkeypatch.delitem(sys.modules, name, raising=False)
        monkeypatch.setattr(sys, "dont_write_bytecode", True)
        importlib.invalidate_caches()
        return contents_digest(importlib.import_module("kernel_contents_asked").asked)

    return import_again


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("OWN = 3.5", "OWN = 3.25"),
        ("OWN = 3.5", "OWN = 3"),
        ("LIMIT = 7", "LIMIT = 8"),
        ('"three"', '"four"'),
        ("arange(4.0)", "arange(4.0)[::-1].copy()"),
        ("arange(4.0)", "arange(4)"),
        ("WALL = 1", "WALL = 3"),
        ("    rows: int\n    columns: int", "    columns: int\n    rows: int"),
        ("x + 1", "x + 2"),
        ("far(x) * 2", "far(x) * 3"),
        ("@inlined", "@kernel_part"),
        ("y=4", "y=3"),
        ("z + OWN", "z - OWN"),
        ("6 * x", "6 + x"),
    ],
)
def test_whatever_a_kernel_holds_is_in_its_digest(
    digest: Callable[..., str], old: str, new: str
) -> None:
    assert digest(old, new) != digest()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("OWN = 3.5", "# Further down.\n\nOWN = 3.50"),
        ("UNUSED = 5", "UNUSED = 6"),
        ("    return x\n", "    return -x\n"),
        ("LIMIT = 7", "LIMIT = 14 // 2"),
    ],
)
def test_nothing_else_is(digest: Callable[..., str], old: str, new: str) -> None:
    assert digest(old, new) == digest()


class Grid(NamedTuple):
    rows: int
    columns: int


class Turned(NamedTuple):
    columns: int
    rows: int


def test_fields_that_changed_places_are_told_apart() -> None:
    grid, turned = (types.NamedTuple((types.int64,) * 2, each) for each in (Grid, Turned))
    assert fields_of((types.int64, grid)) != fields_of((types.int64, turned))
    pair = types.Tuple((grid, types.float64))
    assert fields_of(pair) != fields_of(types.Tuple((turned, types.float64)))


def test_a_kernel_that_holds_something_unknown_is_not_told() -> None:
    thing: Any = object()

    @numba.njit  # type: ignore[untyped-decorator]
    def odd(x: int) -> object:
        return thing if x else None

    with pytest.raises(UntellableError, match="object"):
        contents_digest(odd)


def test_each_of_our_kernels_is_told_and_no_two_alike() -> None:
    told = json.loads((Path(orthoflow_plugins.__path__[0]) / "kernels.json").read_bytes())
    digests = {}
    for module in {module for module, _, _ in told["kernels"]}:
        for name, item in vars(importlib.import_module(module)).items():
            if isinstance(item, numba.core.dispatcher.Dispatcher):
                digests[f"{item.py_func.__module__}.{name}"] = contents_digest(item)
    assert len(digests) > 100
    assert len(set(digests.values())) == len(digests)
