"""Where things were computed, in words, and which environments may stand in one ranking."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from orthoflow.catalog.distributions import canonical_name, required_distributions
from orthoflow.records import RecordedEnvironment
from orthoflow.records.runs import Run
from orthoflow.untrusted_text import first_few
from orthoflow.version import DISTRIBUTION


@dataclass(frozen=True, kw_only=True)
class EnvironmentGroups:
    """Which environments of some runs are one for those who compare.

    Attributes:
        first: id -> id of the first one that it is like.
        words: id of each first one -> what it is, and in what it is unlike the very first.
    """

    first: Mapping[str, str]
    words: Mapping[str, str]

    def are_comparable(self, one: str, other: str) -> bool:
        """Whether values of two environments may be compared."""
        return self.first.get(one, one) == self.first.get(other, other)


def group_environments(runs: Iterable[Run]) -> EnvironmentGroups:
    """Join the environments in which what the methods of the runs use is the same.

    Of packages those count that the methods' distributions, or this one, require; all of them
    where one of these is not installed here. What only one environment has is nothing that both
    could have used, such as a plugin that was installed between two runs.
    """
    runs = tuple(runs)
    environments = {one.id: one for run in runs for one in run.record.environments}
    named = {cell.distribution for run in runs for cell in run.record.cells} - {""}
    # Of one alone nothing has to be known.
    several = len(environments) > 1
    used = required_distributions(frozenset({*named, DISTRIBUTION})) if several else None
    first: dict[str, str] = {}
    known: dict[str, dict[str, str]] = {}
    for key, environment in environments.items():
        facts = _facts(environment, used)
        # Against all that a group has seen: of three, two may differ in what the first lacks.
        like = next((name for name, seen in known.items() if _agree(seen, facts)), key)
        first[key] = like
        known[like] = facts | known.get(like, {})
    words = distinct_words([environments[key] for key in known], used)
    return EnvironmentGroups(first=first, words=words)


def environment_words(environment: RecordedEnvironment) -> str:
    """State in one line where something was computed."""
    commit = f", code at commit {environment.git_commit}" if environment.git_commit else ""
    return (
        f"Python {environment.python}, {environment.os}, {environment.cpu}, "
        f"{environment.cores} processors, {environment.threads} threads{commit}"
    )


def distinct_words(
    environments: Sequence[RecordedEnvironment], used: Collection[str] | None = None
) -> dict[str, str]:
    """State where things were computed, with the packages in which each is unlike the first.

    Args:
        environments: in the order of the texts.
        used: the packages that count; all when not given.

    Returns:
        By id.
    """
    return {
        one.id: environment_words(one)
        + _other_packages(_packages(one, used), _packages(first, used))
        for first in environments[:1]
        for one in environments
    }


def _other_packages(own: Mapping[str, str], others: Mapping[str, str]) -> str:
    """State in which packages an environment differs from another; empty where in none."""
    texts = [f"{name} {own[name]}" for name in own if own[name] != others.get(name)]
    texts += [f"no {name}" for name in others if name not in own]
    return f"; unlike the first with {first_few(texts)}" if texts else ""


def _packages(environment: RecordedEnvironment, used: Collection[str] | None) -> dict[str, str]:
    return {
        name: version
        for name, version in environment.packages.items()
        if used is None or canonical_name(name) in used
    }


def _facts(environment: RecordedEnvironment, used: Collection[str] | None) -> dict[str, str]:
    return {"": environment_words(environment), **_packages(environment, used)}


def _agree(one: Mapping[str, str], other: Mapping[str, str]) -> bool:
    return all(one[name] == other[name] for name in one.keys() & other.keys())
