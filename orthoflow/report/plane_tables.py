"""The planes that a run found, as tables."""

from __future__ import annotations

import math
from collections.abc import Iterator
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


@dataclass(frozen=True, kw_only=True)
class PlaneTable:
    """The planes of one cell."""

    cell: str
    viewpoint: str
    rows: tuple[PlaneRow, ...]


def plane_tables(run: Run) -> Iterator[PlaneTable]:
    """The planes of every cell that found some; equal planes of several cells once."""
    places = embedded_products(run, "planes")
    for (address, _), payload in zip(places, run.payloads(places), strict=True):
        planes = Planes.from_payload(payload)
        yield PlaneTable(
            cell=address,
            viewpoint=planes.viewpoint,
            rows=tuple(_plane_row(planes, index) for index in range(len(planes))),
        )


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
