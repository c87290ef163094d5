"""The graph of steps answers as networkx does, on graphs drawn by chance."""

from __future__ import annotations

import random

import networkx as nx
import pytest

from orthoflow.workflow.graphs import StepGraph, is_acyclic


def drawn(seed: int, *, is_looped: bool = False) -> StepGraph:
    """Up to twelve steps in any order of the file, an edge between any two by chance."""
    rng = random.Random(seed)
    names = [f"step{index}" for index in range(rng.randint(1, 12))]
    hidden = rng.sample(names, len(names))
    upstream = {
        name: tuple(
            source
            for source in rng.sample(names, len(names))
            if rng.random() < 0.3 and (is_looped or hidden.index(source) < hidden.index(name))
        )
        for name in names
    }
    return StepGraph(upstream=upstream)


def reference(graph: StepGraph) -> nx.DiGraph[str]:
    found: nx.DiGraph[str] = nx.DiGraph()
    found.add_nodes_from(graph.upstream)
    found.add_edges_from((a, b) for b, sources in graph.upstream.items() for a in sources)
    return found


@pytest.mark.parametrize("seed", range(40))
def test_relations_and_order_are_those_of_networkx(seed: int) -> None:
    graph = drawn(seed)
    known = reference(graph)
    rank = {name: index for index, name in enumerate(graph.upstream)}
    expected = nx.lexicographical_topological_sort(known, key=rank.__getitem__)
    assert graph.ordered() == tuple(expected)
    for name in graph.upstream:
        assert graph.ancestors(name) == nx.ancestors(known, name)
        assert graph.descendants(name) == nx.descendants(known, name)


@pytest.mark.parametrize("seed", range(40))
def test_cycles_are_noticed(seed: int) -> None:
    graph = drawn(seed, is_looped=True)
    assert is_acyclic(graph.upstream) is nx.is_directed_acyclic_graph(reference(graph))
