"""What linters do not hold: module sizes, forbidden names, what may be loaded when."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Collection
from functools import cache
from pathlib import Path

import networkx as nx
import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("orthoflow", "plugins/orthoflow_plugins", "provenance/orthoflow_provenance")
# What the packages lie in.
FOLDERS = (Path("plugins"), Path("provenance"), Path())
MODULES = sorted(
    path.relative_to(ROOT) for package in PACKAGES for path in (ROOT / package).rglob("*.py")
)
FORBIDDEN_NAMES = {"utils", "util", "helpers", "common", "base", "misc", "core", "manager"}
HEAVY = ("open3d", "pycolmap", "cv2", "rasterio", "laspy")
# What takes a good part of a second to import: `plan` loads every method of a workflow.
SLOW = ("numba", "scipy", "matplotlib")
CHILD_PATH = (
    f"import sys; sys.path[:0] = {[str(ROOT / part) for part in ('', 'plugins', 'provenance')]};"
)


def run_python(code: str) -> str:
    completed = subprocess.run(
        [sys.executable, "-c", CHILD_PATH + code], capture_output=True, text=True, check=False
    )
    assert completed.returncode == 0, completed.stderr
    return completed.stdout


def test_modules_have_at_most_800_lines_and_a_noun_for_a_name() -> None:
    long = [m for m in MODULES if len((ROOT / m).read_text().splitlines()) > 800]
    assert long == []
    assert [m for m in MODULES if FORBIDDEN_NAMES & {m.stem, *m.parts}] == []


def test_imports_run_in_no_circle() -> None:
    circles = [
        circle for circle in nx.strongly_connected_components(import_graph()) if len(circle) > 1
    ]
    assert circles == []


def test_geometry_keeps_only_what_two_kinds_or_the_framework_share() -> None:
    geometry, graph = "orthoflow.geometry", import_graph()
    for module in [name for name in graph if name.startswith(f"{geometry}.")]:
        # Who reaches it through geometry alone.
        users, todo = set[str](), [module]
        while todo:
            for user in graph.predecessors(todo.pop()):
                if user.startswith(geometry):
                    todo.append(user)
                else:
                    users.add(".".join(user.split(".")[:2]))
        kinds = {user for user in users if user.startswith("orthoflow_plugins")}
        assert len(kinds) >= 2 or users > kinds, f"{module} belongs to {kinds}"


@cache
def import_graph() -> nx.DiGraph[str]:
    """Modules and packages by name, an edge to each one that they import."""
    graph: nx.DiGraph[str] = nx.DiGraph()
    known = {name_of(module) for module in MODULES}
    for module in MODULES:
        name, tree = name_of(module), ast.parse((ROOT / module).read_text())
        graph.add_edges_from((name, other) for other in imported_modules(tree, known) - {name})
    return graph


def name_of(module: Path) -> str:
    parts = module.relative_to(next(p for p in FOLDERS if module.is_relative_to(p))).with_suffix("")
    return ".".join(part for part in parts.parts if part != "__init__")


def imported_modules(tree: ast.Module, known: Collection[str]) -> set[str]:
    """Modules of ours that a module imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            submodules = {f"{node.module}.{alias.name}" for alias in node.names} & set(known)
            found |= submodules or {node.module}
    return found & set(known)


def test_loading_every_method_loads_no_heavy_or_slow_library() -> None:
    loaded = run_python(
        "from orthoflow.catalog.discovery import discover_catalog\n"
        "catalog = discover_catalog()\n"
        "[entry.load() for entry in catalog.methods.values()"
        " if entry.distribution.name == 'orthoflow-tls']\n"
        f"print([name for name in {HEAVY + SLOW!r} if name in sys.modules])"
    )
    assert loaded.strip() == "[]"


def test_no_run_loads_a_library_for_the_mistakes_of_a_workflow() -> None:
    loaded = run_python(
        "import orthoflow.engine.scheduler\n"
        "from orthoflow.records import compare, verify, write\n"
        f"print([name for name in {('networkx', *HEAVY, *SLOW)!r} if name in sys.modules])"
    )
    assert loaded.strip() == "[]"


def test_import_contracts_hold() -> None:
    linter = Path(sys.executable).with_name("lint-imports")
    paths = ":".join(str(ROOT / part) for part in ("", "plugins", "provenance"))
    completed = subprocess.run(
        [str(linter), "--no-cache"],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        env={"PYTHONPATH": paths, "PATH": os.environ["PATH"]},
    )
    assert completed.returncode == 0, completed.stdout + completed.stderr


@pytest.mark.parametrize("folder", ["orthoflow", "plugins", "provenance"])
def test_no_module_carries_doubts_or_leftovers(folder: str) -> None:
    words = ("TODO", "FIXME", "XXX", "NotImplementedError", "placeholder", "for now")
    found = [
        f"{path.relative_to(ROOT)}: {word}"
        for path in (ROOT / folder).rglob("*.py")
        for word in words
        if word in path.read_text()
    ]
    assert found == []


def test_what_is_optional_is_asked_for_in_one_place() -> None:
    """A test that looks for a program or skips by itself can fail on a bare machine."""
    own = ("optional.py", "browser.py", "test_architecture.py")
    words = re.compile(r"pytest\.skip\(|importorskip|shutil\.which\(|sync_playwright")
    found = {
        str(path.relative_to(ROOT)): words.findall(path.read_text())
        for path in sorted((ROOT / "tests").rglob("*.py"))
        if path.name not in own
    }
    assert {name: said for name, said in found.items() if said} == {}
