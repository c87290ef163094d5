"""The commands that stand in the documents, each taken to the program that it calls.

A command stands in a block (fenced without a language or as `sh`, or indented) or between
backticks. Words in capitals are a reader's own (`RUN`, `FOLDER`), as is what stands for more
(`...`). A name alone (`orthoflow replay`) is a mention: it only has to exist.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from textwrap import dedent
from typing import Any, Final

import click

from orthoflow.cli.program import program

ROOT: Final = Path(__file__).resolve().parents[1]
TEXTS: Final = sorted(
    [
        *(path for path in ROOT.glob("*.md") if path.name != "CHANGELOG.md"),
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "examples").glob("*/*.md"),
        ROOT / "plugins" / "README.md",
        ROOT / "provenance" / "SPEC.md",
    ]
)

_FENCED: Final = re.compile(r"^( *)```(\w*)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
_INDENTED: Final = re.compile(r"(?:\A|\n\n)((?:    .*\n)+)")
_INLINE: Final = re.compile(r"`([^`]+)`")
# What begins a command between backticks.
_PROGRAMS: Final = ("orthoflow", "python", "pip", "pytest", "dask", "ORTHOFLOW_LONG_TESTS=1")
# A block without a language, or indented, that holds such a line is one of commands.
_COMMAND: Final = re.compile(
    r"^ *(?:orthoflow|python3?|pip|pytest|dask|ruff|RUN|chroot) \S", re.MULTILINE
)


@dataclass(frozen=True)
class Documented:
    """A command of a document.

    Attributes:
        path: of the document, below the checkout.
        words: of the command, without what is redirected.
        text: as it stands there, in one line.
        is_block: whether it stands in a block, to be typed as it is.
    """

    path: str
    words: tuple[str, ...]
    text: str
    is_block: bool

    def __str__(self) -> str:
        return f"{self.path}: {self.text}"


@cache
def documented_commands() -> tuple[Documented, ...]:
    """All commands of all documents, in their order."""
    return tuple(command for path in TEXTS for command in commands_of(path))


def commands_of(path: Path) -> Iterator[Documented]:
    """The commands of one document: those of its blocks, then those between backticks."""
    text = path.read_text()
    name = path.relative_to(ROOT).as_posix()
    found = [
        (match.start(), match[3])
        for match in _FENCED.finditer(text)
        if match[2] == "sh" or (not match[2] and _COMMAND.search(match[3]))
    ]
    # Kept as long as it is, so that places stay.
    prose = _FENCED.sub(lambda match: re.sub(r"[^\n]", "~", match[0]), text)
    found += [
        (match.start(), match[1])
        for match in _INDENTED.finditer(prose)
        if _COMMAND.search(match[1])
    ]
    for _, block in sorted(found):
        for line in re.sub(r"\\\n *", " ", block).splitlines():
            yield from _split(name, line.strip(), is_block=True)
    for match in _INLINE.finditer(_INDENTED.sub("\n", prose)):
        inline = re.sub(r"\s+", " ", match[1])
        if inline.split(" ")[0] in _PROGRAMS and " " in inline and ": " not in inline:
            yield from _split(name, inline, is_block=False)


def _split(path: str, line: str, *, is_block: bool) -> Iterator[Documented]:
    """Take a line to its commands: parted by `&&` and `|`, without comment and redirection."""
    if not line:
        return
    lexer = shlex.shlex(line, posix=True, punctuation_chars="&|<>")
    lexer.whitespace_split = True
    words: list[str] = []
    for word in [*lexer, "&&"]:
        if word not in ("&&", "|"):
            words.append(word)
            continue
        plain = words[: words.index(">")] if ">" in words else words
        while plain and re.match(r"[A-Z_]+=", plain[0]):
            plain = plain[1:]
        if plain:
            yield Documented(path, tuple(plain), " ".join(words), is_block)
        words = []


# Any: values of parameters.
def called(words: Sequence[str]) -> dict[str, Any]:
    """The parameters that the program makes of the words behind `orthoflow`.

    Raises:
        UsageError: the program would refuse them.
    """
    command: click.Command = program
    context = click.Context(program, info_name="orthoflow", **program.context_settings)
    # What is left open or for a reader to choose.
    filled = {"N": "1", "FORMAT": "csv", "...": ""}
    bare = (word.strip("[]") for word in words)
    rest = [word for word in (filled.get(word, word) for word in bare) if word]
    while isinstance(command, click.Group):
        name, found, rest = command.resolve_command(context, rest)
        assert found is not None
        command, context = found, click.Context(found, info_name=name)
    try:
        return command.make_context(command.name, list(rest)).params
    except click.MissingParameter:
        # A name alone is a mention.
        if rest and "..." not in words:
            raise
        return {}


def mentioned_options() -> Iterator[tuple[str, str, str]]:
    """Options that stand alone between backticks: the document, the option, the word behind it."""
    for path in TEXTS:
        prose = _FENCED.sub("", path.read_text())
        for match in _INLINE.finditer(prose):
            found = re.match(r"(--[a-z][a-z-]*)(?:[ =](\S+))?", re.sub(r"\s+", " ", match[1]))
            if found is not None:
                yield path.relative_to(ROOT).as_posix(), found[1], found[2] or ""


def blocks(path: Path, language: str, start: str = "") -> list[str]:
    """The fenced blocks of a document in a language, those that begin with some words."""
    found = [match[3] for match in _FENCED.finditer(path.read_text()) if match[2] == language]
    return [block for block in map(dedent, found) if block.startswith(start)]


def written_files() -> dict[str, str]:
    """Files that documents show in full, by the names that their commands use."""
    (rooms,) = blocks(ROOT / "docs" / "own-data.md", "", "name,scan,photos")
    comparing = ROOT / "docs" / "comparing.md"
    (detectors,) = blocks(comparing, "yaml", "orthoflow:")
    (fine,) = blocks(comparing, "yaml", "plane.")
    return {"rooms.csv": rooms, "detectors.yaml": detectors, "fine.yaml": fine}
