"""The planes that a run found, as tables."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from orthoflow.geometry import omega_phi_deg
from orthoflow.products import Planes
from orthoflow.records import Run
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
    """The planes of one cell."""

    cell: str
    viewpoint: str
    rows: tuple[PlaneRow, ...]
    materials: tuple[MaterialRow, ...]


def plane_tables(run: Run) -> Iterator[PlaneTable]:
    """The planes of every cell that found some; equal planes of several cells once."""
    places = embedded_products(run, "planes")
    for (address, _), payload in zip(places, run.payloads(places), strict=True):
        planes = Planes.from_payload(payload)
        yield PlaneTable(
            cell=address,
            viewpoint=planes.viewpoint,
            rows=tuple(_plane_row(planes, index) for index in range(len(planes))),
            materials=tuple(_material_rows(planes)),
        )


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
        sigma_mm=1000 * _offset_sigma_m(planes, index),
        size=f"{width_m:.2f} x {height_m:.2f} m",
        n_points=int(planes.n_points[index]),
        rms_mm=1000 * float(planes.rms_m[index]),
        thickness_mm=_in_mm(thickness.get("sigma_m")),
        scan_step_mm=_in_mm(thickness.get("scan_step_m")),
    )


def _thickness(planes: Planes, index: int) -> Mapping[str, object]:
    """What a detector measured on a plane; nothing for planes that were given."""
    told = planes.details.get("thickness")
    item = told[index] if isinstance(told, Sequence) and index < len(told) else None
    return item if isinstance(item, Mapping) else {}


def _material_rows(planes: Planes) -> Iterator[MaterialRow]:
    places = [(planes.names[k], _thickness(planes, k)) for k in range(len(planes))]
    row = planes.details.get("scan_row")
    if isinstance(row, Mapping):
        places.append((f"row {row.get('row')} of scan {row.get('scan')}, {planes.names[0]}", row))
    for place, told in places:
        found = told.get("material", ())
        for item in found if isinstance(found, Sequence) else ():
            if isinstance(item, Mapping):
                yield MaterialRow(
                    place=place,
                    material=str(item["name"]),
                    n_points=int(str(item["n_points"])),
                    thickness_mm=1000.0 * float(str(item["sigma_m"])),
                )


def _in_mm(value: object) -> float | None:
    return 1000.0 * value if isinstance(value, float) else None


def _offset_sigma_m(planes: Planes, index: int) -> float:
    # Along the normal at the rectangle's centre, not at the far origin, where the angle's
    # uncertainty would swamp it: offset error = n' x - d with x fixed.
    centre = planes.corners[index].mean(axis=0)
    gradient = np.append(centre, -1.0)
    variance = float(gradient @ planes.covariance[index] @ gradient)
    return math.sqrt(max(0.0, variance))
