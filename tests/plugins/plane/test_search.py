"""What becomes of candidates: refined, refused by a criterion, claimed, fitted, labelled."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.detector import Candidate, Constraint
from orthoflow_plugins.plane.fit import FoundPlane
from orthoflow_plugins.plane.search import (
    Search,
    find_planes,
    fit_to_all,
    greedy_search,
    label,
    verify,
)

from orthoflow.geometry import Plane, angle_between_deg
from tests.plane_scenes import (
    ROOM,
    TOLERANCE_M,
    Rectangle,
    prepared,
    sampled,
    search_in,
)

ALONG_Y = (0.0, 1.0, 0.0)
FAR = Rectangle("far", (0, 9, 0), (2, 0, 0), (0, 1, 1), 6_000)
WEST = Rectangle("west", (-2, 0, 0), (0, 2, 0), (0, 0, 1), 10_000)


def proposed(
    normal: tuple[float, float, float], offset_m: float, constraint: Constraint = "any"
) -> Candidate:
    unit = np.array(normal) / np.linalg.norm(normal)
    return Candidate(plane=Plane(normal=unit, offset_m=offset_m), constraint=constraint, votes=1.0)


def surface(truth: Rectangle) -> Candidate:
    return proposed(tuple(truth.normal), float(truth.normal @ np.array(truth.centre)))


def wall(n_points: int = 8_000, *, half_m: tuple[float, float] = (2.0, 1.0)) -> Rectangle:
    """At y = 2, upright."""
    return Rectangle("wall", (0, 2, 0), (half_m[0], 0, 0), (0, 0, half_m[1]), n_points)


def barrel(radius_m: float) -> NDArray[np.float64]:
    """Half a metre of arc of an upright cylinder whose nearest line is at y = 2."""
    rng = np.random.default_rng(2)
    turn = rng.uniform(-0.6, 0.6, 8_000) / radius_m
    x, y = radius_m * np.sin(turn), 2.0 + radius_m * (1.0 - np.cos(turn))
    return np.column_stack([x, y + rng.normal(0.0, 0.001, 8_000), rng.uniform(-1.0, 1.0, 8_000)])


def filled_slab() -> NDArray[np.float64]:
    return np.random.default_rng(3).uniform([-2.0, 1.8, -1.0], [2.0, 2.2, 1.0], (8_000, 3))


STOOL = Rectangle("stool", (1, -0.5, -0.7), (0.25, 0, 0), (0, 0.25, 0), 2_500)
RAMP = Rectangle("ramp", (0, 2, 0), (2, 0, 0), (0, 0.3, 1), 8_000)


def crowd_in_a_slab() -> NDArray[np.float64]:
    """A slab filled evenly whose middle third is a wall."""
    rng = np.random.default_rng(4)
    thin = rng.uniform([-0.7, 1.999, -1.0], [0.7, 2.001, 1.0], (4_000, 3))
    corners = rng.uniform([-2.0, 1.9, -1.0], [2.0, 2.1, 1.0], (60_000, 3))
    corners = corners[np.abs(corners[:, 0]) > 0.7]
    ends = rng.uniform([-2.0, 1.999, -1.0], [2.0, 2.001, -0.85], (4_000, 3))
    return np.concatenate([thin, corners, ends])


@pytest.mark.parametrize(
    ("points", "candidate", "params", "criterion"),
    [
        (sampled((wall(), FAR)), proposed(ALONG_Y, 2.0), {"min_share": 0.7}, "few"),
        (sampled((wall(), FAR)), proposed(ALONG_Y, 5.0), {}, "scattered"),
        (filled_slab(), proposed(ALONG_Y, 2.0), {}, "scattered"),
        (sampled((wall(half_m=(2.0, 0.03)), FAR)), proposed(ALONG_Y, 2.0), {}, "strip"),
        (sampled((*ROOM[:6], STOOL)), surface(STOOL), {"min_share": 0.01}, "small"),
        (crowd_in_a_slab(), proposed(ALONG_Y, 2.0), {"min_share": 0.05}, "smear"),
        (barrel(3.0), proposed(ALONG_Y, 2.0), {}, "bent"),
        (sampled((RAMP, FAR)), proposed((0.0, 1.0, -0.25), 1.94, "vertical"), {}, "tilt"),
        (barrel(12.0), proposed(ALONG_Y, 2.0), {}, None),
    ],
    ids=["few", "none", "filled", "strip", "small", "smear", "barrel", "tilt", "wide barrel"],
)
def test_a_refusal_has_the_criterion_that_refused(
    points: NDArray[np.float64], candidate: Candidate, params: dict[str, Any], criterion: str | None
) -> None:
    search = search_in(prepared(points), **params)
    assert (verify(candidate, search) is None) == (criterion is not None)
    assert [name for name, _ in search.refusals] == ([criterion] if criterion else [])


@pytest.mark.parametrize("exact", [False, True])
def test_exact_walls_and_floors_lean_by_nothing(exact: bool) -> None:
    lean = math.radians(2.0)
    leaning = Rectangle("w", (0, 2, 0), (2, 0, 0), (0, math.sin(lean), math.cos(lean)), 8_000)
    sloping = Rectangle(
        "f", (0, 0, -2), (2, 0, 0), (0, 2 * math.cos(lean), 2 * math.sin(lean)), 8_000
    )
    search = search_in(prepared(sampled((leaning, sloping))), exact=exact)
    for truth, rise in ((leaning, 0.0), (sloping, 1.0)):
        found = verify(surface(truth), search)
        assert found is not None
        normal = found.raster.plane.normal
        away_deg = angle_between_deg(normal * np.sign(normal @ truth.normal), truth.normal)
        assert away_deg == pytest.approx(2.0 if exact else 0.0, abs=0.03)
        assert not exact or abs(normal[2]) == pytest.approx(rise, abs=1e-12)


class Listed:
    """Proposes what it is given, one after the other."""

    def __init__(self, surfaces: tuple[Rectangle, ...]) -> None:
        self._left = [surface(truth) for truth in surfaces]

    def propose(self, search: Search) -> Candidate | None:
        del search
        return self._left.pop(0) if self._left else None

    def reject(self, candidate: Candidate) -> None:
        del candidate


@pytest.mark.parametrize(
    ("params", "n_found"),
    [
        ({"min_share": 0.005}, 7),
        ({"min_share": 0.05}, 6),
        # The table has 1.6 m2, in a room whose floor has 24.
        ({"min_share": 0.005, "min_area_m2": 1.7}, 7),
        ({"min_share": 0.005, "n_planes_max": 3}, 3),
        # The four walls hold 62 % of the points; the floor, the next, 18 of the 38 % left.
        ({"min_share": 0.005, "stop_unclassified_share": 0.4}, 4),
        ({"min_share": 0.005, "stop_rest_share": 0.3}, 1),
    ],
)
def test_a_search_ends_where_its_parameters_say(params: dict[str, Any], n_found: int) -> None:
    search = search_in(prepared(sampled()), **params)
    assert len(greedy_search(search, Listed(ROOM))) == n_found


def found_walls(
    rectangles: tuple[Rectangle, ...], points: NDArray[np.float64]
) -> tuple[Search, list[FoundPlane]]:
    search = search_in(prepared(points, parts=2), min_share=0.01)
    return search, find_planes(search, Listed(rectangles))


def test_points_belong_to_the_nearest_plane_whose_rectangle_holds_them() -> None:
    walls = (wall(30_000), WEST)
    points = np.random.default_rng(1).permutation(sampled(walls))
    search, found = found_walls(walls, points)
    away_m = np.abs(np.column_stack([item.raster.plane.distances_m(points) for item in found]))
    claims = search.cloud.claims
    for k in range(2):
        alone = (away_m[:, k] < 0.049) & (away_m[:, 1 - k] > 0.051)
        assert alone.sum() > 9_000
        assert (claims[alone] == k).mean() > 0.999
    corner = (away_m < 0.049).all(axis=1) & (np.abs(away_m[:, 0] - away_m[:, 1]) > 1e-4)
    assert corner.sum() > 30
    np.testing.assert_array_equal(claims[corner], away_m[corner].argmin(axis=1))
    names, labels = np.array([7, 3, -1], dtype=np.int16), np.empty(len(points), dtype=np.int16)
    search.cloud.write_labels(names, labels)
    np.testing.assert_array_equal(labels, names[claims])
    # Planes that all points together do not support are left out.
    for share, n_left in ((0.3, 1), (0.8, 0)):
        strict = search_in(search.cloud, min_share=share)
        assert len(fit_to_all(found, strict)) == n_left
        assert {name for name, _ in strict.refusals} == {"few"}


@pytest.mark.parametrize("gap_m", [0.0, 0.8], ids=["connected", "in two parts"])
def test_a_frame_around_a_wall_leaves_the_wall_its_points(gap_m: float) -> None:
    # Its rectangle covers the wall, and its plane runs through the wall at an angle of one degree.
    lean = 0.02
    below = (-gap_m, 1.98 - 1.25 * lean, -1.25)
    frame = (
        Rectangle("side", (2.35, 1.98, 0), (0.15, 0, 0), (0, lean, 1), 6_000),
        Rectangle("below", below, (2.5, 0, 0), (0, 0.2 * lean, 0.2), 9_000),
    )
    on_wall, on_frame = sampled((wall(60_000),), noise_m=0.004), sampled(frame, noise_m=0.002)
    alone = [
        found_walls((truth,), points)[1][0]
        for truth, points in ((wall(60_000), on_wall), (frame[0], on_frame))
    ]
    search = search_in(prepared(np.concatenate([on_wall, on_frame]), parts=2), min_share=0.01)
    label(fit_to_all(alone, search), search.cloud, TOLERANCE_M)
    claims = search.cloud.claims
    assert (claims[: len(on_wall)] == 0).mean() > 0.95
    assert (claims[len(on_wall) :] == 1).mean() > 0.95
