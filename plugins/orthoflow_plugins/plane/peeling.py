"""Greedy detection: the best plane first, its points taken away, then the best of what remains.

Shared by all detectors: a `Proposer` names candidates (an accumulator's maximum, a consensus set);
what follows is the same for each, so that methods differ in how they look, not in how they fit.
A candidate is refined on the sample, must hold crowded cells of enough points in the full cloud,
is fitted to those cells, and then claims the points near it within its rectangle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

import numpy as np

from orthoflow_plugins.plane.candidates import Candidate, FoundPlane, Rules
from orthoflow_plugins.plane.examining import examine
from orthoflow_plugins.plane.remainders import Remainder

# What the report begins with when a plane was found.
PLANE_FOUND: Final = "plane"
# Candidates in a row that turned out to be none, after which the search gives up.
_REJECTED_MOST: Final = 30


class Proposer(Protocol):
    """What a detector must do to take part."""

    def propose(self, remainder: Remainder) -> Candidate | None:
        """Name the best candidate among the points that remain, or None when there is none."""
        raise AssertionError("a protocol is never called")

    def reject(self, candidate: Candidate) -> None:
        """Hear that the last candidate was none, so as not to name it again."""
        raise AssertionError("a protocol is never called")


def find_planes(
    remainder: Remainder,
    proposer: Proposer,
    rules: Rules,
    report: Callable[[float, str], None],
) -> list[FoundPlane]:
    """Find planes one after the other until a stop rule holds.

    Args:
        remainder: the cloud; its claims are filled.
        proposer: the detector.
        rules: when a plane counts and when to stop.
        report: hears progress, 0..1.

    Returns:
        The planes in the order they were found; `remainder.claims` refers to that order.
    """
    found: list[FoundPlane] = []
    n_rejected = 0
    n_all = len(remainder.claims)
    while len(found) < rules.n_planes_most and n_rejected < _REJECTED_MOST:
        if remainder.n_unclaimed < rules.stop_unclassified_share * n_all:
            break
        candidate = proposer.propose(remainder)
        if candidate is None:
            break
        plane = examine(candidate, remainder, rules)
        if plane is None:
            proposer.reject(candidate)
            n_rejected += 1
            continue
        if plane.footprint.n_points < rules.stop_rest_share * remainder.n_unclaimed:
            break
        found.append(plane)
        n_rejected = 0
        slabs = np.array([item.raster.slab() for item in found])
        remainder.claim(slabs, plane.label_bounds(rules.find_m))
        report(len(found) / rules.n_planes_most, f"{PLANE_FOUND} {len(found)}")
    return found
