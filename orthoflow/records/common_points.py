"""Check points that all cells of a comparison found, so that methods are compared on one set.

A method that shows fewer points is not better for it: what each lost is a number of its own, as
skarlatos2012 compares 30 points that both of its methods show.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from orthoflow.products import Inspection
from orthoflow.records.runs import Run
from orthoflow.workflow.model import DATA, SEED


@dataclass(frozen=True, kw_only=True)
class CommonPoints:
    """What one cell's inspection gives over the points that all cells beside it found.

    Attributes:
        cell: address of the inspection.
        step: of the inspection.
        kind: class of the points; empty for all together.
        n_found: points that this cell found.
        n_common: points that every cell found.
        rms_u_mm: root mean square of displacements along u over the common points.
        rms_v_mm: the same along v.
        rms_mm: the same of their lengths.
    """

    cell: str
    step: str
    kind: str
    n_found: int
    n_common: int
    rms_u_mm: float
    rms_v_mm: float
    rms_mm: float

    @property
    def n_lost(self) -> int:
        """Points of this cell that do not count, because another cell did not find them."""
        return self.n_found - self.n_common


def common_points(run: Run) -> tuple[CommonPoints, ...]:
    """Compare the inspections of each step over common points, per dataset, seed and repeat.

    Inspections that share no point, such as those that match features, give no rows; neither do
    those whose products are not in the record.

    Raises:
        RecordError: the record is damaged.
    """
    groups: dict[tuple[str, ...], dict[str, Inspection]] = defaultdict(dict)
    for cell in run.record.cells:
        for port, output in cell.outputs.items():
            if output.type_name == Inspection.type_name and output.embedded:
                conditions = (cell.assignment.get(DATA, ""), cell.assignment.get(SEED, ""))
                key = (cell.step, port, *conditions, str(cell.repeat))
                found = Inspection.from_payload(run.payload(cell.address, port))
                groups[key][cell.address] = found
    return tuple(
        row
        for key, inspections in groups.items()
        if len(inspections) > 1
        for row in over_common_points(inspections, step=key[0])
    )


def over_common_points(
    inspections: Mapping[str, Inspection], *, step: str = ""
) -> Iterator[CommonPoints]:
    """Yield rows of all inspections over the points that each of them found, class by class.

    Args:
        inspections: address of the cell -> what it found; points are the same where their
            coordinates and their class are.
        step: of the cells.
    """
    places = {cell: _rows_of_points(found) for cell, found in inspections.items()}
    common = set.intersection(*(set(rows) for rows in places.values()))
    if not common:
        return
    kinds = sorted({kind for kind, _ in common})
    for kind in ["", *(kinds if len(kinds) > 1 else ())]:
        for cell, inspection in inspections.items():
            rows = places[cell]
            mine = [point for point in rows if kind in ("", point[0])]
            shared = [rows[point] for point in mine if point in common]
            squares = (1e3 * inspection.displacement_m[shared]) ** 2
            along_u, along_v = squares.mean(axis=0).tolist()
            yield CommonPoints(
                cell=cell,
                step=step,
                kind=kind,
                n_found=len(mine),
                n_common=len(shared),
                rms_u_mm=math.sqrt(along_u),
                rms_v_mm=math.sqrt(along_v),
                rms_mm=math.sqrt(along_u + along_v),
            )


def _rows_of_points(inspection: Inspection) -> dict[tuple[str, bytes], int]:
    kinds = [inspection.kinds[index] for index in inspection.kind]
    points = np.ascontiguousarray(inspection.points_world)
    return {
        (kind, point.tobytes()): row
        for row, (kind, point) in enumerate(zip(kinds, points, strict=True))
    }
