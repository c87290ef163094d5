"""The tables of planes: size, exactness and thickness of each, and materials by place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from orthoflow_provenance.document import RecordedCell

from orthoflow.products import Planes, ScanRow, Spread, Thickness
from orthoflow.report.tables import PlaneTables, plane_tables
from tests.report_runs import HeldRun, cell, given, record

FABRIC = Spread(low=0.0, high=0.3, n_points=70, sigma_m=0.004, name="fabric")
PLASTER = Spread(low=0.3, high=1.0, n_points=90, sigma_m=0.001, name="plaster")


def wall_and_floor() -> Planes:
    wall = np.array([[0, 2, 3], [0, 2, 0], [4, 2, 0], [4, 2, 3]], dtype=np.float64)
    covariance = np.zeros((2, 4, 4))
    covariance[0, 3, 3] = 0.0005**2
    return Planes(
        normal=np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]),
        offset=np.array([-2.0, 0.0]),
        corners=np.array([wall, wall[:, [0, 2, 1]]]),
        covariance=covariance,
        n_points=np.array([1200, 800]),
        rms_m=np.array([0.002, 0.003]),
        up=np.array([0.0, 0.0, 1.0]),
        names=("wall 0", "floor"),
        viewpoint="stations",
    )


def tables(*made: tuple[RecordedCell, Planes]) -> list[PlaneTables]:
    """The tables of cells that give planes."""
    products = {(cell.address, "planes"): planes for cell, planes in made}
    recorded = record([cell for cell, _ in made])
    return list(plane_tables(HeldRun(path=Path("run.h5"), record=recorded, products=products)))


def giving(address: str, digest: str, **more: Any) -> RecordedCell:
    return cell(address, outputs={"planes": given("", digest, "planes")}, **more)


def test_thickness_and_materials_stand_in_the_tables() -> None:
    thickness = Thickness(
        sigma_m=0.002, width_95_m=0.008, scan_step_m=0.005, material=(FABRIC, PLASTER)
    )
    row = ScanRow(row=7, scan=1, n_points=40, sigma_m=0.001, material=(PLASTER,))
    planes = replace(wall_and_floor(), thickness=(thickness, None), scan_row=row)
    (found,) = tables((giving("plane@plane=toy", "a"), planes))
    assert [row[-2:] for row in found.planes.rows] == [("2.00", "5.00"), ("-", "-")]
    assert found.materials.rows == (
        ("wall 0", "fabric", "70", "4.00"),
        ("wall 0", "plaster", "90", "1.00"),
        ("row 7 of scan 1, wall 0", "plaster", "90", "1.00"),
    )


def test_planes_state_where_their_sides_come_from() -> None:
    planes = wall_and_floor()
    # Sides that photos found one by one: a table said `guess`, as the planes began.
    mixed = replace(planes, viewpoint="guess", side_from=("photos", "guess"))
    found = tables(
        (giving("plane", "a"), planes),
        (giving("turned", "b"), replace(planes, viewpoint="photos")),
        (giving("moved", "c"), replace(planes, offset=np.array([-2.5, 0.0]))),
        (giving("mixed", "e"), mixed),
    )
    assert [(table.cell, table.viewpoint) for table in found] == [
        ("plane", "stations"),
        ("turned", "photos"),
        ("moved", "stations"),
        ("mixed", "photos (1), guess (1)"),
    ]
    assert not any(table.taken_further(found) for table in found)


def test_planes_that_a_later_step_changed_are_taken_further() -> None:
    planes = wall_and_floor()
    sides = giving("sides", "b", inputs={"planes": given("plane.planes", "a", "planes")})
    found = tables(
        (giving("plane", "a"), planes),
        (sides, replace(planes, viewpoint="photos")),
    )
    assert [(one.cell, one.taken_further(found)) for one in found] == [
        ("plane", True),
        ("sides", False),
    ]
