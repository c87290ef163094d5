"""The public face of plugins as text, read from the sources: `python tests/public_surface.py`.

Writes `docs/public-api.txt`. Refuses when names changed but the CHANGELOG's section did not.
"""

from __future__ import annotations

import ast
import hashlib
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RECORD = ROOT / "docs" / "public-api.txt"
CHANGELOG = ROOT / "CHANGELOG.md"
SECTION = "### Public face of plugins"
COMMAND = "python tests/public_surface.py"
PACKAGES = ("sdk", "files", "products", "geometry", "errors", "testing")

Definition = ast.FunctionDef | ast.ClassDef | ast.Assign | ast.AnnAssign


def surface() -> list[str]:
    """One line per public name, its signature with it."""
    lines: list[str] = []
    for package in PACKAGES:
        name = f"orthoflow.{package}"
        exported = _exported(name)
        if exported:
            for public in exported:
                module, original = _home(name, public)
                lines += _described(f"{name}.{public}", _definitions(module).get(original))
            continue
        # A package without __all__ (files), or a single module (errors).
        for module in _modules(name):
            for public, node in _definitions(module).items():
                if not public.startswith("_") and isinstance(node, ast.FunctionDef | ast.ClassDef):
                    lines += _described(f"{module}.{public}", node)
    return sorted(lines)


def changelog_digest() -> str:
    """Digest of the CHANGELOG's section on the public face."""
    text = CHANGELOG.read_text(encoding="utf-8")
    section = text.partition(SECTION)[2].partition("\n## ")[0].partition("\n### ")[0]
    return hashlib.sha256(section.strip().encode()).hexdigest()[:16]


def recorded() -> tuple[str, list[str]]:
    """The CHANGELOG digest and the lines of the record."""
    head, *lines = RECORD.read_text(encoding="utf-8").splitlines()
    return head.rpartition(" ")[2], lines


def differences(before: list[str], now: list[str]) -> list[str]:
    """What was removed and what is new."""
    removed = [f"- {line}" for line in before if line not in set(now)]
    return removed + [f"+ {line}" for line in now if line not in set(before)]


def _path(module: str) -> Path:
    # The words of a record, which the sdk hands on, lie in the lowest package.
    root = ROOT / "provenance" if module.startswith("orthoflow_provenance") else ROOT
    path = root.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _tree(module: str) -> ast.Module:
    return ast.parse(_path(module).read_text(encoding="utf-8"))


def _exported(module: str) -> list[str]:
    for node in _tree(module).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return [str(item) for item in ast.literal_eval(node.value)]
    return []


def _home(module: str, name: str) -> tuple[str, str]:
    """Where a name is defined, through imports, those for type checkers included."""
    for node in ast.walk(_tree(module)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("orthoflow"):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    return _home(str(node.module), alias.name)
    return module, name


def _modules(package: str) -> list[str]:
    path = _path(package)
    if path.name != "__init__.py":
        return [package]
    names = [file.stem for file in path.parent.glob("*.py") if not file.stem.startswith("_")]
    return [package, *(f"{package}.{name}" for name in sorted(names))]


def _definitions(module: str) -> dict[str, Definition]:
    found: dict[str, Definition] = {}
    for node in _tree(module).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[node.name] = node
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            found[ast.unparse(target)] = node
    return found


def _described(name: str, node: Definition | None) -> Iterator[str]:
    if isinstance(node, ast.FunctionDef):
        yield name + _signature(node)
    elif isinstance(node, ast.ClassDef):
        bases = ", ".join(ast.unparse(base) for base in node.bases)
        yield f"{name}({bases})" if bases else name
        for item in node.body:
            if isinstance(item, ast.FunctionDef) and not item.name.startswith("_"):
                if any(ast.unparse(mark).endswith("property") for mark in item.decorator_list):
                    returns = f": {ast.unparse(item.returns)}" if item.returns else ""
                    yield f"{name}.{item.name}{returns} (property)"
                else:
                    yield f"{name}.{item.name}{_signature(item)}"
            elif isinstance(item, ast.AnnAssign) and not ast.unparse(item.target).startswith("_"):
                has_default = " = ..." if item.value is not None else ""
                annotation = ast.unparse(item.annotation)
                yield f"{name}.{ast.unparse(item.target)}: {annotation}{has_default}"
    elif isinstance(node, ast.AnnAssign):
        yield f"{name}: {ast.unparse(node.annotation)}"
    else:
        yield name


def _signature(node: ast.FunctionDef) -> str:
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    return f"({ast.unparse(node.args)}){returns}"


def main() -> int:
    """Write the record, or say what the CHANGELOG lacks."""
    now = surface()
    if RECORD.is_file():
        digest, before = recorded()
        changed = differences(before, now)
        if changed and digest == changelog_digest():
            sys.stdout.write("\n".join(changed) + "\n")
            sys.stdout.write(
                f'\nsay in CHANGELOG.md, "{SECTION}", what changed, then run {COMMAND} again' + "\n"
            )
            return 1
    head = f"# made by `{COMMAND}` with CHANGELOG section {changelog_digest()}"
    RECORD.write_text("\n".join([head, *now]) + "\n", encoding="utf-8")
    sys.stdout.write(f"wrote {RECORD.relative_to(ROOT)}: {len(now)} names" + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
