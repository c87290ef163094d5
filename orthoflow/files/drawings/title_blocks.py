"""The title block of a sheet: what an office writes on its drawings, from a YAML file.

```yaml
project: Palace, western hall
drawing: 21-017
date: 2026-03-14
```
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Final

from orthoflow.errors import InputError
from orthoflow.files.yaml_positions import (
    Dialect,
    Position,
    Table,
    Text,
    Value,
    describe,
    read_yaml,
)
from orthoflow.foreign_text import text_of_file

MOST_BYTES: Final = 100_000
MOST_LETTERS: Final = 300
_FIRST: Final = Position(line=1, column=1)
_DIALECT: Final = Dialect(is_strict=False, empty="the title block is empty")


@dataclass(frozen=True, kw_only=True)
class TitleBlock:
    """What stands in the title block; what is empty is left out.

    Attributes:
        project: what is surveyed; the largest text of the sheet.
        title: of the drawing, in the place of the name of the wall.
        site: where it stands.
        client: for whom.
        organisation: who answers for the drawing.
        author: who drew it.
        checked_by: who looked at it.
        date: of the drawing.
        drawing: its number; the number of the sheet follows it.
        revision: its state.
        note: anything else.
    """

    project: str = ""
    title: str = ""
    site: str = ""
    client: str = ""
    organisation: str = ""
    author: str = ""
    checked_by: str = ""
    date: str = ""
    drawing: str = ""
    revision: str = ""
    note: str = ""


FIELDS: Final = tuple(item.name for item in fields(TitleBlock))


@dataclass
class _Problems:
    """Keeps what is wrong with a document."""

    found: list[tuple[Position, str]] = field(default_factory=list)

    def add(self, position: Position, path: str, message: str) -> None:
        self.found.append((position, f"{path}: {message}" if path else message))


def read_title_block(path: Path) -> TitleBlock:
    """Read a title block.

    Raises:
        InputError: the file cannot be read, or holds something else than a text per known field;
            one sentence, about the first place.
    """
    problems = _Problems()
    text = text_of_file(path, MOST_BYTES, "a title block (YAML)")
    content = read_yaml(text, problems, _DIALECT)
    values = {} if content is None else _values(content, problems)
    if problems.found:
        position, message = min(problems.found)
        raise InputError(f"{path.name}:{position.line}:{position.column}: {message}")
    return TitleBlock(**values)


def _values(content: Value, problems: _Problems) -> dict[str, str]:
    if not isinstance(content, Table):
        problems.add(
            _FIRST, "", f"expected fields of a title block such as project, got {describe(content)}"
        )
        return {}
    values = {}
    for entry in content:
        if entry.key not in FIELDS:
            near = difflib.get_close_matches(entry.key, FIELDS, n=1)
            hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(FIELDS)}"
            problems.add(entry.position, entry.key[:100], f"no field of a title block; {hint}")
        elif not isinstance(entry.value, Text) or entry.value.value is None:
            problems.add(entry.position, entry.key, f"expected a text, got {describe(entry.value)}")
        elif len(text := str(entry.value.value)) > MOST_LETTERS:
            problems.add(
                entry.position,
                entry.key,
                f"has {len(text)} letters, at most {MOST_LETTERS} fit on a sheet",
            )
        else:
            values[entry.key] = text
    return values
