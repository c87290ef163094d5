"""Kernels are compiled anew when what they hold changed, and not when a file next door did."""

from __future__ import annotations

import ast
import importlib.util
from collections.abc import Iterator
from pathlib import Path

import pytest

from orthoflow.catalog.catalog import MethodEntry
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.engine.kernel_sources import kernel_sources
from orthoflow.engine.keys import compiled_digest, framework_files
from tests.laboratories import write_distribution

DECORATORS = {"compiled", "inlined", "kernel_part", "typed_kernel_part"}


def ours() -> frozenset[Path]:
    entry = discover_catalog().method("plane.hough2d")
    return frozenset({*framework_files(), *entry.source_files()})


def has_kernel(tree: ast.Module) -> bool:
    decorators = (
        decorator.func if isinstance(decorator, ast.Call) else decorator
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        for decorator in node.decorator_list
    )
    return any(isinstance(each, ast.Name) and each.id in DECORATORS for each in decorators)


def imported_files(tree: ast.Module) -> Iterator[Path]:
    """Files of the modules that a module imports anywhere, as Python finds them."""
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            if name.partition(".")[0] in ("orthoflow", "orthoflow_plugins"):
                try:
                    spec = importlib.util.find_spec(name)
                except ModuleNotFoundError:
                    continue
                if spec is not None and spec.origin:
                    yield Path(spec.origin)


def test_all_that_our_kernels_hold_is_among_their_sources() -> None:
    files = ours()
    sources = kernel_sources(files, ())
    waiting = [path for path in files if has_kernel(ast.parse(path.read_bytes()))]
    assert len(waiting) > 25
    held: set[Path] = set()
    while waiting:
        path = waiting.pop()
        if path in files and path not in held:
            held.add(path)
            waiting += imported_files(ast.parse(path.read_bytes()))
    assert held <= sources
    names = {path.name for path in files - sources}
    assert {"detecting.py", "hough2d.py", "seams.py", "las.py"} <= names


PACKAGE = {
    "near/__init__.py": "",
    "near/kernel.py": """
        import numba
        from near import (  # one of these is (not) a module
            first,
            second as renamed,
        )
        from . import \\
            third
        from .inner.fourth import CONSTANT
        @numba.njit
        def f(x): return x + CONSTANT
    """,
    "near/first.py": "ONE = 1",
    "near/second.py": "def g():\n    import near.inner.fifth",
    "near/third.py": "if True: from ..near.sixth import *",
    "near/sixth.py": "",
    "near/inner/__init__.py": "",
    "near/inner/fourth.py": "CONSTANT = 4",
    "near/inner/fifth.py": "",
    "near/next_door.py": "from near import kernel",
    "near/inner/next_door.py": "",
    # Names that begin with a dot mean no others of the same name.
    "far/third.py": "",
    "far/inner/fourth.py": "",
}


@pytest.fixture
def package(tmp_path: Path) -> Path:
    for name, text in PACKAGE.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


def test_whatever_a_module_with_kernels_imports_counts_however_it_is_written(package: Path) -> None:
    found = kernel_sources([*package.rglob("*.py")], ())
    left = {path.relative_to(package).as_posix() for path in {*package.rglob("*.py")} - found}
    # What a package itself holds counts where a name is taken out of it.
    next_door = {"near/next_door.py", "near/inner/next_door.py", "near/inner/__init__.py"}
    assert left == {*next_door, "far/third.py", "far/inner/fourth.py"}


def test_where_strangers_may_compile_each_of_their_files_counts(package: Path) -> None:
    everything = {*package.rglob("*.py")}
    assert kernel_sources(everything, everything) == everything
    (package / "near/kernel.py").write_text("from fast import njit")
    assert kernel_sources(everything, everything) == everything
    (package / "near/kernel.py").write_text("from near.inner import fourth")
    assert kernel_sources(everything, everything) == frozenset()


HOOKS = """
    from orthoflow.sdk.hooks import MethodSpec, hookimpl

    @hookimpl
    def orthoflow_methods():
        return [MethodSpec(id="plane.nearby", target="nearby.method:Nearby", summary="For a test.")]
"""


def nearby(folder: Path, monkeypatch: pytest.MonkeyPatch) -> MethodEntry:
    sources = {"nearby/__init__.py": "", "nearby/method.py": "", "nearby_hooks.py": HOOKS}
    monkeypatch.syspath_prepend(write_distribution(folder, "nearby", sources))
    return discover_catalog().methods["plane.nearby"]


def test_a_change_next_door_compiles_nothing_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = nearby(tmp_path / "site", monkeypatch)
    method = tmp_path / "site" / "nearby" / "method.py"
    before = compiled_digest(entry)
    method.write_text("LIMIT = 3\n")
    assert compiled_digest(entry) == before
    method.write_text("import numba\n")
    with_kernel = compiled_digest(entry)
    assert with_kernel != before
    (tmp_path / "site" / "nearby" / "__init__.py").write_text("LIMIT = 3\n")
    assert compiled_digest(entry) != with_kernel
    # As it was, whenever that was written.
    method.write_text("")
    (tmp_path / "site" / "nearby" / "__init__.py").write_text("")
    assert compiled_digest(entry) == before
