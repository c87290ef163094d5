"""Texts of drawings in the supported languages; `labels.txt` contains them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Final, Literal

Language = Literal["en", "de", "fr", "pl", "es"]
LANGUAGES: Final = ("en", "de", "fr", "pl", "es")
_TEXTS: Final = Path(__file__).with_name("labels.txt")
_NUMBERED: Final = re.compile(r"(wall|floor|ceiling) (\d+)")


@lru_cache(maxsize=1)
def _labels() -> dict[str, tuple[str, ...]]:
    rows = (
        [part.strip() for part in row.split(" | ")]
        for row in _TEXTS.read_text(encoding="utf-8").splitlines()
        if row and not row.startswith("#")
    )
    return {key: tuple(texts) for key, *texts in rows}


def label(key: str, language: Language = "en", **values: object) -> str:
    """Return a text in a language, with values filled in.

    >>> label("section", "de"), label("sheet_of", "pl", number=1, count=3)
    ('Schnitt', 'arkusz 1 z 3')
    """
    text = _labels()[key][LANGUAGES.index(language)]
    return text.format(**values) if values else text


def surface_name(name: str, language: Language = "en") -> str:
    """Translate the name of a surface in a run; other names are unchanged.

    >>> surface_name("wall 3", "fr"), surface_name("Nordwand", "fr")
    ('mur 3', 'Nordwand')
    """
    found = _NUMBERED.fullmatch(name)
    return f"{label(found[1], language)} {found[2]}" if found else name


@dataclass(frozen=True, kw_only=True)
class Phrase:
    """A statement that can be made in each language.

    Attributes:
        key: key of its text.
        values: values to fill in.
        asides: phrases in parentheses after it.
    """

    key: str
    values: Mapping[str, object] = field(default_factory=dict)
    asides: tuple[Phrase, ...] = ()

    def text(self, language: Language = "en") -> str:
        """Return the text in a language."""
        text = label(self.key, language, **self.values)
        more = ", ".join(item.text(language) for item in self.asides)
        return f"{text} ({more})" if more else text
