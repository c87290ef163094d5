"""Ties with their residuals, and displacements, as vectors drawn over the walls."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.papers import round_below
from orthoflow.geometry import WallFrame
from orthoflow.products import Camera, Cameras, Inspection, TieRole
from orthoflow.records.runs import Run
from orthoflow.report.pictures import Picture, embedded_products, frame_of

_MARKS_MOST: Final = 600  # in one drawing
_MARKS_FEW: Final = 50
_MARKS_IN_ALL: Final = 12_000  # on a page, about 130 bytes each
# Drawn length of a vector of RMS length, and of the reference, as shares of the longer side.
_RMS_SHARE: Final = 0.025
_REFERENCE_SHARE: Final = 0.08
_STEP_M: Final = 1e-3  # for derivatives; photos change by about a pixel over it


@dataclass(frozen=True, kw_only=True)
class Overlay:
    """A drawing over the picture of a wall, in its cells.

    Attributes:
        title: what it shows.
        caption: magnification and counts, in words.
        cell: address of the cell that gave the vectors.
        ground: the picture that it lies over.
        marks: kind, and (column, row) of foot and end, of each vector.
        reference: words and length of a reference arrow.
    """

    title: str
    caption: str
    cell: str
    ground: Picture
    marks: Sequence[tuple[str, tuple[float, float, float, float]]]
    reference: tuple[str, float]

    @property
    def frame(self) -> WallFrame:
        """Frame of the wall's raster."""
        return frame_of(self.ground)


def overlays(run: Run, walls: Sequence[Picture], *, share: float = 1.0) -> Iterator[Overlay]:
    """Draw the ties of every orientation and the displacements of every inspection of a run.

    Args:
        run: the run.
        walls: pictures of its walls, which the drawings lie over.
        share: which part of a page's bytes they may take.
    """
    cameras, inspections = (embedded_products(run, name) for name in ("cameras", "inspection"))
    # Digest of a walls product -> the first picture of each of its walls.
    known: dict[str, dict[int, Picture]] = {}
    for picture in walls:
        for product in run.cells[picture.cell].outputs.values():
            if product.type_name == "walls" and picture.frame is not None:
                known.setdefault(product.digest, {}).setdefault(picture.wall, picture)
    n_drawings = (len(cameras) + len(inspections)) * max(map(len, known.values()), default=1)
    most = min(_MARKS_MOST, max(_MARKS_FEW, round(share * _MARKS_IN_ALL / max(1, n_drawings))))
    for (address, _), payload in zip(cameras, run.payloads(cameras), strict=True):
        yield from _of_ties(
            address, Cameras.from_payload(payload), _behind(run, address, known), most
        )
    for (address, _), payload in zip(inspections, run.payloads(inspections), strict=True):
        found = Inspection.from_payload(payload)
        for wall, ground in _behind(run, address, known).items():
            here = (found.wall == wall) & np.isfinite(found.displacement_m).all(axis=1)
            if here.any():
                lengths_m = found.displacement_m[here]
                names = np.array(found.kinds)[found.kind[here]]
                yield _overlay(
                    address,
                    ground,
                    (found.points_world[here], lengths_m, np.full(len(names), "shown")),
                    f"Displacements in the orthoimage of {ground.name}, {address}",
                    # The numbers of a method leave out what lies beside depth steps.
                    f"{_counts(names, lengths_m)}, beside depth steps, too",
                    most,
                )


def _behind(
    run: Run, address: str, known: Mapping[str, Mapping[int, Picture]]
) -> Mapping[int, Picture]:
    """Pictures of the nearest walls that went into a cell."""
    for cell in run.upstream(address):
        for given in cell.inputs.values():
            if given.digest in known:
                return known[given.digest]
    return {}


def _of_ties(
    address: str, cameras: Cameras, grounds: Mapping[int, Picture], most: int
) -> Iterator[Overlay]:
    ties = cameras.ties
    if ties is None:
        return
    lengths_m = np.full((len(ties.photo), 2), np.nan)
    by_name = {camera.photo: camera for camera in cameras.cameras if camera.status == "ok"}
    for index, name in enumerate(ties.photo_names):
        for wall, ground in grounds.items() if name in by_name else ():
            here = (ties.photo == index) & (ties.wall == wall)
            lengths_m[here] = residuals_on_wall(
                by_name[name], ties.points_world[here], ties.residual_px[here], frame_of(ground)
            )
    kinds = np.array([TieRole(role).name.lower() for role in ties.role.tolist()], dtype=np.str_)
    for wall, ground in grounds.items():
        here = np.flatnonzero((ties.wall == wall) & np.isfinite(lengths_m).all(axis=1))
        if len(here):
            yield _overlay(
                address,
                ground,
                (ties.points_world[here], lengths_m[here], kinds[here]),
                f"Ties of {ground.name}, {address}",
                _counts(kinds[here], lengths_m[here]),
                most,
            )


def residuals_on_wall(
    camera: Camera,
    points_world: NDArray[np.float64],
    residual_px: NDArray[np.float64],
    frame: WallFrame,
) -> NDArray[np.float64]:
    """Convert residuals in a photo to the wall.

    Args:
        camera: an oriented one.
        points_world: (n, 3) metres.
        residual_px: (n, 2) observed - computed.
        frame: its u and v are the axes of the answer.

    Returns:
        (n, 2) metres along u and v; NaN where the photo does not show the point.
    """
    viewing = camera.viewing().shifted(frame.origin_world)
    points = points_world - frame.origin_world
    at = viewing.project(points)[:, :2]
    along = [
        (viewing.project(points + _STEP_M * axis)[:, :2] - at) / _STEP_M
        for axis in (frame.u_world, frame.v_world)
    ]
    jacobian = np.stack(along, axis=2)
    found = np.full((len(points), 2), np.nan)
    # A wall seen edge-on has no answer.
    solvable = np.isfinite(jacobian).all(axis=(1, 2)) & (np.linalg.det(jacobian) != 0.0)
    found[solvable] = np.linalg.solve(jacobian[solvable], residual_px[solvable, :, None])[..., 0]
    return found


def magnification_for(frame: WallFrame, lengths_m: NDArray[np.float64]) -> float:
    """Return a round number by which vectors are enlarged so that they can be seen."""
    known = lengths_m[np.isfinite(lengths_m).all(axis=1)]
    rms_m = float(np.sqrt(np.mean(np.sum(known**2, axis=1)))) if len(known) else 0.0
    if rms_m == 0.0:
        return 1.0
    return max(1.0, round_below(_RMS_SHARE * max(frame.width, frame.height) * frame.gsd_m / rms_m))


def _overlay(
    address: str,
    ground: Picture,
    vectors: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.str_]],
    title: str,
    counted: str,
    most: int,
) -> Overlay:
    """Draw vectors: world points (n, 3), lengths (n, 2) in metres along u and v, and kinds (n,)."""
    points_world, lengths_m, kinds = vectors
    frame = frame_of(ground)
    magnification = magnification_for(frame, lengths_m[kinds != "rejected"])
    # Left out evenly. Rejected ties may be metres off: a mark shows them.
    chosen = np.unique(np.linspace(0, len(kinds) - 1, min(most, len(kinds))).astype(np.int64))
    drawn_m = np.where((kinds == "rejected")[:, None], 0.0, lengths_m)[chosen]
    feet = frame.wall_from_world(points_world[chosen])[:, :2]
    ends = np.hstack([feet, feet + magnification * drawn_m / frame.gsd_m])
    reference_px = _REFERENCE_SHARE * max(frame.width, frame.height)
    reference_mm = round_below(1e3 * reference_px * frame.gsd_m / magnification)
    some = "" if len(chosen) == len(kinds) else f", {len(chosen)} of them shown"
    return Overlay(
        title=title,
        caption=f"{counted}; vectors drawn {magnification:g} times as long{some}",
        cell=address,
        ground=ground,
        marks=[
            (kind, (row[0], row[1], row[2], row[3]))
            for kind, row in zip(kinds[chosen].tolist(), ends.tolist(), strict=True)
        ],
        reference=(f"{reference_mm:g} mm", 1e-3 * reference_mm * magnification / frame.gsd_m),
    )


def _counts(kinds: NDArray[np.str_], lengths_m: NDArray[np.float64]) -> str:
    parts = []
    for kind in dict.fromkeys(kinds.tolist()):
        here = kinds == kind
        u, v = 1e3 * np.sqrt(np.mean(lengths_m[here] ** 2, axis=0))
        rms = "" if kind == "rejected" else f" (RMS {u:.2f} mm along u, {v:.2f} mm along v)"
        parts.append(f"{int(here.sum())} {kind}{rms}")
    return ", ".join(parts)
