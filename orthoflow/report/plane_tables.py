"""The planes that a run found, as tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from orthoflow.geometry import omega_phi_deg
from orthoflow.products import Planes, Spread, Thickness
from orthoflow.records.runs import Run
from orthoflow.report.pictures import embedded_products


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
    thickness_mm: float | None
    scan_step_mm: float | None


@dataclass(frozen=True, kw_only=True)
class MaterialRow:
    """How thick the cloud is on a material of one plane, or of one row of the scan."""

    place: str
    material: str
    n_points: int
    thickness_mm: float


@dataclass(frozen=True, kw_only=True)
class PlaneTable:
    """The planes of one cell.

    Attributes:
        cell: address of the cell.
        viewpoint: where the side of the viewer comes from, in words.
        rows: a row per plane.
        materials: thickness by place and material.
        later: cells that hand the same planes on.
        before: all cells that have a part in these planes.
    """

    cell: str
    viewpoint: str
    rows: tuple[PlaneRow, ...]
    materials: tuple[MaterialRow, ...]
    later: tuple[str, ...] = ()
    before: frozenset[str] = frozenset()

    def taken_further(self, tables: Iterable[PlaneTable]) -> bool:
        """Whether another of the tables shows what a later step made of these planes."""
        return any(self.cell in table.before for table in tables if table is not self)

    def differing(self, tables: Iterable[PlaneTable]) -> str:
        """In how many rows the last of the tables that take this one further differs, in words."""
        last = [table for table in tables if table is not self and self.cell in table.before][-1]
        count = sum(row not in last.rows for row in self.rows)
        of_all = f"{count} of {len(self.rows)} rows" if count else "no row"
        more = len(last.rows) - len(self.rows)
        fewer = f", which has {abs(more)} {'more' if more > 0 else 'fewer'}" if more else ""
        return f"{of_all} differ{'s' if count < 2 else ''} from {last.cell}{fewer}"


def plane_tables(run: Run) -> tuple[PlaneTable, ...]:
    """The planes of every cell that found some; those that print alike once."""
    found: dict[tuple[str, tuple[PlaneRow, ...], tuple[MaterialRow, ...]], PlaneTable] = {}
    for told in _told(run):
        key = (told.viewpoint, told.rows, told.materials)
        first = found.setdefault(key, told)
        if first is not told:
            found[key] = replace(first, later=(*first.later, told.cell))
    return tuple(found.values())


def _told(run: Run) -> Iterator[PlaneTable]:
    places = embedded_products(run, "planes")
    for (address, _), payload in zip(places, run.payloads(places), strict=True):
        planes = Planes.from_payload(payload)
        yield PlaneTable(
            cell=address,
            viewpoint=_viewpoint(planes),
            rows=tuple(_plane_row(planes, index) for index in range(len(planes))),
            materials=tuple(_material_rows(planes)),
            before=frozenset(cell.address for cell in run.upstream(address)) - {address},
        )


def _viewpoint(planes: Planes) -> str:
    """State where the sides come from, and of how many planes each where they differ."""
    counts = Counter(planes.side_source(index) for index in range(len(planes)))
    if not planes.side_from or len(counts) < 2:
        return planes.side_source(0) if planes.side_from else planes.viewpoint.replace("_", " ")
    return ", ".join(f"{source} ({count})" for source, count in counts.items())


def _plane_row(planes: Planes, index: int) -> PlaneRow:
    omega, phi = omega_phi_deg(planes.normal[index], planes.up)
    corners = planes.corners[index]
    width_m = float(np.linalg.norm(corners[3] - corners[0]))
    height_m = float(np.linalg.norm(corners[1] - corners[0]))
    thickness = _thickness(planes, index)
    return PlaneRow(
        name=planes.names[index],
        omega_deg=omega,
        phi_deg=phi,
        offset_m=float(planes.offset[index]),
        sigma_mm=1000 * planes.sigma_offset_m(index),
        size=f"{width_m:.2f} x {height_m:.2f} m",
        n_points=int(planes.n_points[index]),
        rms_mm=1000 * float(planes.rms_m[index]),
        thickness_mm=None if thickness is None else 1000.0 * thickness.sigma_m,
        scan_step_mm=None if thickness is None else 1000.0 * thickness.scan_step_m,
    )


def _thickness(planes: Planes, index: int) -> Thickness | None:
    """What a detector measured on a plane; nothing for planes that were given."""
    return planes.thickness[index] if planes.thickness else None


def _material_rows(planes: Planes) -> Iterator[MaterialRow]:
    places: list[tuple[str, tuple[Spread, ...]]] = []
    for name, thickness in zip(planes.names, planes.thickness, strict=False):
        if thickness is not None:
            places.append((name, thickness.material))
    row = planes.scan_row
    if row is not None:
        places.append((f"row {row.row} of scan {row.scan}, {planes.names[0]}", row.material))
    for place, spreads in places:
        for spread in spreads:
            yield MaterialRow(
                place=place,
                material=str(spread.name),
                n_points=spread.n_points,
                thickness_mm=1000.0 * spread.sigma_m,
            )
