"""Plan view of walls and photo positions, with a table of the photos."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.key_plans import axis_words
from orthoflow.geometry import WallFrame, basis_from_up
from orthoflow.products import Camera, Cameras, Planes, TieRole, Ties
from orthoflow.records.runs import Run
from orthoflow.report.charts import ChartFormat, PlanPhoto, PlanWall, as_image, plan_chart
from orthoflow.report.combinations import baseline_cells
from orthoflow.report.pictures import Picture, embedded_products, products_of
from orthoflow.report.tables import Column, Table
from orthoflow.untrusted_text import Value, first_few


@dataclass(frozen=True, kw_only=True)
class PhotoPlan:
    """Plan view of the result of one orientation.

    Attributes:
        walls: walls in plan view.
        photos: oriented photos in plan view.
        caption: description, which lists the photos that are not oriented.
        cell: address of the cell of the orientation.
        table: quality of the orientation of each photo.
        axes: labels of the scan axes that point to the right and upwards in the plan.
    """

    walls: tuple[PlanWall, ...]
    photos: tuple[PlanPhoto, ...]
    caption: str
    cell: str
    table: Table
    axes: tuple[str, ...]

    @property
    def picture(self) -> Picture:
        """The plan as a picture on a page."""
        return Picture(
            uri=as_image(self.file("svg")),
            title="Plan of photos and walls",
            caption=self.caption,
        )

    def file(self, suffix: ChartFormat) -> bytes:
        """Return the plan as a file."""
        return plan_chart(self.walls, self.photos, labels=self.axes, suffix=suffix)


def photo_plan(run: Run, walls: Sequence[Picture]) -> PhotoPlan | None:
    """Return the plan for the baseline's last orientation; None if no photo is oriented.

    Args:
        run: the run.
        walls: pictures of the run's walls.
    """
    baseline = {cell.address for cell in baseline_cells(run)}
    every = [cell for cell, _ in embedded_products(run, "cameras")]
    chosen = [cell for cell in every if cell in baseline][-1:] or every[-1:]
    for address, orientation in products_of(run, Cameras, chosen):
        cameras = orientation.cameras
        oriented = [one for one in cameras if one.status == "ok"]
        if oriented:
            # Each wall has two pictures, for intensity and depth, with the same frame.
            frames = {
                picture.number: (picture.name, picture.frame)
                for picture in walls
                if picture.frame is not None and picture.cell in (baseline or {picture.cell})
            }
            up = _up(run)
            drawn_walls, photos = _drawn(up, oriented, frames)
            return PhotoPlan(
                walls=drawn_walls,
                photos=photos,
                axes=tuple(f"{axis_words(axis)} / m" for axis in basis_from_up(up)[:2]),
                caption=_caption(address, cameras, oriented),
                cell=address,
                table=_table(orientation),
            )
    return None


def _table(orientation: Cameras) -> Table:
    squares: dict[str, list[float]] = {}
    for residual in orientation.residual_table:
        if (residual.role, residual.unit) == ("check", "mm"):
            squares.setdefault(residual.photo, []).append(residual.rmse**2)
    cameras, ties = orientation.cameras, orientation.ties
    control, check = (_counts(ties, role) for role in (TieRole.CONTROL, TieRole.CHECK))
    rows = []
    for camera in cameras:
        values: list[Value] = [None] * 4
        if camera.status == "ok":
            if camera.sigma_wall_m is not None:
                values[0] = 1000 * camera.sigma_wall_m
            if own := squares.get(camera.photo):
                values[1] = math.sqrt(sum(own) / len(own))
            if ties is not None:
                values[2:] = [counts.get(camera.photo, 0) for counts in (check, control)]
        rows.append((camera.photo, *values, camera.status))
    return Table(
        name="photos",
        caption="accuracy of the orientation of each photo, per coordinate on the wall",
        columns=(
            Column("photo", is_numeric=False),
            *(
                Column(label, digits=3)
                for label in ("expected error / mm", "withheld ties, RMS / mm")
            ),
            *(Column(label) for label in ("withheld ties", "control ties")),
            Column("status", is_numeric=False),
        ),
        rows=tuple(rows),
    )


def _counts(ties: Ties | None, role: TieRole) -> dict[str, int]:
    if ties is None:
        return {}
    counts = np.bincount(ties.photo[ties.role == role], minlength=len(ties.photo_names))
    return dict(zip(ties.photo_names, counts.tolist(), strict=True))


def _up(run: Run) -> NDArray[np.float64]:
    planes = next((product for _, product in products_of(run, Planes)), None)
    return np.array([0.0, 0.0, 1.0] if planes is None else planes.up, dtype=np.float64)


def _caption(address: str, cameras: Sequence[Camera], oriented: Sequence[Camera]) -> str:
    refused = [one.photo for one in cameras if one.status != "ok"]
    missing = (
        f" Not oriented and therefore not shown: {first_few(refused, most=6)}." if refused else ""
    )
    return (
        f"{len(oriented)} of {len(cameras)} photos, {address}: plan of the walls, with dots at the "
        "positions of photos and lines in their viewing directions. A photo behind a wall, or one "
        "that faces no wall, is oriented wrongly; a wall seen only at oblique angles has a poor "
        f"orthoimage.{missing}"
    )


def _drawn(
    up: NDArray[np.float64],
    oriented: Sequence[Camera],
    walls: Mapping[int, tuple[str, WallFrame]],
) -> tuple[tuple[PlanWall, ...], tuple[PlanPhoto, ...]]:
    axes = basis_from_up(up)[:2].T
    viewing = {camera.photo: camera.viewing() for camera in oriented}
    return (
        tuple(
            (
                name,
                number,
                frame.corners_world() @ axes
                if frame.bend is None
                else frame.outline_world() @ axes,
            )
            for number, (name, frame) in walls.items()
        ),
        # The third row of the rotation matrix is the viewing direction.
        tuple(
            (name, one.centre_world @ axes, one.rotation[2] @ axes) for name, one in viewing.items()
        ),
    )
