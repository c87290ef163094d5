"""The graph of steps: what a step is made from, what follows from it, and an order that fits.

Answered by a few lines of our own: networkx loads all its algorithms with its name, which takes two
fifths of the time of a `plan`. It is asked where a workflow has cycles (`wiring`), and only then.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter

from orthoflow.workflow.model import WorkflowStep


@dataclass(frozen=True, kw_only=True)
class StepGraph:
    """Steps and what they take products from.

    Attributes:
        upstream: step -> the steps it takes products from, in the order of the file.
    """

    upstream: Mapping[str, tuple[str, ...]]

    def ancestors(self, step: str) -> frozenset[str]:
        """All steps that a step is made from, itself left out."""
        return _reachable(step, self.upstream)

    def descendants(self, step: str) -> frozenset[str]:
        """All steps that follow from a step, itself left out."""
        return _reachable(step, self._downstream())

    def ordered(self) -> tuple[str, ...]:
        """Give each step behind all it needs, else in the order of the file.

        A step on a cycle, and what follows from it, is left out.
        """
        rank = {name: index for index, name in enumerate(self.upstream)}
        names = tuple(self.upstream)
        downstream = self._downstream()
        missing = {name: len(sources) for name, sources in self.upstream.items()}
        ready = [rank[name] for name, count in missing.items() if count == 0]
        found: list[str] = []
        while ready:
            name = names[heapq.heappop(ready)]
            found.append(name)
            for user in downstream[name]:
                missing[user] -= 1
                if missing[user] == 0:
                    heapq.heappush(ready, rank[user])
        return tuple(found)

    def _downstream(self) -> dict[str, tuple[str, ...]]:
        users: dict[str, tuple[str, ...]] = dict.fromkeys(self.upstream, ())
        for name, sources in self.upstream.items():
            for source in sources:
                users[source] += (name,)
        return users


def step_graph(steps: Mapping[str, WorkflowStep]) -> StepGraph:
    """Give the graph of checked steps."""
    return StepGraph(upstream={name: step.upstream() for name, step in steps.items()})


def is_acyclic(upstream: Mapping[str, tuple[str, ...]]) -> bool:
    """Whether no step needs itself, directly or by others.

    >>> is_acyclic({"a": (), "b": ("a",)}), is_acyclic({"a": ("b",), "b": ("a",)})
    (True, False)
    """
    try:
        TopologicalSorter(upstream).prepare()
    except CycleError:
        return False
    return True


def _reachable(start: str, edges: Mapping[str, tuple[str, ...]]) -> frozenset[str]:
    found: set[str] = set()
    waiting = list(edges[start])
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting.extend(edges[name])
    return frozenset(found)
