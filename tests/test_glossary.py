"""Documents, help, messages and names use the words of `docs/glossary.md`, not those it avoids."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import click
import pytest

from orthoflow.cli.program import program
from tests.documented import ROOT, TEXTS

GLOSSARY: Final = ROOT / "docs" / "glossary.md"
# The words of the table "Words to avoid", in all their forms.
AVOIDED: Final = {
    "say, tell, hear": r"sa(?:y|ys|id|ying)|tell(?:s|ing)?|told|hear(?:s|d|ing)?",
    "alike": r"alike",
    "foreign": r"foreign",
    "lay onto, throw onto": r"lays?|laid|laying|throws?|throw(?:n|ing)",
    "stranger": r"strangers?",
    "wish": r"wish(?:es|ed)?",
    "keeper": r"keepers?",
    "doubt": r"doubts?|doubted",
    "hang on": r"h(?:angs?|ung) (?:on|together)",
    "whoever": r"whoever",
    "anew": r"anew",
    "broken off": r"broken[ -]off|breaks? off",
}
_WORDS: Final = re.compile(rf"\b(?:{'|'.join(AVOIDED.values())})\b", re.IGNORECASE)
# Names of parameters, products and metrics are between backticks; what is quoted is shown as it is.
_CODE: Final = re.compile(r"^( *)```.*?^ *```|`[^`]*`", re.MULTILINE | re.DOTALL)
_TEMPLATE_CODE: Final = re.compile(r"\{[{%#].*?[}%#]\}|<(?:script|style).*?</|<[^>]*>", re.DOTALL)

# How many avoided words the docstrings, messages and names of a package may still hold. Numbers
# only fall; a package without one holds none.
STILL_TO_CLEAN: Final = {
    "orthoflow/cli": 9,
    "orthoflow/engine": 2,
    "orthoflow/files": 5,
    "orthoflow/geometry": 5,
    "orthoflow/products": 2,
    "orthoflow/report": 4,
    "plugins/orthoflow_plugins": 4,
    "plugins/orthoflow_plugins/inspect": 5,
    "plugins/orthoflow_plugins/mosaic": 6,
    "plugins/orthoflow_plugins/ortho": 8,
    "plugins/orthoflow_plugins/plane": 1,
    "plugins/orthoflow_plugins/raster": 5,
    "plugins/orthoflow_plugins/read": 4,
    "provenance/orthoflow_provenance": 1,
}


def _rows(heading: str) -> list[list[str]]:
    section = GLOSSARY.read_text(encoding="utf-8").partition(f"## {heading}\n")[2].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[1:]]


def test_every_term_has_one_sentence() -> None:
    terms = _rows("Terms")
    assert len(terms) > 40
    assert len({term for term, _ in terms}) == len(terms)
    for term, meaning in terms:
        assert re.fullmatch(r"(The|A|An|One|Pose|Position|What)\b[^.]*(?:\.\w[^.]*)*\.", meaning), (
            term
        )


def test_the_table_of_words_to_avoid_is_what_is_checked() -> None:
    assert [words for words, _ in _rows("Words to avoid")] == list(AVOIDED)


@pytest.mark.parametrize(
    "path",
    [
        path
        for path in (*TEXTS, ROOT / "CHANGELOG.md", *sorted((ROOT / "workflows").glob("*.yaml")))
        if path != GLOSSARY
    ],
    ids=lambda path: path.relative_to(ROOT).as_posix(),
)
def test_a_document_and_a_shipped_workflow_avoid_them(path: Path) -> None:
    text = _CODE.sub(lambda found: re.sub(r"[^\n]", "~", found[0]), path.read_text("utf-8"))
    found = [
        f"{number}: {word}"
        for number, line in enumerate(text.splitlines(), 1)
        # The rows of the papers quote them.
        if path.name != "papers.md" or not line.startswith("|")
        for word in _WORDS.findall(line)
    ]
    assert found == []


def _helps(command: click.Command, name: str) -> Iterator[tuple[str, str]]:
    yield name, command.help or ""
    yield name, command.short_help or ""
    for option in command.params:
        yield f"{name} {option.name}", getattr(option, "help", "") or ""
    if isinstance(command, click.Group):
        context = click.Context(command)
        for child in command.list_commands(context):
            found = command.get_command(context, child)
            assert found is not None
            yield from _helps(found, f"{name} {child}")


def test_the_help_of_every_command_avoids_them() -> None:
    found = [(name, word) for name, text in _helps(program, "") for word in _WORDS.findall(text)]
    assert found == []


def _texts(path: Path) -> Iterator[str]:
    """Docstrings, messages and names of a module; the text of a template."""
    text = path.read_text("utf-8")
    if path.suffix != ".py":
        yield _TEMPLATE_CODE.sub(" ", text)
        return
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield re.sub(r"`[^`]*`", "", node.value)
        elif isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield re.sub(r"(?<=[a-z0-9])(?=[A-Z])|_", " ", node.name)
        elif isinstance(node, ast.arg):
            yield node.arg.replace("_", " ")


def test_packages_lose_the_words_they_still_hold() -> None:
    counts: Counter[str] = Counter()
    for top in ("orthoflow", "plugins/orthoflow_plugins", "provenance/orthoflow_provenance"):
        for path in (ROOT / top).rglob("*"):
            if path.suffix in (".py", ".j2", ".jinja"):
                inner = path.relative_to(ROOT / top).parts
                package = f"{top}/{inner[0]}" if len(inner) > 1 else top
                counts[package] += sum(len(_WORDS.findall(text)) for text in _texts(path))
    more = {name: n for name, n in counts.items() if n > STILL_TO_CLEAN.get(name, 0)}
    assert more == {}, "more words that docs/glossary.md avoids than there were"
