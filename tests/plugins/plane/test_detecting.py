"""The search of planes one after the other: when it ends, what it tells, and its times."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.plane import detecting
from orthoflow_plugins.plane.candidates import Candidate, Rules
from orthoflow_plugins.plane.detecting import greedy_search
from orthoflow_plugins.plane.sample import Unassigned, prepare

from orthoflow.geometry import Plane
from orthoflow.products import Thickness
from tests.plane_scenes import Rectangle, cloud_of, context, sampled

# The shares of the sample are 0.5, 0.3 and 0.2.
BOX = (
    Rectangle("front", (0.0, 2.0, 0.0), (1.5, 0.0, 0.0), (0.0, 0.0, 1.0), 2_500),
    Rectangle("left", (-1.5, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 1.0), 1_500),
    Rectangle("floor", (0.0, 0.0, -1.0), (1.5, 0.0, 0.0), (0.0, 2.0, 0.0), 1_000),
)
# Far before the room, where nothing is.
NOWHERE = Candidate(
    plane=Plane(normal=np.array([0.0, 1.0, 0.0]), offset_m=-9.0), family="any", votes=1.0
)


def candidate(of: Rectangle) -> Candidate:
    plane = Plane(normal=of.normal, offset_m=float(of.normal @ np.array(of.centre)))
    return Candidate(plane=plane, family="any", votes=1.0)


FRONT, LEFT, FLOOR = (candidate(of) for of in BOX)


NAMES = {id(NOWHERE): "nowhere", id(FRONT): "front", id(LEFT): "left", id(FLOOR): "floor"}


def names_of(candidates: Iterable[Candidate]) -> list[str]:
    return [NAMES[id(candidate)] for candidate in candidates]


class Scripted:
    """Proposes what it was given, one after the other, and remembers what was rejected."""

    def __init__(self, *candidates: Candidate) -> None:
        self.left = list(candidates)
        self.rejected: list[Candidate] = []

    def propose(self, _: Unassigned) -> Candidate | None:
        return self.left.pop(0) if self.left else None

    def reject(self, candidate: Candidate) -> None:
        self.rejected.append(candidate)


def search(
    proposer: Scripted, **changes: Any
) -> tuple[list[str], Unassigned, list[tuple[float, str]]]:
    """The planes that were found, what is left of the sample, what was told."""
    rules: dict[str, Any] = {
        "find_m": 0.05,
        "fit_m": 0.015,
        "n_planes_most": 8,
        "least_share": 0.05,
        "stop_unclassified_share": 0.0,
        "tilt_most_deg": 10.0,
        "stop_rest_share": 0.0,
        "is_exact": False,
        "joins_parts": True,
    }
    cloud = prepare(cloud_of(sampled(BOX)), np.eye(3), cell_m=0.1, least_share=0.05, parts=1)
    left, told = Unassigned.of(cloud), []

    def report(share: float, text: str) -> None:
        told.append((share, text))

    found = greedy_search(left, proposer, Rules(**{**rules, **changes}), report)
    return names_of(item.candidate for item in found), left, told


def test_planes_take_their_points_in_the_order_in_which_they_are_found() -> None:
    proposer = Scripted(LEFT, NOWHERE, FRONT, FLOOR)
    found, left, told = search(proposer)
    assert found == ["left", "front", "floor"]
    assert names_of(proposer.rejected) == ["nowhere"]
    shares = np.bincount(left.claims[left.claims >= 0]) / len(left.claims)
    np.testing.assert_allclose(shares, [0.3, 0.5, 0.2], atol=0.02)
    assert told == [(1 / 8, "plane 1"), (2 / 8, "plane 2"), (3 / 8, "plane 3")]


@pytest.mark.parametrize(
    ("changes", "n_found"),
    [
        ({}, 3),
        ({"n_planes_most": 2}, 2),
        # After the front and the left one a fifth is on no plane.
        ({"stop_unclassified_share": 0.25}, 2),
        ({"stop_unclassified_share": 0.15}, 3),
        ({"stop_unclassified_share": 0.6}, 1),
        # The front one is half of all, the left one three fifths of what it leaves.
        ({"stop_rest_share": 0.55}, 0),
        ({"stop_rest_share": 0.45}, 3),
        ({"least_share": 0.35}, 1),
    ],
)
def test_a_search_ends_where_its_rules_say(changes: dict[str, Any], n_found: int) -> None:
    found, _, _ = search(Scripted(FRONT, LEFT, FLOOR), **changes)
    assert found == ["front", "left", "floor"][:n_found]


@pytest.mark.parametrize(("n_wrong", "n_found"), [(29, 2), (30, 1)])
def test_after_thirty_wrong_candidates_in_a_row_the_search_ends(n_wrong: int, n_found: int) -> None:
    # A plane in between begins the row anew.
    proposer = Scripted(*[NOWHERE] * 20, FRONT, *[NOWHERE] * n_wrong, LEFT)
    found, _, _ = search(proposer)
    assert found == ["front", "left"][:n_found]


# --- what is reported ---


@pytest.mark.parametrize(
    ("passed_s", "following"),
    [
        ([(2.0, 1.5), (0.5, 0.25)], None),
        ([(2.0, 1.5), (1.0, 0.75), (3.0, 2.25), (0.5, 0.25)], (2.0, 1.5)),
    ],
    ids=["one plane", "three"],
)
def test_times_are_of_the_first_plane_of_each_further_one_and_of_all(
    tmp_path: Path, passed_s: Sequence[tuple[float, float]], following: tuple[float, float] | None
) -> None:
    ctx = context(tmp_path)
    detecting._report_times(ctx, np.array(passed_s))
    told = {metric.name: metric.value for metric in ctx.metrics}
    by_clock, by_processor = (sum(values) for values in zip(*passed_s, strict=True))
    assert (told["detection_s"], told["detection_cpu_s"]) == (by_clock, by_processor)
    assert (told["first_plane_s"], told["first_plane_cpu_s"]) == (2.0, 1.5)
    further = (told.get("next_plane_s"), told.get("next_plane_cpu_s"))
    assert further == (following or (None, None))
    assert {metric.unit for metric in ctx.metrics} == {"s"}


def test_thickness_is_of_the_first_plane_and_of_the_thickest(tmp_path: Path) -> None:
    thin = Thickness(sigma_m=0.001, width_95_m=0.004, scan_step_m=0.005)
    thick = Thickness(sigma_m=0.003, width_95_m=0.012, scan_step_m=0.006)
    ctx = context(tmp_path)
    detecting._report_thickness(ctx, (thin, None, thick))
    assert {metric.name: metric.value for metric in ctx.metrics} == pytest.approx(
        {
            "thickest_mm": 3.0,
            "thickness_mm": 1.0,
            "thickness_width_mm": 4.0,
            "scan_step_mm": 5.0,
            "thickness_scan_steps": 0.2,
        }
    )
    bare = context(tmp_path)
    detecting._report_thickness(bare, (None, thick))
    assert [metric.name for metric in bare.metrics] == ["thickest_mm"]
    detecting._report_thickness(bare, (None,))
    assert len(bare.metrics) == 1
