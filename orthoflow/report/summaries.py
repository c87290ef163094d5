"""What the page says in numbers and words, taken from the record."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoflow.geometry import omega_phi_deg
from orthoflow.products import Planes
from orthoflow.records import Run

# Without photos that show a place, completeness cannot be asked for there.
_SHARPER_COMPLETENESS: Final = "completeness_seen_by_both"
# Metrics that say how good the products are, in the order in which a reader wants them.
_QUALITY: Final[Mapping[str, str]] = {
    "rmse_u_mm": "error along u (right), RMS",
    "rmse_v_mm": "error along v (down), RMS",
    _SHARPER_COMPLETENESS: "painted, of what a station and a photo see",
    "n_oriented": "photos oriented",
    "sigma_wall_mm_worst": "expected error on the wall, worst photo",
    "check_rmse_mm_worst": "ties that only check, RMS on the wall, worst photo",
    "plane_angle_deg": "direction of the main plane, error",
    "plane_offset_mm": "position of the main plane, error",
    "depth_rmse_mm": "error of the depth, RMS",
    "completeness": "share of the visible cells that is painted",
    "rms_mm": "points to their plane, RMS",
}


@dataclass(frozen=True, kw_only=True)
class Answer:
    """One number of the first screen: what, how much, from which cell."""

    what: str
    value: str
    cell: str


@dataclass(frozen=True, kw_only=True)
class PlaneRow:
    """One found plane, ready to print."""

    name: str
    omega_deg: float
    phi_deg: float
    offset_m: float
    sigma_mm: float
    size: str
    n_points: int
    rms_mm: float


@dataclass(frozen=True, kw_only=True)
class PlaneTable:
    """The planes of one cell."""

    cell: str
    viewpoint: str
    rows: tuple[PlaneRow, ...]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Metrics of the variants of one step beside each other.

    Attributes:
        step: name of the step.
        cells: addresses, in the order of the graph.
        rows: metric name with its unit -> one printed value per cell, empty where there is none.
    """

    step: str
    cells: tuple[str, ...]
    rows: Mapping[str, tuple[str, ...]]


def answers(run: Run) -> tuple[Answer, ...]:
    """How good the products are: the quality metrics of the inspections, else of the planes."""
    rows = run.metrics()
    values = {(row.cell, row.metric): row.value for row in rows}
    found: list[Answer] = []
    for wanted, what in _QUALITY.items():
        told = [row for row in rows if row.metric == wanted]
        # A later step of the chain improves on an earlier one: first and final orientation.
        told = [row for row in told if row.step == told[-1].step]
        if wanted == "completeness":
            told = [row for row in told if (row.cell, _SHARPER_COMPLETENESS) not in values]
        for row in told:
            value = number_with_unit(row.value, row.unit)
            if wanted == "n_oriented" and (row.cell, "n_photos") in values:
                value = f"{value} of {number(values[row.cell, 'n_photos'])}"
            found.append(Answer(what=what, value=value, cell=row.cell))
    return tuple(found)


def warnings(run: Run) -> tuple[tuple[str, str], ...]:
    """What limits the results: (address, sentence), failures first."""
    failed = [
        (cell.address, f"failed: {cell.error_message}")
        for cell in run.record.cells
        if cell.status == "failed"
    ]
    warned = [(cell.address, text) for cell in run.record.cells for text in cell.warnings]
    return (*failed, *warned)


def plane_tables(run: Run) -> Iterator[PlaneTable]:
    """The planes of every cell that found some."""
    for address, cell in run.cells.items():
        for port, product in cell.outputs.items():
            if product.type_name == "planes" and product.embedded:
                planes = Planes.from_payload(run.payload(address, port))
                yield PlaneTable(
                    cell=address,
                    viewpoint=planes.viewpoint,
                    rows=tuple(_plane_row(planes, index) for index in range(len(planes))),
                )


def comparisons(run: Run) -> Iterator[Comparison]:
    """Steps that were computed more than once, with all their metrics."""
    steps: dict[str, list[str]] = {}
    for address, cell in run.cells.items():
        steps.setdefault(cell.step, []).append(address)
    rows = run.metrics()
    for step, addresses in steps.items():
        if len(addresses) < 2:
            continue
        names = dict.fromkeys((row.metric, row.unit) for row in rows if row.step == step)
        values = {(row.cell, row.metric): row.value for row in rows if row.step == step}
        yield Comparison(
            step=step,
            cells=tuple(addresses),
            rows={
                _named(name, unit): tuple(
                    number(values[address, name]) if (address, name) in values else ""
                    for address in addresses
                )
                for name, unit in names
            },
        )


def number(value: float) -> str:
    """Print a number with four significant digits, without an exponent where one can.

    >>> number(0.0123456), number(1234567.0), number(12.0)
    ('0.01235', '1234567', '12')
    """
    if value == int(value) and abs(value) < 1e15:
        return str(int(value))
    digits = max(0, 3 - math.floor(math.log10(abs(value))))
    return f"{value:.{digits}f}".rstrip("0").rstrip(".") if digits < 10 else f"{value:.3g}"


def number_with_unit(value: float, unit: str) -> str:
    """Print a number and its unit; shares and counts (unit 1) stand alone."""
    return number(value) if unit == "1" else f"{number(value)} {unit}"


def _named(name: str, unit: str) -> str:
    return name if unit == "1" or name.endswith(f"_{unit.lower()}") else f"{name} ({unit})"


def _plane_row(planes: Planes, index: int) -> PlaneRow:
    omega, phi = omega_phi_deg(planes.normal[index], planes.up)
    corners = planes.corners[index]
    width_m = float(np.linalg.norm(corners[3] - corners[0]))
    height_m = float(np.linalg.norm(corners[1] - corners[0]))
    return PlaneRow(
        name=planes.names[index],
        omega_deg=omega,
        phi_deg=phi,
        offset_m=float(planes.offset[index]),
        sigma_mm=1000 * _offset_sigma_m(planes, index),
        size=f"{width_m:.2f} x {height_m:.2f} m",
        n_points=int(planes.n_points[index]),
        rms_mm=1000 * float(planes.rms_m[index]),
    )


def _offset_sigma_m(planes: Planes, index: int) -> float:
    # Along the normal at the rectangle's centre, not at the far origin, where the angle's
    # uncertainty would swamp it: offset error = n' x - d with x fixed.
    centre = planes.corners[index].mean(axis=0)
    gradient = np.append(centre, -1.0)
    variance = float(gradient @ planes.covariance[index] @ gradient)
    return math.sqrt(max(0.0, variance))
