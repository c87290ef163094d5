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
_NUMBER: Final = re.compile(r"[+-]?[\d,]+(\.\d+)?( \w+)?")
_SPACED: Final = str.maketrans(".,", ",\N{NO-BREAK SPACE}")
_SEPARATORS: Final = {"de": str.maketrans(".,", ",."), "fr": _SPACED, "pl": _SPACED, "es": _SPACED}


@lru_cache(maxsize=1)
def _labels() -> dict[str, tuple[str, ...]]:
    lines = _TEXTS.read_text(encoding="utf-8").splitlines()
    rows = (line.split(" | ") for line in lines if line and not line.startswith("#"))
    return {key: tuple(texts) for key, *texts in rows}


def label(key: str, language: Language = "en", **values: object) -> str:
    """Return a text in a language, with values filled in; numbers get its separators.

    >>> label("section", "de"), label("n_pairs", "de", count="1,234")
    ('Schnitt', 'Paare: 1.234')
    """
    text = _labels()[key][LANGUAGES.index(language)]
    filled = {name: numerals(str(value), language) for name, value in values.items()}
    return text.format(**filled) if values else text


def numerals(text: str, language: Language) -> str:
    """Return a number formatted by Python with the separators of a language, or another text.

    >>> numerals("+13,694.5 m", "de"), numerals("+13,694.5 m", "en"), numerals("1.2, 3", "de")
    ('+13.694,5 m', '+13,694.5 m', '1.2, 3')
    """
    return text.translate(_SEPARATORS.get(language, {})) if _NUMBER.fullmatch(text) else text


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
