"""Search for cylinders, cones and spheres among voxels, from coarse to fine.

Two normals that are not parallel give an axis, perpendicular to both, and the circle around it on
which both points lie with their normals. This combines the search for a great circle on the Gauss
sphere with the votes for a circle. Hypotheses of pairs from one surface agree with each other;
those across edges and clutter do not. The hypothesis with the most votes is fitted to all voxels
and tested. For spheres, the pair gives the centre on both normals at the same distance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from orthoflow.geometry.rows import group_sums
from orthoflow.geometry.surfaces import zero_direction
from orthoflow_plugins.surface.kernels import count_votes, near_voxels
from orthoflow_plugins.surface.rounds import Round, cross, fitted
from orthoflow_plugins.surface.voxels import Voxels, keys_of

Form = Literal["sphere", "cylinder", "cone"]

# Size of a block, in voxels. The two voxels of a pair are in the same block or in adjacent ones.
_BLOCK_VOXELS: Final = 6
# Range, in voxels, of the radii searched with one voxel size.
LEAST_RADIUS: Final = 3.5
MOST_RADIUS: Final = 30.0
# A surface found among coarse voxels is tested again among voxels of this share of its radius.
_SUITED_RADIUS: Final = 24.0
_PAIRS: Final = 30_000
_PAIRS_PER_VOXEL: Final = 4
_HYPOTHESES: Final = 1_500
_LEAST_TURN_RAD: Final = math.radians(12.0)
# Largest disagreement between hypotheses of one surface: sine of the angle between the axes, and
# shares of the radius.
_SAME_AXIS: Final = math.sin(math.radians(9.0))
_SAME_RADIUS: Final = 0.15
_SAME_PLACE: Final = 0.2
# The middle of the arc between a pair is in a voxel. The distance of its points from the arc is at
# most a share of the sagitta and of the voxel, and its normal agrees.
_MIDDLE_SHARE: Final = 0.4
_MIDDLE_SLACK: Final = 0.06
_MIDDLE_COSINE: Final = math.cos(math.radians(14.0))
_LEAST_VOTES: Final = 6
_LEAST_VOTE_SHARE: Final = 0.008
_MOST_TRIES: Final = 10
# Maximum angles between the normals of voxels and those of the surface, in the first and last
# iterations.
_NORMAL_DEG: Final = (28.0, 15.0)
_ITERATIONS: Final = 4
# A surface found among coarse voxels is near its place, so among finer ones it needs fewer.
_AGAIN_FROM: Final = 2
_LEAST_VOXELS: Final = 30
# Parts of a surface are clutter if they have fewer voxels than this share of the largest part.
_PART_SHARE: Final = 0.2
# A column of cells belongs to the arc if it is occupied over this share of the surface's length.
_OPEN_SHARE: Final = 0.15
_FILLED_LEAST: Final = 0.3
# Maximum scatter of voxels, as a share of the radius, and maximum ratio of the two curvatures.
_ROUGHEST_SHARE: Final = 0.02
_DOUBLY_CURVED: Final = 0.3
# On a curved surface, normals rotate by as much as the angle; on flat facets, they do not.
_LEAST_TURNING: Final = 0.5
_FACET_RAD: Final = (math.radians(12.0), math.radians(45.0))
_FACET_VOXELS: Final = 4.0
_SECTOR_VOXELS: Final = 8
# Flat sectors, such as walls below a vault, are ignored unless most voxels are in such sectors.
_MOST_FLAT: Final = 0.7
_STEEPEST: Final = 1.5
# Directions in which the radii of a sphere rotate by less than this share are not compared.
_LEAST_SHARE: Final = 0.1


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a search.

    Attributes:
        tolerance_m: largest distance of points from their surface.
        noise_m: standard deviation of points across surfaces.
        radius_m: smallest and largest radius.
        min_arc_rad: shortest arc.
        min_area_m2: smallest area.
        form: the form of the surfaces.
    """

    tolerance_m: float
    noise_m: float
    radius_m: tuple[float, float]
    min_arc_rad: float
    min_area_m2: float
    form: Form

    def tolerance_at(self, radius_m: float) -> float:
        """Return the tolerance for a surface; it is smaller for narrow columns."""
        return min(self.tolerance_m, 0.1 * radius_m + 3.0 * self.noise_m)


@dataclass(frozen=True, kw_only=True)
class Found:
    """A surface found among voxels.

    Attributes:
        round: the surface; its point is at the middle of the voxels along the axis.
        zero: (3,) direction of angle 0.
        side: 1 if the normals of the voxels point to the axis, -1 if they point away from it, 0 if
            their signs are arbitrary.
        is_open: (a,) bool, parts of the circle from angle -pi that have voxels.
        along_m: range along the axis, with a margin of one cell.
        evidence: values determined by the tests.
        is_earlier: whether the surface was found before, so that its ends are known.
    """

    round: Round
    zero: NDArray[np.float64]
    side: float
    is_open: NDArray[np.bool_]
    along_m: tuple[float, float]
    evidence: dict[str, float]
    is_earlier: bool = False


@dataclass(frozen=True, kw_only=True)
class Rejected:
    """A hypothesis that failed the tests: the reason, and the values determined by the tests."""

    reason: str
    evidence: dict[str, float]


def search(
    levels: list[Voxels],
    limits: Limits,
    up: NDArray[np.float64],
    rng: np.random.Generator,
    progress: Callable[[float, str], None],
    *,
    is_oriented: bool,
    earlier: list[Found],
) -> tuple[list[Found], list[Rejected]]:
    """Find surfaces in voxels of several sizes.

    Args:
        levels: voxels of several sizes, largest first.
        limits: limits of the search.
        up: (3,) unit vector.
        rng: random generator for the pairs.
        progress: receives the completed share of the work (0.2 to 0.8), and a text.
        is_oriented: whether the normals point to the viewer.
        earlier: surfaces that were found before.
    """
    found = [*earlier]
    rejected: list[Rejected] = []
    for number, voxels in enumerate(levels):
        voxel_m = voxels.size_m
        progress(0.2 + 0.6 * number / len(levels), f"voxels of {voxel_m:.2f} m")
        radii = (
            max(limits.radius_m[0], LEAST_RADIUS * voxel_m),
            min(limits.radius_m[1], MOST_RADIUS * voxel_m),
        )
        if radii[0] >= radii[1] or len(voxels) < _LEAST_VOXELS:
            continue
        is_free = np.ones(len(voxels), dtype=np.bool_)
        for item in found:
            is_free &= ~claimed(item, voxels, limits)
        guesses, ends = _hypotheses(
            voxels,
            is_free,
            radii,
            rng,
            is_oriented=is_oriented,
            is_sphere=limits.form == "sphere",
        )
        is_live = np.ones(len(guesses), dtype=np.bool_)
        for _ in range(_MOST_TRIES):
            chosen = np.flatnonzero(is_live)
            votes = np.zeros(len(chosen), dtype=np.int64)
            same_axis = 1.0 if limits.form == "sphere" else _SAME_AXIS
            count_votes(guesses[chosen], same_axis, _SAME_RADIUS, _SAME_PLACE, votes)
            least = max(_LEAST_VOTES, _LEAST_VOTE_SHARE * len(guesses))
            if not len(chosen) or votes.max() < least:
                break
            best = guesses[chosen[int(np.argmax(votes))]]
            agree = chosen[_agreeing(guesses[chosen], best)]
            free = voxels.take(is_free)
            result = _tested(_mean_of(guesses[agree], best), free, limits, up)
            is_live[agree] = False
            if isinstance(result, Found):
                small = _suited(levels, result.round.radius_m)
                if small.size_m < voxel_m:
                    start = result.round, result.side
                    result = _tested(start, small, limits, up, first_step=_AGAIN_FROM)
            if isinstance(result, Found) and any(_is_fringe(result, item) for item in found):
                result = Rejected(reason="part of another surface", evidence=result.evidence)
            if isinstance(result, Rejected):
                rejected.append(result)
                continue
            found.append(result)
            is_free &= ~claimed(result, voxels, limits)
            is_live &= is_free[ends].all(axis=1)
    return found[len(earlier) :], rejected


def _suited(levels: list[Voxels], radius_m: float) -> Voxels:
    """Return the largest voxels that are small relative to a radius, otherwise the smallest."""
    return next((it for it in levels if it.size_m <= radius_m / _SUITED_RADIUS), levels[-1])


def _is_fringe(new: Found, old: Found) -> bool:
    """Return whether a surface consists of noise or relief near another one of the same form."""
    is_sphere = new.round.is_sphere
    if (is_sphere, new.round.slope != 0.0) != (old.round.is_sphere, old.round.slope != 0.0):
        return False
    row = [np.append(item.round.point, item.round.axis * (not is_sphere)) for item in (new, old)]
    ends = [np.append(item.round.radius_m, item.side) for item in (new, old)]
    one, other = (np.concatenate(pair) for pair in zip(row, ends, strict=True))
    along_m = float((new.round.point - old.round.point) @ old.round.axis)
    is_beside = (
        along_m + new.along_m[1] < old.along_m[0] or along_m + new.along_m[0] > old.along_m[1]
    )
    return bool(_agreeing(one[None], other)[0]) and (is_sphere or not is_beside)


def claimed(found: Found, voxels: Voxels, limits: Limits) -> NDArray[np.bool_]:
    """Return a mask (v,) of the voxels on a surface."""
    near = np.empty(len(voxels), dtype=np.int64)
    within = np.array([1.5 * limits.tolerance_at(found.round.radius_m), -1.0])
    row = found.round.row(found.zero)
    near = near[: near_voxels(row, 0.0, voxels.points, voxels.normals, within, near)]
    angles, along = found.round.places(voxels.points[near], found.zero)
    n_around = len(found.is_open)
    column = np.minimum(((angles / (2.0 * math.pi) + 0.5) * n_around).astype(int), n_around - 1)
    low, high = found.along_m
    margin = 0.0 if found.is_earlier else 0.1 * (high - low)
    is_on = np.zeros(len(voxels), dtype=np.bool_)
    is_on[near] = found.is_open[column] & (along > low - margin) & (along < high + margin)
    return is_on


def _hypotheses(
    voxels: Voxels,
    is_free: NDArray[np.bool_],
    radii: tuple[float, float],
    rng: np.random.Generator,
    *,
    is_oriented: bool,
    is_sphere: bool,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return hypotheses (h, 8) of pairs of voxels (see `count_votes`), and the pairs (h, 2)."""
    first, second = _pairs(voxels, np.flatnonzero(is_free), rng)
    n, m = voxels.normals[first], voxels.normals[second]
    is_turned = np.abs(np.einsum("ij,ij->i", n, m)) < math.cos(_LEAST_TURN_RAD)
    first, second, n, m = first[is_turned], second[is_turned], n[is_turned], m[is_turned]
    p, q = voxels.points[first], voxels.points[second]
    chord = q - p
    if not is_oriented:
        # The signs of the normals are arbitrary. Normals of a circle are symmetric about the chord.
        outwards = np.sign(np.einsum("ij,ij->i", n, chord))
        inwards = np.sign(np.einsum("ij,ij->i", m, chord))
        m = m * np.where(outwards == inwards, -1.0, 1.0)[:, None]
        flip = np.where(outwards < 0.0, -1.0, 1.0)[:, None]
        n, m = n * flip, m * flip
    axis = np.cross(n, m)
    axis *= (not is_sphere) / np.linalg.norm(axis, axis=1, keepdims=True)
    along = np.einsum("ij,ij->i", chord, axis)
    chord -= along[:, None] * axis
    turn = m - n
    reach = -np.einsum("ij,ij->i", chord, turn) / np.einsum("ij,ij->i", turn, turn)
    miss = np.linalg.norm(chord + reach[:, None] * turn, axis=1)
    radius = np.abs(reach)
    keep = (radius > radii[0]) & (radius < radii[1]) & (miss < 0.1 * radius + 0.5 * voxels.size_m)
    kept = rng.permutation(np.flatnonzero(keep))
    towards = np.where(reach > 0.0, 1.0, -1.0)
    side = towards if is_oriented else np.zeros(len(reach))
    centre = p + reach[:, None] * n
    guesses = np.column_stack([centre, axis, radius, side])[kept]
    sagittas = radius[kept] * (1.0 - np.sqrt(0.5 + 0.5 * np.einsum("ij,ij->i", n, m)[kept]))
    middles = -(n + m)[kept] * towards[kept, None]
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    places = centre[kept] + radius[kept, None] * middles + 0.5 * along[kept, None] * axis[kept]
    largest = _MIDDLE_SHARE * sagittas + _MIDDLE_SLACK * voxels.size_m
    parts: list[NDArray[np.int64]] = []
    for start in range(0, len(kept), _HYPOTHESES):
        if sum(map(len, parts)) >= _HYPOTHESES:
            break
        part = slice(start, start + _HYPOTHESES)
        own = guesses[part], places[part], middles[part], largest[part]
        parts.append(start + np.flatnonzero(_have_middles(*own, voxels)))
    sure = np.concatenate([np.zeros(0, dtype=np.int64), *parts])[:_HYPOTHESES]
    ends = np.column_stack([first, second])[kept]
    return np.ascontiguousarray(guesses[sure]), ends[sure]


def _have_middles(
    guesses: NDArray[np.float64],
    places: NDArray[np.float64],
    outwards: NDArray[np.float64],
    largest: NDArray[np.float64],
    voxels: Voxels,
) -> NDArray[np.bool_]:
    """Return a mask (h,) of hypotheses with a voxel in the middle of the arc between their pair.

    If the two voxels are on different walls, there is no voxel there.

    Args:
        guesses: (h, 8) hypotheses.
        places: (h, 3) middles of the arcs.
        outwards: (h, 3) directions of the radii there.
        largest: (h,) largest distance of the voxel from the circle.
        voxels: all voxels.
    """
    nearest = voxels.at(places)
    relative = voxels.points[nearest] - guesses[:, :3]
    axis, radius = guesses[:, 3:6], guesses[:, 6]
    relative -= np.einsum("ij,ij->i", relative, axis)[:, None] * axis
    off = np.abs(np.linalg.norm(relative, axis=1) - radius)
    cosine = np.abs(np.einsum("ij,ij->i", voxels.normals[nearest], outwards))
    return np.asarray((nearest >= 0) & (off < largest) & (cosine > _MIDDLE_COSINE))


def _pairs(
    voxels: Voxels, free: NDArray[np.int64], rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Draw pairs of voxels in the same block or in adjacent ones."""
    keys = keys_of(voxels.places[free] // _BLOCK_VOXELS + 1)
    order = np.argsort(keys, kind="stable")
    starts = np.append(np.flatnonzero(np.diff(keys[order], prepend=-1)), len(keys))
    blocks = keys[order[starts[:-1]]]
    # Memory is read faster in order.
    seeds = np.sort(rng.integers(0, max(1, len(free)), min(_PAIRS, _PAIRS_PER_VOXEL * len(free))))
    wanted = keys[seeds] + keys_of(rng.integers(-1, 2, (len(seeds), 3)))
    block = np.minimum(np.searchsorted(blocks, wanted), len(blocks) - 1)
    start, end = starts[block], np.where(blocks[block] == wanted, starts[block + 1], 0)
    place = start + (rng.random(len(seeds)) * (end - start)).astype(np.int64)
    keep = (end > start) & (order[np.minimum(place, len(order) - 1)] != seeds)
    return free[seeds[keep]], free[order[place[keep]]]


def _agreeing(guesses: NDArray[np.float64], best: NDArray[np.float64]) -> NDArray[np.bool_]:
    radius = np.maximum(guesses[:, 6], best[6])
    apart = guesses[:, :3] - best[:3]
    along = apart @ best[3:6]
    miss = np.linalg.norm(apart - along[:, None] * best[3:6], axis=1)
    cosine = np.abs(guesses[:, 3:6] @ best[3:6])
    is_sphere = not best[3:6].any()
    return np.asarray(
        (np.abs(guesses[:, 6] - best[6]) <= _SAME_RADIUS * radius)
        & (guesses[:, 7] == best[7])
        & (is_sphere | (1.0 - cosine**2 <= _SAME_AXIS**2))
        & (miss <= _SAME_PLACE * radius)
    )


def _mean_of(guesses: NDArray[np.float64], best: NDArray[np.float64]) -> tuple[Round, float]:
    """Return the mean surface of hypotheses, and their side."""
    signs = np.where(guesses[:, 3:6] @ best[3:6] < 0.0, -1.0, 1.0)
    axis = (guesses[:, 3:6] * signs[:, None]).mean(axis=0)
    is_sphere = not axis.any()
    mean = Round(
        point=np.median(guesses[:, :3], axis=0),
        # The direction to the middle of a sphere's points is not known yet.
        axis=np.eye(3)[2] if is_sphere else axis / np.linalg.norm(axis),
        radius_m=float(np.median(guesses[:, 6])),
        is_sphere=is_sphere,
    )
    return mean, float(best[7])


def _tested(
    start: tuple[Round, float],
    voxels: Voxels,
    limits: Limits,
    up: NDArray[np.float64],
    *,
    first_step: int = 0,
) -> Found | Rejected:
    """Fit a surface to voxels and test it."""
    found, side = start
    last_m = limits.tolerance_at(found.radius_m)
    first_m = max(2.0 * last_m, 0.15 * found.radius_m)
    evidence: dict[str, float] = {"radius_m": found.radius_m}
    near = np.empty(len(voxels), dtype=np.int64)
    for step in range(first_step, _ITERATIONS + 1):
        share = min(1.0, step / (_ITERATIONS - 1))
        within_m = first_m ** (1.0 - share) * last_m**share
        angle_deg = _NORMAL_DEG[0] + share * (_NORMAL_DEG[1] - _NORMAL_DEG[0])
        zero = zero_direction(found.axis, up)
        limits_on = np.array([within_m, math.cos(math.radians(angle_deg))])
        count = near_voxels(found.row(zero), side, voxels.points, voxels.normals, limits_on, near)
        on = near[:count]
        if found.is_sphere and count:
            found = found.aimed(voxels.points[on], up)
            zero = zero_direction(found.axis, up)
        if len(on) >= _LEAST_VOXELS:
            on = on[_connected(*found.places(voxels.points[on], zero), found, voxels.size_m)]
            is_flat = _turning(found, zero, voxels.take(on))[1]
            on = on if is_flat.mean() > _MOST_FLAT else on[~is_flat]
        if len(on) < _LEAST_VOXELS:
            return Rejected(reason="few points", evidence=evidence)
        if step == _ITERATIONS:
            break
        sigma_m = max(limits.noise_m / 2.0, 1e-3)
        is_cone = limits.form == "cone" and step > 0
        found = fitted(found, voxels.points[on], sigma_m, up, is_cone=is_cone)
        is_far = not limits.radius_m[0] <= found.radius_m <= 1.5 * limits.radius_m[1]
        if is_far or abs(found.slope) > _STEEPEST:
            return Rejected(reason="radius", evidence=evidence | {"radius_m": found.radius_m})
    found = found.directed(up)
    found = found.moved(float(np.mean((voxels.points[on] - found.point) @ found.axis)))
    zero = zero_direction(found.axis, up)
    return _judged(found, zero, side, voxels.take(on), limits)


def _grid(
    angles: NDArray[np.float64], along: NDArray[np.float64], found: Round, voxel_m: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], tuple[int, int], float]:
    """Return the cells (column around, row along) of positions, grid shape and cell size."""
    size_m = 1.5 * voxel_m
    n_around = max(12, round(2.0 * math.pi * found.radius_m / size_m))
    column = ((angles / (2.0 * math.pi) + 0.5) * n_around).astype(np.int64)
    row = ((along - along.min()) / size_m).astype(np.int64)
    return np.minimum(column, n_around - 1), row, (n_around, int(row.max()) + 1), size_m


def _connected(
    angles: NDArray[np.float64], along: NDArray[np.float64], found: Round, voxel_m: float
) -> NDArray[np.bool_]:
    """Return a mask (n,) of positions in large connected parts; gaps of two cells are bridged."""
    column, row, (n_around, n_along), _ = _grid(angles, along, found, voxel_m)
    # Repeat the circle, so that parts across angle -pi are connected.
    wide = np.zeros((2 * n_around, n_along), dtype=np.bool_)
    wide[column, row] = wide[column + n_around, row] = True
    parts, _ = ndimage.label(
        ndimage.binary_dilation(wide, np.ones((3, 3), dtype=np.bool_), iterations=1)
    )
    own = np.maximum(parts[column, row], 0)
    again = parts[column + n_around, row]
    for _ in range(2):
        # Parts of the two copies are the same part if they share a cell.
        lookup = np.arange(parts.max() + 1)
        np.minimum.at(lookup, again, own)
        own, again = lookup[own], lookup[again]
    sizes = np.bincount(own)
    return np.asarray(sizes[own] >= _PART_SHARE * sizes.max())


def _judged(
    found: Round,
    zero: NDArray[np.float64],
    side: float,
    voxels: Voxels,
    limits: Limits,
) -> Found | Rejected:
    """Test a fitted surface on its own voxels."""
    angles, along = found.places(voxels.points, zero)
    column, row, shape, size_m = _grid(angles, along, found, voxels.size_m)
    occupied = np.zeros(shape, dtype=np.bool_)
    occupied[column, row] = True
    rows = np.flatnonzero(occupied.sum(axis=1) >= 1)
    length = max(1.0, float(np.quantile(occupied[rows].sum(axis=1), 0.9)))
    is_open = occupied.sum(axis=1) >= _OPEN_SHARE * length
    if not is_open.any():
        return Rejected(reason="few points", evidence={})
    in_row = occupied[is_open].sum(axis=0)
    ends = np.flatnonzero(in_row >= found.least_row_share * is_open.sum())
    if not len(ends):
        return Rejected(reason="few points", evidence={})
    low_m = float(along.min()) + size_m * float(ends[0])
    high_m = float(along.min()) + size_m * float(ends[-1] + 1)
    arc_rad = 2.0 * math.pi * (1.0 - longest_gap(is_open) / len(is_open))
    if found.is_sphere:
        arc_rad = 2.0 * math.acos(min(1.0, max(-1.0, low_m / found.radius_m)))
    distances, _ = found.outwards(voxels.points)
    cells = occupied[is_open][:, ends[0] : ends[-1] + 1]
    # The rise of the middle of the surface above its ends distinguishes a dome from a cylinder.
    reach = along - along.mean()
    square = reach**2 - np.mean(reach**2)
    bend = float(square @ distances / max(1e-12, square @ square))
    evidence = {
        "radius_m": found.radius_m,
        "arc_deg": math.degrees(arc_rad),
        "length_m": high_m - low_m,
        "area_m2": float(cells.sum()) * size_m**2,
        "filled_share": float(cells.mean()),
        "scatter_mm": 1000.0 * 1.4826 * float(np.median(np.abs(distances))),
        "sagitta_mm": 1000.0 * found.radius_m * (1.0 - math.cos(min(arc_rad, math.pi) / 2.0)),
        "turning": _turning(found, zero, voxels)[0],
        "curvature_ratio": abs(2.0 * bend * found.radius_m),
    }
    rough_mm = 1000.0 * (_ROUGHEST_SHARE * found.radius_m + limits.noise_m)
    # A strip of a large dome is narrow, but as long as the tolerance on both sides permits.
    is_long = evidence["length_m"] > min(
        0.5 * found.radius_m, math.sqrt(8.0 * found.radius_m * limits.tolerance_at(found.radius_m))
    )
    reasons = {
        "short arc": arc_rad < limits.min_arc_rad,
        "small": evidence["area_m2"] < limits.min_area_m2,
        "incomplete": evidence["filled_share"] < _FILLED_LEAST,
        "flat parts": evidence["turning"] < _LEAST_TURNING,
        "rough": evidence["scatter_mm"] > rough_mm,
        "dome": is_long and not found.is_sphere and evidence["curvature_ratio"] > _DOUBLY_CURVED,
    }
    for reason, is_met in reasons.items():
        if is_met:
            return Rejected(reason=reason, evidence=evidence)
    return Found(
        round=found,
        zero=zero,
        side=side,
        is_open=is_open,
        along_m=(low_m - size_m, high_m + size_m),
        evidence=evidence,
    )


def _turning(
    found: Round, zero: NDArray[np.float64], voxels: Voxels
) -> tuple[float, NDArray[np.bool_]]:
    """Return the rotation of normals per angle in narrow sectors: 1 on circles, 0 on facets.

    On a sphere, it is the rotation in the direction of the least, which is 0 on a cylinder. The
    second result is a mask (v,) of the voxels in sectors that are flat.
    """
    angles, _ = found.places(voxels.points, zero)
    _, outwards = found.outwards(voxels.points)
    aside = cross(found.axis, zero)
    signs = np.sign(np.einsum("ij,ij->i", voxels.normals, outwards))
    normals = voxels.normals * signs[:, None]
    width = min(max(_FACET_VOXELS * voxels.size_m / found.radius_m, _FACET_RAD[0]), _FACET_RAD[1])
    if found.is_sphere:
        return _turning_of_sphere(normals, outwards, width)
    turned = np.arctan2(normals @ aside, normals @ zero) - angles
    turned = (turned + math.pi) % (2.0 * math.pi) - math.pi
    sector = ((angles + math.pi) / width).astype(np.int64)
    counts = np.maximum(np.bincount(sector), 1)
    x = angles - (np.bincount(sector, angles) / counts)[sector]
    y = turned - (np.bincount(sector, turned) / counts)[sector]
    products, squares = np.bincount(sector, x * y), np.bincount(sector, x * x)
    turning = 1.0 + products / np.maximum(squares, 1e-12)
    is_flat = (turning < _LEAST_TURNING) & (counts >= _SECTOR_VOXELS)
    return 1.0 + float(products.sum() / max(1e-12, squares.sum())), is_flat[sector]


def _turning_of_sphere(
    normals: NDArray[np.float64], outwards: NDArray[np.float64], width_rad: float
) -> tuple[float, NDArray[np.bool_]]:
    """Return the results of `_turning` from normals and radii (v, 3), unit vectors."""
    columns = np.floor(outwards / width_rad).astype(np.int64)
    sector = np.unique(columns, axis=0, return_inverse=True)[1].ravel()
    counts = np.bincount(sector)
    x, y = (
        values - (group_sums(values, sector) / counts[:, None])[sector]
        for values in (outwards, normals)
    )
    products = np.bincount(sector, (x * y).sum(axis=1))
    squares = np.bincount(sector, (x * x).sum(axis=1))
    is_flat = (products < _LEAST_TURNING * squares) & (counts >= _SECTOR_VOXELS)
    # On a small part of a sphere, radii hardly rotate towards its middle.
    sizes, directions = np.linalg.eigh(x.T @ x)
    scaled = directions[:, sizes > _LEAST_SHARE * sizes[2]]
    scaled /= np.sqrt(sizes[sizes > _LEAST_SHARE * sizes[2]])
    rotation = scaled.T @ x.T @ y @ scaled
    return float(np.linalg.eigvalsh(0.5 * (rotation + rotation.T))[0]), is_flat[sector]


def longest_gap(is_open: NDArray[np.bool_]) -> int:
    """Return the length of the longest run of False around a circle."""
    opens = np.flatnonzero(is_open)
    return int(np.max(np.diff(np.append(opens, opens[0] + len(is_open)))) - 1)


def with_bridged_gaps(found: Found, most_rad: float) -> Found:
    """Return a surface whose arc includes gaps up to an angle, and one more cell at its ends."""
    count = len(found.is_open)
    steps = max(1, math.floor(0.5 * most_rad / (2.0 * math.pi) * count))
    wide = np.tile(found.is_open, 3)
    closed = ndimage.binary_closing(wide, np.ones(2 * steps + 1, dtype=np.bool_))
    closed = ndimage.binary_dilation(closed, np.ones(3, dtype=np.bool_))
    return replace(found, is_open=closed[count : 2 * count])
