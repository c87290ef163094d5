"""What linters do not hold: module sizes, forbidden names, what may be loaded when."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Collection
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Reading:
    """What the tests look for in the tree of a module.

    Attributes:
        imported: modules of ours.
        details: lines that read the details of a product.
        arrays_in_parts: lines of kernels that put an array into a part of one.
    """

    imported: set[str]
    details: list[int]
    arrays_in_parts: list[int]


@cache
def readings() -> dict[Path, Reading]:
    """All modules, each parsed once: their trees would take hundreds of MiB."""
    known = {name_of(module) for module in MODULES}
    found = {}
    for module in MODULES:
        tree = ast.parse((ROOT / module).read_text())
        found[module] = Reading(
            imported_modules(tree, known), _readings_of_details(tree), _arrays_put_into_parts(tree)
        )
    return found


def import_graph() -> nx.DiGraph[str]:
    """Modules and packages by name, an edge to each one that they import."""
    graph: nx.DiGraph[str] = nx.DiGraph()
    for module, read in readings().items():
        name = name_of(module)
        graph.add_edges_from((name, other) for other in read.imported - {name})
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


@pytest.mark.parametrize("command", [["--help"], ["plugins", "list"]], ids=" ".join)
def test_listing_commands_load_no_numerical_library(command: list[str]) -> None:
    loaded = run_python(
        "from orthoflow.cli import main\n"
        f"sys.argv = ['orthoflow', *{command!r}]\n"
        "try:\n    main()\nexcept SystemExit as stop:\n    assert not stop.code, stop.code\n"
        "slow = ('numpy', 'pydantic', 'networkx', 'h5py')\n"
        "print('LOADED', [name for name in slow if name in sys.modules])"
    )
    assert loaded.splitlines()[-1] == "LOADED []"


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


def test_nobody_reads_the_details_of_a_product() -> None:
    """They are for people: what other code reads is a typed, documented field of the product."""
    found = [f"{module}:{line}" for module, read in readings().items() for line in read.details]
    templates = [path for package in PACKAGES for path in (ROOT / package).rglob("*.j2")]
    found += [
        f"{path.relative_to(ROOT)}:{number}"
        for path in templates
        for number, line in enumerate(path.read_text().splitlines(), start=1)
        if ".details" in line
    ]
    assert not found, "\n".join(found)


def test_no_kernel_puts_an_array_into_a_part_of_one() -> None:
    """Numba would compile the sentence about shapes that differ: seconds in each process."""
    found = [
        f"{module}:{line}" for module, read in readings().items() for line in read.arrays_in_parts
    ]
    assert not found, "\n".join(found)


def _arrays_put_into_parts(tree: ast.Module) -> list[int]:
    """Lines of kernels such as `part[2:] = array` and `part[2:] = array[:3]`."""
    kernels = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        and any(
            re.match(r"compiled|inlined|.*kernel_part", ast.unparse(how))
            for how in node.decorator_list
        )
    ]
    lines: list[int] = []
    for kernel in kernels:
        assigned = [node for node in ast.walk(kernel) if isinstance(node, ast.Assign)]
        arrays = {
            argument.arg
            for argument in kernel.args.args
            if argument.annotation and "NDArray" in ast.unparse(argument.annotation)
        }
        arrays |= {
            ast.unparse(node.targets[0])
            for node in assigned
            if re.match(r"np\.(empty|zeros|ones|full)", ast.unparse(node.value))
        }
        lines += [
            node.lineno
            for node in assigned
            if _is_part(node.targets[0])
            and (_is_part(node.value) or ast.unparse(node.value) in arrays)
        ]
    return lines


def _is_part(node: ast.expr) -> bool:
    return isinstance(node, ast.Subscript) and any(
        isinstance(item, ast.Slice) for item in ast.walk(node.slice)
    )


@pytest.mark.parametrize(
    ("line", "is_array"),
    [
        ("fitted[0:3] = up", True),
        ("fitted[:3] = up[:3]", True),
        ("fitted[1, 4:] = made", True),
        ("fitted[0:3] = up[0]", False),
        ("fitted[0] = made[1]", False),
    ],
)
def test_arrays_put_into_parts_are_seen(line: str, is_array: bool) -> None:
    kernel = f"@compiled\ndef f(fitted: NDArray, up: NDArray):\n    made = np.empty(3)\n    {line}"
    assert bool(_arrays_put_into_parts(ast.parse(kernel))) == is_array
    assert not _arrays_put_into_parts(ast.parse(kernel.replace("@compiled\n", "")))


def _readings_of_details(tree: ast.Module) -> list[int]:
    """Lines that take an entry out of an attribute named `details`, ask for one, or walk it.

    Handing all of it on (`{**product.details, ...}`, `dict(count.details)`) reads nothing.
    """
    readers = {"get", "items", "keys", "pop", "setdefault", "values"}
    read: list[ast.AST] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Subscript | ast.Attribute) and (
            isinstance(node, ast.Subscript) or node.attr in readers
        ):
            read.append(node.value)
        elif isinstance(node, ast.Compare):
            read.extend(node.comparators)
        elif isinstance(node, ast.For | ast.comprehension):
            read.append(node.iter)
        elif isinstance(node, ast.Assign | ast.AnnAssign | ast.NamedExpr) and node.value:
            # Under another name it would be read unseen.
            read.append(node.value)
    return sorted(
        item.lineno for item in read if isinstance(item, ast.Attribute) and item.attr == "details"
    )


@pytest.mark.parametrize(
    ("line", "is_reading"),
    [
        ('ties.details["walls"]', True),
        ('ties.details.get("walls")', True),
        ('"walls" in ties.details', True),
        ("[name for name in ties.details]", True),
        ("told = ties.details", True),
        ('{**ties.details, "photos": 2}', False),
        ("header = dict(count.details)", False),
        ('metadata["details"]', False),
    ],
)
def test_readings_of_details_are_seen(line: str, is_reading: bool) -> None:
    assert bool(_readings_of_details(ast.parse(line))) == is_reading


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
