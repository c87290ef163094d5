"""The title block of a sheet, as an office writes it in a YAML file.

```yaml
layout: strip            # along the lower edge; column: on the right; without it what wastes less
logo: logo.png           # PNG or JPEG, beside this file
project: Palace, western hall
drawing: 21-017
date: 2026-03-14
fields: {Order: 4711, Phase: survey}
revisions:
  - {mark: A, date: 2026-03-20, text: openings added, by: KN}
```
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from orthoflow.errors import InputError
from orthoflow.files.documents import read_model
from orthoflow.files.images import decode_image
from orthoflow.untrusted_text import open_file, reading, text_of_file

#: bytes of the title block of sheets
MOST_BYTES: Final = 100_000
#: characters of one of its fields
MOST_LETTERS: Final = 300
_MOST_LOGO_BYTES: Final = 4_000_000


def _checked_text(value: object) -> object:
    """Convert numbers to text, and refuse text that does not fit on a sheet."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        value = str(value)
    if isinstance(value, str) and len(value) > MOST_LETTERS:
        raise ValueError(f"has {len(value)} letters, at most {MOST_LETTERS} fit on a sheet")
    return value


_Text = Annotated[str, BeforeValidator(_checked_text)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Revision(_Model):
    """A row of the table of revisions."""

    mark: _Text
    date: _Text = ""
    text: _Text = ""
    by: _Text = ""


class TitleBlock(_Model):
    """The content of the title block; empty fields are omitted.

    Attributes:
        layout: its position; None for the one that wastes less paper.
        logo: PNG or JPEG of the office, beside the YAML file.
        project: what is surveyed.
        title: title of the drawing, instead of the name of the wall.
        site: its location.
        client: the client.
        organisation: the organisation responsible for the drawing.
        author: the author.
        checked_by: the person who checked it.
        date: date of the drawing.
        drawing: its number, followed by the numbers of wall and sheet.
        revision: its state; by default the mark of the last of the revisions.
        note: anything else.
        fields: further fields of the client, by name.
        revisions: the oldest first.
    """

    layout: Literal["column", "strip"] | None = None
    logo: Path | None = None
    project: _Text = ""
    title: _Text = ""
    site: _Text = ""
    client: _Text = ""
    organisation: _Text = ""
    author: _Text = ""
    checked_by: _Text = ""
    date: _Text = ""
    drawing: _Text = ""
    revision: _Text = ""
    note: _Text = ""
    fields: Annotated[dict[_Text, _Text], Field(max_length=12)] = {}
    revisions: Annotated[tuple[Revision, ...], Field(max_length=12)] = ()


def read_title_block(path: Path) -> TitleBlock:
    """Read a title block.

    Raises:
        InputError: the file cannot be read, or has other content; one sentence, about the first
            place.
    """
    text = text_of_file(path, MOST_BYTES, "a title block (YAML)")
    block, problems = read_model(text, TitleBlock)
    if block is None:
        position, message = problems[0]
        raise InputError(f"{path.name}:{position.line}:{position.column}: {message}")
    if block.logo is None:
        return block
    logo = path.parent / block.logo
    with reading(logo, _MOST_LOGO_BYTES, "a logo (PNG or JPEG)"), open_file(logo) as stream:
        decode_image(stream.read(_MOST_LOGO_BYTES), logo.name)
    return block.model_copy(update={"logo": logo})
