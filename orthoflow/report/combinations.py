"""The combinations of variants that a run computed, their metrics, and their environments."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.catalog.distributions import canonical_name, required_distributions
from orthoflow.geometry import angle_between_deg
from orthoflow.products import Inspection, Walls
from orthoflow.records import RecordedCell, RecordedEnvironment
from orthoflow.records.runs import Run, cell_metrics
from orthoflow.records.write import NOT_YET
from orthoflow.untrusted_text import first_few, parse_json
from orthoflow.version import DISTRIBUTION
from orthoflow.workflow.expand import variants_text
from orthoflow.workflow.model import DATA

# Walls that differ by more are two.
_TURNED_DEG: Final = 10.0
_LARGER: Final = 1.5
_ROOMS_MOST: Final = 3
_ODD_MOST: Final = 3


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A metric of one combination.

    Attributes:
        value: the mean over the repeats; of errors of both signs that of their sizes.
        spread: standard deviation over the repeats, NaN without repeats.
        n_repeats: how many values there are.
        n_all: how many runs of the step came to their end, with a value or without.
        unit: `1` for counts and shares.
        environment: id of the environment that it was computed in.
        is_of_sizes: the repeats are errors of both signs.
    """

    value: float
    spread: float
    n_repeats: int
    n_all: int
    unit: str
    environment: str
    is_of_sizes: bool = False


@dataclass(frozen=True, kw_only=True)
class Combination:
    """One way through the variants.

    Attributes:
        run: the run it belongs to.
        assignment: step -> variant; empty when nothing varies.
        cells: the cells that it is made of, in the order of the graph, repeats behind the first.
        is_baseline: it is the one that the workflow calls its baseline.
    """

    run: Run
    assignment: Mapping[str, str]
    cells: tuple[RecordedCell, ...]
    is_baseline: bool

    @property
    def name(self) -> str:
        """The variants in words, e.g. `plane=ransac, orient=pnp`."""
        return variants_text(self.assignment)

    @property
    def failure(self) -> RecordedCell | None:
        """The first cell that failed; what lies behind it was skipped and is not named."""
        failed = (cell for cell in self.cells if cell.status == "failed" and cell.repeat == 0)
        return next(failed, None)

    @property
    def missing(self) -> tuple[RecordedCell, ...]:
        """Cells that the run was interrupted before; optional steps without data are none."""
        return tuple(cell for cell in self.cells if cell.repeat == 0 and is_missing(cell))

    @property
    def n_failed_repeats(self) -> int:
        """How many of the repeats after the first failed."""
        return sum(cell.status == "failed" and cell.repeat > 0 for cell in self.cells)

    @property
    def varied_cells(self) -> tuple[RecordedCell, ...]:
        """Cells that the variants have a part in, without repeats; all when nothing varies."""
        first = [cell for cell in self.cells if cell.repeat == 0]
        return tuple(cell for cell in first if cell.assignment or not self.assignment)

    def measured(self, step: str, metric: str) -> Measured | None:
        """Return a metric of a step, None when the step did not report it."""
        found = [
            (row, cell.environment)
            for cell in self.cells
            if cell.step == step
            for row in cell_metrics(cell)
            if row.metric == metric
        ]
        if not found:
            return None
        values = np.array([row.value for row, _ in found])
        # Their mean would be small where the repeats lie far apart, on both sides of the truth.
        is_of_sizes = bool(values.min() < 0.0 < values.max()) and found[0][0].better == "lower"
        if is_of_sizes:
            values = np.abs(values)
        return Measured(
            value=float(values.mean()),
            # The mean of equal values may be off in its last digit; from the first one none is.
            spread=float((values - values[0]).std(ddof=1)) if len(values) > 1 else math.nan,
            n_repeats=len(values),
            n_all=sum(cell.step == step and cell.status == "ok" for cell in self.cells),
            unit=found[0][0].unit,
            environment=found[0][1],
            is_of_sizes=is_of_sizes,
        )

    def n_items(self, step: str, counted_by: str) -> float:
        """How many items a metric of a step sums up, of repeats their mean; NaN: nobody counts."""
        count = self.measured(step, counted_by) if counted_by else None
        return math.nan if count is None else count.value


def unequal_walls(combinations: Iterable[Combination]) -> str:
    """Return where the first walls of combinations are not one, room by room; empty where they are.

    What was found decides which wall is the first, so that numbers of it may be of different ones.
    """
    by_room: dict[tuple[Path, str], list[tuple[Combination, tuple[float, ...]]]] = {}
    for one in combinations:
        # Of the last step that gives walls.
        steps = [cell.step for cell in one.cells if gives(cell, Walls.type_name)][-1:]
        found = [one.measured(step, name) for step in steps for name in _FIRST_WALL]
        wall = tuple(value.value for value in found if value is not None)
        if len(wall) == len(_FIRST_WALL):
            room = (one.run.path, one.assignment.get(DATA, ""))
            by_room.setdefault(room, []).append((one, wall))
    groups = []
    for shown in by_room.values():
        # What most of them show is what the odd ones do not.
        walls = [wall for _, wall in shown]
        usual = max(walls, key=lambda wall: sum(_may_be_one_wall(wall, other) for other in walls))
        odd = [
            f"{one.name} shows {_wall_words(wall)}"
            for one, wall in shown
            if not _may_be_one_wall(wall, usual)
        ]
        if odd:
            groups.append(f"{first_few(odd, most=_ODD_MOST)}, most {_wall_words(usual)}")
    if not groups:
        return ""
    return (
        "not all combinations show the same wall first, so numbers of it speak of different ones "
        "(near of the wall takes the one at a point, where it was found): "
        f"{first_few(groups, most=_ROOMS_MOST)}"
    )


# Metrics of the first wall.
_FIRST_WALL: Final = ("omega_deg", "phi_deg", "area_m2")


def _may_be_one_wall(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    """Whether omega, phi and area may be those of one wall, its edges a little elsewhere."""
    is_turned = angle_between_deg(_normal(*one[:2]), _normal(*other[:2])) >= _TURNED_DEG
    return not is_turned and max(one[2], other[2]) <= _LARGER * min(one[2], other[2])


def _normal(omega_deg: float, phi_deg: float) -> NDArray[np.float64]:
    """(3,) unit vector; markiewicz2015 equation 3, as `omega_phi_deg`."""
    omega, phi = math.radians(omega_deg), math.radians(phi_deg)
    across = math.cos(phi)
    return np.array([across * math.cos(omega), across * math.sin(omega), math.sin(phi)])


def _wall_words(wall: tuple[float, ...]) -> str:
    return f"{wall[2]:.3g} m2 at omega {wall[0]:.0f}, phi {wall[1]:.0f} deg"


def gives(cell: RecordedCell, *type_names: str) -> bool:
    """Whether a cell has given a product of one of these types."""
    return any(product.type_name in type_names for product in cell.outputs.values())


def is_check(cell: RecordedCell) -> bool:
    """Whether a cell judges the results of others: it gives inspections and nothing else."""
    types = {product.type_name for product in cell.outputs.values()}
    return types == {Inspection.type_name}


def is_missing(cell: RecordedCell) -> bool:
    """Return whether the run was interrupted before the cell."""
    return cell.error_type == NOT_YET


def combinations_of(run: Run) -> tuple[Combination, ...]:
    """Return every combination of variants that the run has cells of, the baseline marked.

    A combination that is part of a larger one (`plane=ransac` of `plane=ransac, orient=pnp`) is
    no row of its own.
    """
    assignments = list(dict.fromkeys(tuple(cell.assignment.items()) for cell in run.record.cells))
    parts = [frozenset(items) for items in assignments]
    largest = [
        items
        for items, part in zip(assignments, parts, strict=True)
        if not any(part < other for other in parts)
    ]
    baseline = baseline_of(run)
    return tuple(combination_of(run, dict(items), baseline) for items in largest)


def combination_of(
    run: Run, assignment: Mapping[str, str], baseline: Mapping[str, str]
) -> Combination:
    """Return all cells that lead to what has some variants, and to nothing that needs more."""
    return Combination(
        run=run,
        assignment=assignment,
        cells=tuple(
            cell for cell in run.record.cells if cell.assignment.items() <= assignment.items()
        ),
        is_baseline=_is_baseline(assignment, baseline),
    )


def baseline_of(run: Run) -> Mapping[str, str]:
    """The variants that the workflow calls its baseline; empty without a comparison."""
    found = _comparison(run).get("baseline")
    if not isinstance(found, dict):
        return {}
    return {str(step): str(variant) for step, variant in found.items()}


def baseline_cells(run: Run) -> tuple[RecordedCell, ...]:
    """The cells of the baseline, of the first combination when the workflow names none."""
    found = combinations_of(run)
    chosen = next((one for one in found if one.is_baseline), found[0] if found else None)
    return tuple(cell for cell in chosen.cells if cell.repeat == 0) if chosen else ()


def baseline_addresses(run: Run) -> tuple[str, ...]:
    """The cells whose figures lie beside the page: of the baseline, and before all variants."""
    baseline = {cell.address for cell in baseline_cells(run)}
    return tuple(
        address
        for address, cell in run.cells.items()
        if address in baseline or not (cell.assignment or cell.repeat)
    )


class Way(NamedTuple):
    """The cells of one combination, a row of the comparison, that the page shows with it.

    Attributes:
        anchor: its anchor on the page.
        name: the variants in words.
        cells: addresses of the cells that no row above and no section of the page shows.
    """

    anchor: str
    name: str
    cells: tuple[str, ...]


def ways(run: Run, prefix: str) -> tuple[Way, ...]:
    """Return the combinations of a run, each cell with the first that it belongs to.

    Args:
        run: the run.
        prefix: what the anchors begin with.
    """
    shown = set(baseline_addresses(run))
    found = []
    for index, one in enumerate(combinations_of(run), start=1):
        own = tuple(cell.address for cell in one.varied_cells if cell.address not in shown)
        found.append(Way(f"{prefix}way-{index}", one.name, own))
        shown |= set(own)
    return tuple(found)


def improved_on(run: Run, addresses: Collection[str]) -> frozenset[str]:
    """Cells whose result a later step of the same kind continues, such as a first orientation."""
    return frozenset(
        before.address
        for address in addresses
        for before in run.upstream(address)
        if before.address != address
        and before.address in addresses
        and before.method.partition(".")[0] == run.cells[address].method.partition(".")[0]
    )


def wanted_metrics(run: Run) -> tuple[str, ...]:
    """The patterns `step.metric` that the workflow's comparison asks for."""
    found = _comparison(run).get("metrics")
    return tuple(str(pattern) for pattern in found) if isinstance(found, list) else ()


def _comparison(run: Run) -> Mapping[str, object]:
    try:
        document = parse_json(run.record.workflow_resolved)
    except ValueError:
        return {}
    found = document.get("compare") if isinstance(document, dict) else None
    return found if isinstance(found, dict) else {}


def _is_baseline(assignment: Mapping[str, str], baseline: Mapping[str, str]) -> bool:
    # A dataset is none of the baseline's steps: each has a baseline of its own.
    return bool(baseline) and all(
        baseline.get(step, variant) == variant for step, variant in assignment.items()
    )


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
