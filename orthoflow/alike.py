"""Puts together what is said of many things in the same words: four causes are four lines."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

_MOST_NAMED: Final = 3
# What differs from thing to thing: quoted names, names of files, words and amounts with a digit.
_VARYING: Final = re.compile(
    r"""
    (?<![^\s,;:()\[\]])     # a word begins here: a search from each letter would take long
    (?:
        "[^"]*" | '[^'\s][^']*' | `[^`]*`
        | (?:wall|floor|ceiling)\ \d+ | (?:floor|ceiling)(?=:)
        | [^\s,;:()\[\]\d]*\d[^\s,;:()\[\]]*
        | [^\s,;:()\[\]]+\.[A-Za-z][A-Za-z0-9]{1,4}\b
    )
    """,
    re.VERBOSE,
)
_NUMBER: Final = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?%?", re.ASCII)
_MARK: Final = "\0"
# A list of them is one: a photo, or two and three more.
_MARKS: Final = re.compile(
    rf"\[?{_MARK}(?:(?:, | and |,? or | of |/| ){_MARK}| \.\.\.| more\b)*\]?"
)
_FOREMOST: Final = "stand on their heads"
# Words of sentences that say what one can do.
_ADVICE: Final = re.compile(
    r"\b(?:set|give|check|measure|choose|turn|lower|raise|free|repeat|helps?|need(?:s|ed)?|instead)\b|--\w",
    re.IGNORECASE,
)


@dataclass(frozen=True, kw_only=True)
class Alike:
    """Sentences of one sense.

    Attributes:
        text: the first of them; with their lowest and highest numbers where no names differ.
        others: what stands in the others where the first has its name, each once, in their order.
        count: how many there are.
        places: who said it, each once, in their order; cells of a run, say.
    """

    text: str
    others: tuple[str, ...]
    count: int
    places: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """The first of them, how many there are, and the names of a few others.

        >>> alike([("ties", f"photo {name}.jpg: no wall is recognised") for name in "abcdef"])[
        ...     0
        ... ].sentence
        'photo a.jpg: no wall is recognised (6 times; also b.jpg, c.jpg, d.jpg and 2 more)'
        """
        if self.count == len(self.places) and not self.others:
            return self.text
        named = first_few(self.others)
        return f"{self.text} ({self.count} times{'; also ' if named else ''}{named})"

    @property
    def is_foremost(self) -> bool:
        """Whether it makes every picture wrong, however good the rest is."""
        return _FOREMOST in self.text

    @property
    def is_advice(self) -> bool:
        """Whether it says what one can do."""
        return _ADVICE.search(self.text) is not None

    @property
    def where(self) -> str:
        """The first of the places, and how many more there are."""
        return first_few(self.places, most=1)


def alike(said: Iterable[tuple[str, str]]) -> tuple[Alike, ...]:
    """Put sentences together that differ only in names and numbers.

    >>> said = [("check#1", "none of 5 planes"), ("check#2", "none of 12 planes")]
    >>> alike(said)[0].sentence
    'none of 5 to 12 planes'

    Args:
        said: place and sentence, in the order in which they were said.

    Returns:
        One entry per sense: first those that say what one can do, then those said most often, then
        in the order of `said`.
    """
    groups: dict[str, list[tuple[str, str]]] = {}
    for place, text in said:
        groups.setdefault(sense(text), []).append((place, text))
    found = [_together(group) for group in groups.values()]
    return tuple(
        sorted(found, key=lambda item: (not item.is_foremost, not item.is_advice, -item.count))
    )


def sense(text: str) -> str:
    """What is left of a sentence without names and numbers; alike sentences have the same.

    >>> sense("photo a.jpg: 3 ties") == sense("photo b.jpg: 17 ties")
    True
    >>> sense("photo a.jpg: no wall") == sense("photo a.jpg: no plane")
    False
    """
    return _MARKS.sub(_MARK, _VARYING.sub(_MARK, text.replace(_MARK, "")))


def first_few(names: Sequence[str], most: int = _MOST_NAMED) -> str:
    """Name the first few, and count the others.

    >>> first_few(["a", "b", "c", "d", "e"]), first_few(["a", "b"], most=1)
    ('a, b, c and 2 more', 'a and 1 more')
    """
    n_more = len(names) - most
    named = ", ".join(names[:most])
    return f"{named} and {n_more} more" if n_more > 0 else named


def _together(group: Sequence[tuple[str, str]]) -> Alike:
    first = group[0][1]
    # Sentences of one sense have equally many varying parts.
    columns = list(zip(*(_parts(text) for _, text in group), strict=True))
    names = next(
        (part for part in columns if len(set(part)) > 1 and not all(map(_NUMBER.fullmatch, part))),
        (),
    )
    # A count alone would not say what it is of: without names, amounts stand in their places.
    return Alike(
        text=first if names else _filled(sense(first), [_amounts(part) for part in columns]),
        others=tuple(name for name in dict.fromkeys(names) if name != names[0]),
        count=len(group),
        places=tuple(dict.fromkeys(place for place, _ in group)),
    )


def _amounts(numbers: Sequence[str]) -> str:
    """The lowest and the highest, where they differ."""
    if len(set(numbers)) == 1:
        return numbers[0]
    in_order = sorted(numbers, key=lambda number: float(number.rstrip("%")))
    return f"{in_order[0]} to {in_order[-1]}"


def _parts(text: str) -> tuple[str, ...]:
    """The varying parts of a sentence, a list as one."""
    names = _VARYING.findall(text.replace(_MARK, ""))
    marked = _VARYING.sub(_MARK, text.replace(_MARK, ""))
    found, n_taken = [], 0
    for match in _MARKS.finditer(marked):
        n_names = match[0].count(_MARK)
        found.append(_filled(match[0], names[n_taken : n_taken + n_names]))
        n_taken += n_names
    return tuple(found)


def _filled(marked: str, parts: Sequence[str]) -> str:
    """Put parts in the places of the marks."""
    between = marked.split(_MARK)
    ends = zip(parts, between[1:], strict=True)
    return "".join([between[0], *(piece for part, after in ends for piece in (part, after))])
