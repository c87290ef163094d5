"""The documents: commands that exist, workflows that are fine, links that lead somewhere, words "
"that are said."""

from __future__ import annotations

import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import click
import pytest

from orthoflow.catalog import Catalog, discover_catalog
from orthoflow.cli.program import program
from orthoflow.workflow import load_workflow

ROOT = Path(__file__).resolve().parents[1]
TEXTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), ROOT / "plugins" / "README.md"])
# What somebody else's program, or a reader, puts in the place of a name.
HOW_TO = ("tutorial", "own-data", "comparing", "archiving")


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return discover_catalog()


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^ *```{language}\n(.*?)^ *```", text, re.MULTILINE | re.DOTALL)


def commands(path: Path) -> Iterator[str]:
    """Every command line that begins with orthoflow in a block of a text."""
    fenced = re.compile(r"^ *```(?:sh|bash|)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
    for block in fenced.findall(path.read_text()):
        for line in block.replace("\\\n", " ").splitlines():
            for part in re.split(r"\s(?:&&|\|)\s", line):
                plain = part.partition(" # ")[0].strip()
                if re.match(r"orthoflow \S", plain):
                    yield plain


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_command_of_a_text_is_one(path: Path) -> None:
    for line in commands(path):
        words = [word for word in shlex.split(line)[1:] if not word.startswith("$")]
        command: click.Command = program
        context = click.Context(program, info_name="orthoflow")
        while isinstance(command, click.Group):
            assert words, f"{path.name}: {line} names no command"
            found = command.get_command(context, words[0])
            assert found is not None, f"{path.name}: {line}: there is no {words[0]}"
            command, words = found, words[1:]
        known = {
            name for option in command.params for name in (*option.opts, *option.secondary_opts)
        }
        used = {word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)}
        assert used <= known | {"--help"}, f"{path.name}: {line}"


@pytest.mark.parametrize("name", HOW_TO)
def test_workflows_in_the_how_tos_are_fine(name: str, catalog: Catalog, tmp_path: Path) -> None:
    text = (ROOT / "docs" / f"{name}.md").read_text()
    whole = [block for block in blocks(text, "yaml") if block.startswith("orthoflow:")]
    assert whole or name != "comparing"
    for block in whole:
        (tmp_path / "a.yaml").write_text(block)
        load_workflow(tmp_path / "a.yaml", catalog)
        for part in (part for part in blocks(text, "yaml") if part.startswith("datasets:")):
            (tmp_path / "b.yaml").write_text(block + part)
            load_workflow(tmp_path / "b.yaml", catalog)


def test_words_of_messages_are_said_somewhere() -> None:
    text = (ROOT / "docs" / "troubleshooting.md").read_text()
    table = [line for line in text.splitlines() if line.startswith("| `")]
    assert len(table) > 12
    sources = "".join(
        re.sub(r'["\']\s*\n\s*f?["\']', "", path.read_text())
        for folder in ("orthoflow", "plugins", "provenance")
        for path in (ROOT / folder).rglob("*.py")
    )
    for line in table:
        for words in re.findall(r"`([^`]+)`", line.split("|")[1]):
            assert words in sources or words == "No space left on device", words


def site() -> ModuleType:
    spec = importlib.util.spec_from_file_location("website", ROOT / "docs" / "website.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_reference_has_every_method_product_metric_and_command(
    catalog: Catalog, tmp_path: Path
) -> None:
    site().written(tmp_path)
    pages = {path.stem: path.read_text() for path in (tmp_path / "reference").glob("*.md")}
    assert {name for name in catalog.methods if f"### {name}\n" not in pages["methods"]} == set()
    assert {name for name in catalog.products if f"## {name}\n" not in pages["products"]} == set()
    assert (
        "| `rmse_[uv]_mm` | error along u (right), RMS | mm | less is better |" in pages["metrics"]
    )
    assert "## orthoflow plugins new\n" in pages["commands"]
    assert "_ORTHOFLOW_COMPLETE=bash_source" in pages["commands"]
    # Nothing leads out of the site but to the web.
    for page in tmp_path.rglob("*.md"):
        for link in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
            assert "://" in link or (page.parent / link).exists(), (page.name, link)
