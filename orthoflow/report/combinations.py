"""The combinations of variants in a run, their metrics and their environments."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.catalog.distributions import canonical_name, required_distributions
from orthoflow.geometry import angle_between_deg
from orthoflow.products import Inspection, Walls
from orthoflow.records import RecordedCell, RecordedEnvironment
from orthoflow.records.runs import MetricRow, Run, cell_metrics
from orthoflow.records.write import NOT_YET
from orthoflow.report.rankings import cost_share
from orthoflow.untrusted_text import first_few, parse_json
from orthoflow.version import DISTRIBUTION
from orthoflow.workflow.expand import variants_text
from orthoflow.workflow.model import DATA

# Planes are different walls if the angle between their normals is larger than this.
_TURNED_DEG: Final = 10.0
_LARGER: Final = 1.5
_ROOMS_MOST: Final = 3
_ODD_MOST: Final = 3


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A metric of one combination.

    Attributes:
        value: mean over the repeats; for errors of both signs, mean of the absolute values.
        spread: standard deviation over the repeats; NaN for a single value.
        n_repeats: number of repeats with a value.
        n_all: number of finished repeats of the step, with or without a value.
        unit: `1` for counts and shares.
        environment: id of the environment in which the metric was computed.
        is_of_sizes: whether `value` is the mean of absolute values.
        scatter: `spread`, or 0 for a single value that does not depend on a seed.
    """

    value: float
    spread: float
    n_repeats: int
    n_all: int
    unit: str
    environment: str
    is_of_sizes: bool = False
    scatter: float = math.nan


@dataclass(frozen=True, kw_only=True)
class Combination:
    """A selection of one variant for each step with variants.

    Attributes:
        run: run to which the combination belongs.
        assignment: step -> variant; empty if the workflow has no variants.
        cells: cells of the combination in the order of the graph; repeats follow their cell.
        is_baseline: whether the combination is the workflow's baseline.
    """

    run: Run
    assignment: Mapping[str, str]
    cells: tuple[RecordedCell, ...]
    is_baseline: bool

    @property
    def name(self) -> str:
        """The variants as text, e.g. `plane=ransac, orient=pnp`."""
        return variants_text(self.assignment)

    @property
    def failure(self) -> RecordedCell | None:
        """The first cell that failed; None if no cell failed."""
        failed = (cell for cell in self.cells if cell.status == "failed" and cell.repeat == 0)
        return next(failed, None)

    @property
    def missing(self) -> tuple[RecordedCell, ...]:
        """Cells that had not run when the run was interrupted."""
        return tuple(cell for cell in self.cells if cell.repeat == 0 and is_missing(cell))

    @property
    def n_failed_repeats(self) -> int:
        """Number of repeats that failed, not counting the first computation of each cell."""
        return sum(cell.status == "failed" and cell.repeat > 0 for cell in self.cells)

    @property
    def varied_cells(self) -> tuple[RecordedCell, ...]:
        """Cells that depend on variants, without repeats; all cells if there are no variants."""
        first = [cell for cell in self.cells if cell.repeat == 0]
        return tuple(cell for cell in first if cell.assignment or not self.assignment)

    def measured(self, step: str, metric: str) -> Measured | None:
        """Return a metric of a step; None if the step did not report it."""
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
        # Errors of both signs would cancel in the mean even if all of them are large.
        is_of_sizes = bool(values.min() < 0.0 < values.max()) and found[0][0].better == "lower"
        if is_of_sizes:
            values = np.abs(values)
        # The first value is subtracted so that the spread of identical values is exactly 0.
        spread = float((values - values[0]).std(ddof=1)) if len(values) > 1 else math.nan
        own = next(cell.address for cell in self.cells if cell.step == step)
        varied = {cell.address for cell in self.varied_cells}
        # Cells without inputs only provide the data, which are the same for all values.
        is_seeded = any(
            cell.determinism == "seeded"
            for cell in self.run.upstream(own)
            if cell.address in varied and (cell.inputs or {*cell.assignment} - {DATA})
        )
        is_known = len(values) == 1 and not (is_seeded or cost_share(found[0][0].unit))
        return Measured(
            value=float(values.mean()),
            spread=spread,
            scatter=0.0 if is_known else spread,
            n_repeats=len(values),
            n_all=sum(cell.step == step and cell.status == "ok" for cell in self.cells),
            unit=found[0][0].unit,
            environment=found[0][1],
            is_of_sizes=is_of_sizes,
        )

    @property
    def metrics(self) -> tuple[MetricRow, ...]:
        """All metrics, averaged over the repeats like those of `measured`."""
        found: dict[tuple[str, str], MetricRow] = {}
        for cell in self.cells:
            for row in cell_metrics(cell):
                found.setdefault((row.step, row.metric), row)
        repeated = {cell.step for cell in self.cells if cell.repeat}
        means = {key: self.measured(*key) for key in found if key[0] in repeated}
        return tuple(
            replace(row, value=mean.value) if (mean := means.get(key)) else row
            for key, row in found.items()
        )

    def n_items(self, step: str, counted_by: str) -> float:
        """Return the number of items that a metric sums over, as mean over repeats.

        The result is NaN if the items are not counted.
        """
        count = self.measured(step, counted_by) if counted_by else None
        return math.nan if count is None else count.value


def unequal_walls(combinations: Iterable[Combination]) -> str:
    """List the datasets in which the first wall differs between combinations; "" if none.

    Which wall is the first depends on the detected planes, so metrics of the first wall may refer
    to different walls.
    """
    by_room: dict[tuple[Path, str], list[tuple[Combination, tuple[float, ...]]]] = {}
    for one in combinations:
        # Use the last step that outputs walls.
        steps = [cell.step for cell in one.cells if gives(cell, Walls.type_name)][-1:]
        found = [one.measured(step, name) for step in steps for name in _FIRST_WALL]
        wall = tuple(value.value for value in found if value is not None)
        if len(wall) == len(_FIRST_WALL):
            room = (one.run.path, one.assignment.get(DATA, ""))
            by_room.setdefault(room, []).append((one, wall))
    groups = []
    for shown in by_room.values():
        # The wall that most combinations have is the reference, and the other combinations are
        # listed.
        walls = [wall for _, wall in shown]
        usual = max(walls, key=lambda wall: sum(_may_be_one_wall(wall, other) for other in walls))
        odd = [
            f"{one.name} shows {_wall_words(wall)}"
            for one, wall in shown
            if not _may_be_one_wall(wall, usual)
        ]
        if odd:
            groups.append(f"{first_few(odd, most=_ODD_MOST)}, most others {_wall_words(usual)}")
    if not groups:
        return ""
    return (
        "the first wall is not the same in all combinations, so its metrics refer to different "
        "walls (the parameter `near` of the wall step selects the wall at a point): "
        f"{first_few(groups, most=_ROOMS_MOST)}"
    )


# These metrics identify the first wall.
_FIRST_WALL: Final = ("omega_deg", "phi_deg", "area_m2")


def _may_be_one_wall(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    """Return whether two tuples (omega, phi, area) may belong to the same wall.

    Angles are in degrees and areas in square metres; the edges may differ slightly.
    """
    is_turned = angle_between_deg(_normal(*one[:2]), _normal(*other[:2])) >= _TURNED_DEG
    return not is_turned and max(one[2], other[2]) <= _LARGER * min(one[2], other[2])


def _normal(omega_deg: float, phi_deg: float) -> NDArray[np.float64]:
    """Return the unit normal (3,) of a plane from its angles (markiewicz2015, equation 3)."""
    omega, phi = math.radians(omega_deg), math.radians(phi_deg)
    across = math.cos(phi)
    return np.array([across * math.cos(omega), across * math.sin(omega), math.sin(phi)])


def _wall_words(wall: tuple[float, ...]) -> str:
    return f"{wall[2]:.3g} m2 at omega {wall[0]:.0f}, phi {wall[1]:.0f} deg"


def gives(cell: RecordedCell, *type_names: str) -> bool:
    """Return whether a cell has an output of one of the given types."""
    return any(product.type_name in type_names for product in cell.outputs.values())


def is_check(cell: RecordedCell) -> bool:
    """Return whether a cell only checks other results, i.e. all its outputs are inspections."""
    types = {product.type_name for product in cell.outputs.values()}
    return types == {Inspection.type_name}


def is_missing(cell: RecordedCell) -> bool:
    """Return whether a cell had not run when the run was interrupted."""
    return cell.error_type == NOT_YET


def combinations_of(run: Run) -> tuple[Combination, ...]:
    """Return all combinations of variants in a run.

    A combination that is part of a larger one is omitted, such as `plane=ransac`, which is part of
    `plane=ransac, orient=pnp`.
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
    """Return the combination of all cells that depend only on the given variants."""
    return Combination(
        run=run,
        assignment=assignment,
        cells=tuple(
            cell for cell in run.record.cells if cell.assignment.items() <= assignment.items()
        ),
        is_baseline=_is_baseline(assignment, baseline),
    )


def baseline_of(run: Run) -> Mapping[str, str]:
    """Return step -> variant for the workflow's baseline; empty if the workflow has no baseline."""
    found = _comparison(run).get("baseline")
    if not isinstance(found, dict):
        return {}
    return {str(step): str(variant) for step, variant in found.items()}


def baseline_combination(run: Run) -> Combination | None:
    """Return the baseline, or the first combination if there is no baseline."""
    found = combinations_of(run)
    return next((one for one in found if one.is_baseline), found[0] if found else None)


def baseline_cells(run: Run) -> tuple[RecordedCell, ...]:
    """Return the cells of `baseline_combination` without repeats."""
    chosen = baseline_combination(run)
    return tuple(cell for cell in chosen.cells if cell.repeat == 0) if chosen else ()


def baseline_metrics(run: Run) -> tuple[MetricRow, ...]:
    """Return the metrics of `baseline_combination`, averaged over the repeats."""
    chosen = baseline_combination(run)
    return chosen.metrics if chosen else ()


def baseline_addresses(run: Run) -> tuple[str, ...]:
    """Return the addresses of baseline cells and cells without variants.

    The figures of these cells are written to files next to the page.
    """
    baseline = {cell.address for cell in baseline_cells(run)}
    return tuple(
        address
        for address, cell in run.cells.items()
        if address in baseline or not (cell.assignment or cell.repeat)
    )


class Way(NamedTuple):
    """The cells that the page shows for one combination, which is one row of the comparison.

    Attributes:
        anchor: HTML anchor on the page.
        name: the variants as text.
        cells: addresses of the cells of the combination that are not already shown in a row above
            or in another section of the page.
    """

    anchor: str
    name: str
    cells: tuple[str, ...]


def ways(run: Run, prefix: str) -> tuple[Way, ...]:
    """Return the combinations of a run; each cell belongs to the first one that contains it.

    Args:
        run: the run.
        prefix: prefix of the HTML anchors.
    """
    shown = set(baseline_addresses(run))
    found = []
    for index, one in enumerate(combinations_of(run), start=1):
        own = tuple(cell.address for cell in one.varied_cells if cell.address not in shown)
        found.append(Way(f"{prefix}way-{index}", one.name, own))
        shown |= set(own)
    return tuple(found)


def improved_on(run: Run, addresses: Collection[str]) -> frozenset[str]:
    """Return the cells whose results a later step of the same kind refines.

    An example is an orientation that a later orientation refines.
    """
    return frozenset(
        before.address
        for address in addresses
        for before in run.upstream(address)
        if before.address != address
        and before.address in addresses
        and before.method.partition(".")[0] == run.cells[address].method.partition(".")[0]
    )


def wanted_metrics(run: Run) -> tuple[str, ...]:
    """Return the patterns `step.metric` that the workflow's comparison selects."""
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
    # `baseline` does not contain the dataset, because each dataset has its own baseline.
    return bool(baseline) and all(
        baseline.get(step, variant) == variant for step, variant in assignment.items()
    )


@dataclass(frozen=True, kw_only=True)
class EnvironmentGroups:
    """Groups of equivalent environments.

    Attributes:
        first: id of an environment -> id of the first equivalent environment.
        words: id of the first environment of a group -> description of the group, with its
            differences from the first group.
    """

    first: Mapping[str, str]
    words: Mapping[str, str]

    def are_comparable(self, one: str, other: str) -> bool:
        """Return whether values from two environments may be compared."""
        return self.first.get(one, one) == self.first.get(other, other)


def group_environments(runs: Iterable[Run]) -> EnvironmentGroups:
    """Group the environments in which all packages that the methods use are identical.

    Only packages that orthoflow or the distributions of the methods require are compared; if one of
    these distributions is not installed, all packages are compared. A package that only one of two
    environments contains, such as a plugin installed between two runs, is ignored.
    """
    runs = tuple(runs)
    environments = {one.id: one for run in runs for one in run.record.environments}
    named = {cell.distribution for run in runs for cell in run.record.cells} - {""}
    # A single environment needs no comparison.
    several = len(environments) > 1
    used = required_distributions(frozenset({*named, DISTRIBUTION})) if several else None
    first: dict[str, str] = {}
    known: dict[str, dict[str, str]] = {}
    for key, environment in environments.items():
        facts = _facts(environment, used)
        # Compare with the packages of all members of a group, because the first member may lack a
        # package in which the others differ.
        like = next((name for name, seen in known.items() if _agree(seen, facts)), key)
        first[key] = like
        known[like] = facts | known.get(like, {})
    words = distinct_words([environments[key] for key in known], used)
    return EnvironmentGroups(first=first, words=words)


def environment_words(environment: RecordedEnvironment) -> str:
    """Describe an environment in one line."""
    commit = f", code at commit {environment.git_commit}" if environment.git_commit else ""
    return (
        f"Python {environment.python}, {environment.os}, {environment.cpu}, "
        f"{environment.cores} processors, {environment.threads} threads{commit}"
    )


def distinct_words(
    environments: Sequence[RecordedEnvironment], used: Collection[str] | None = None
) -> dict[str, str]:
    """Describe environments; packages are named if they differ from the first environment.

    Args:
        environments: environments, the first of which is the reference.
        used: packages to compare; None for all.

    Returns:
        Environment id -> description.
    """
    return {
        one.id: environment_words(one)
        + _other_packages(_packages(one, used), _packages(first, used))
        for first in environments[:1]
        for one in environments
    }


def _other_packages(own: Mapping[str, str], others: Mapping[str, str]) -> str:
    texts = [f"{name} {own[name]}" for name in own if own[name] != others.get(name)]
    texts += [f"no {name}" for name in others if name not in own]
    return f"; differs from the first in {first_few(texts)}" if texts else ""


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
