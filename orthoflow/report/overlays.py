"""Ties with their residuals, and displacements, as vectors drawn over the walls."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.foreign_text import shown
from orthoflow.geometry import WallFrame
from orthoflow.products import Camera, Cameras, Inspection, TieRole, Ties
from orthoflow.records.runs import Run
from orthoflow.report.pictures import Picture, embedded_products

_MARKS_MOST: Final = 600  # in one drawing
_MARKS_FEW: Final = 50
_MARKS_IN_ALL: Final = 12_000  # on a page, about 130 bytes each
# Drawn length of a vector of RMS length, as a share of the drawing's longer side.
_RMS_SHARE: Final = 0.025
_STEP_M: Final = 1e-3  # for derivatives; photos change by about a pixel over it
# Magnifications are round numbers, so that they can be said.
_ROUND: Final = np.array([1, 2, 5], dtype=np.float64)
# Colours of markiewicz2015, Figure 17; shapes say the same to those who cannot tell colours.
_ROLES: Final[Mapping[int, str]] = {
    TieRole.CONTROL: "control",
    TieRole.CHECK: "check",
    TieRole.REJECTED: "rejected",
}


@dataclass(frozen=True, kw_only=True)
class Overlay:
    """A drawing over the picture of a wall.

    Attributes:
        svg: an `<svg>` element with transparent ground.
        title: what it shows.
        caption: magnification and counts, in words.
        cell: address of the cell that gave the vectors.
        walls_cell: address of the cell that made the wall's raster.
        wall: index of the wall.
        name: of the wall.
        check_rms_mm: RMS of the ties that only check along u and v, None without any.
    """

    svg: str
    title: str
    caption: str
    cell: str
    walls_cell: str
    wall: int
    name: str
    check_rms_mm: tuple[float, float] | None


@dataclass(frozen=True, kw_only=True)
class Vectors:
    """Vectors on one wall.

    Attributes:
        pixels_wall: (n, 2) float64 (column, row).
        lengths_m: (n, 2) float64 metres along u and v.
        kinds: (n,) name of each vector's kind, a CSS class.
    """

    pixels_wall: NDArray[np.float64]
    lengths_m: NDArray[np.float64]
    kinds: NDArray[np.str_]


def overlays(run: Run, walls: Sequence[Picture], *, share: float = 1.0) -> Iterator[Overlay]:
    """Draw the ties of every orientation and the displacements of every inspection of a run.

    Args:
        run: the run.
        walls: pictures of its walls, which the drawings lie over.
        share: which part of a page's bytes they may take.
    """
    places = embedded_products(run, "cameras")
    n_places = len(places) + len(embedded_products(run, "inspection"))
    if not n_places:
        return
    frames = _Frames.of(run, walls, share=share / n_places)
    for (address, _), payload in zip(places, run.payloads(places), strict=True):
        cameras = Cameras.from_payload(payload)
        if cameras.ties is not None:
            yield from _tie_overlays(address, cameras, cameras.ties, frames)
    places = embedded_products(run, "inspection")
    for (address, _), payload in zip(places, run.payloads(places), strict=True):
        inspection = Inspection.from_payload(payload)
        yield from _inspection_overlays(address, inspection, frames)


def residuals_on_wall(
    camera: Camera,
    points_world: NDArray[np.float64],
    residual_px: NDArray[np.float64],
    frame: WallFrame,
) -> NDArray[np.float64]:
    """What residuals in a photo amount to on the wall.

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
    along_u = (viewing.project(points + _STEP_M * frame.u_world)[:, :2] - at) / _STEP_M
    along_v = (viewing.project(points + _STEP_M * frame.v_world)[:, :2] - at) / _STEP_M
    # The 2 x 2 system of each point by Cramer's rule; a wall seen edge-on has no answer.
    determinant = along_u[:, 0] * along_v[:, 1] - along_u[:, 1] * along_v[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = (residual_px[:, 0] * along_v[:, 1] - residual_px[:, 1] * along_v[:, 0]) / determinant
        v = (residual_px[:, 1] * along_u[:, 0] - residual_px[:, 0] * along_u[:, 1]) / determinant
    return np.column_stack([u, v])


def draw_vectors(frame: WallFrame, vectors: Vectors, *, label: str, magnification: float) -> str:
    """Draw vectors with a mark at their foot as an `<svg>` element in the wall's cells."""
    radius = max(frame.width, frame.height) / 260
    ends = vectors.pixels_wall + magnification * vectors.lengths_m / frame.gsd_m
    marks = [
        _mark(kind, foot, radius) + _line(kind, foot, end)
        for kind, foot, end in zip(
            vectors.kinds.tolist(), vectors.pixels_wall.tolist(), ends.tolist(), strict=True
        )
    ]
    return (
        f'<svg class="over" viewBox="0 0 {frame.width} {frame.height}" role="img" '
        f'aria-label="{escape(shown(label))}" stroke-width="{radius / 2:.3g}">'
        f"{''.join(marks)}</svg>"
    )


def magnification_for(frame: WallFrame, lengths_m: NDArray[np.float64]) -> float:
    """Return a round number by which vectors are enlarged so that they can be seen."""
    known = lengths_m[np.isfinite(lengths_m).all(axis=1)]
    rms_m = float(np.sqrt(np.mean(np.sum(known**2, axis=1)))) if len(known) else 0.0
    if rms_m == 0.0:
        return 1.0
    wanted = _RMS_SHARE * max(frame.width, frame.height) * frame.gsd_m / rms_m
    power = 10.0 ** np.floor(np.log10(wanted))
    steps = _ROUND[_ROUND * power <= wanted * (1 + 1e-9)]
    return float(max(1.0, power * steps.max()))


@dataclass(frozen=True, kw_only=True)
class _Known:
    """A wall that drawings lie over."""

    name: str
    frame: WallFrame


@dataclass(frozen=True, kw_only=True)
class _Frames:
    """Finds the wall rasters behind a cell.

    Attributes:
        run: the run.
        known: digest of a walls product -> pictures of its walls by their index.
        cells: digest of a walls product -> the cell whose pictures the page shows.
        marks_most: in each drawing.
    """

    run: Run
    known: Mapping[str, Mapping[int, _Known]]
    cells: Mapping[str, str]
    marks_most: int

    @staticmethod
    def of(run: Run, pictures: Sequence[Picture], *, share: float) -> _Frames:
        """Take the frames from the pictures of walls."""
        known: dict[str, dict[int, _Known]] = {}
        cells: dict[str, str] = {}
        for picture in pictures:
            if picture.frame is None:
                continue
            for product in run.cells[picture.cell].outputs.values():
                if product.type_name == "walls":
                    at = _Known(name=picture.name, frame=picture.frame)
                    known.setdefault(product.digest, {})[picture.wall] = at
                    cells[product.digest] = picture.cell
        n_walls = max((len(frames) for frames in known.values()), default=1)
        wanted = round(share * _MARKS_IN_ALL / n_walls)
        return _Frames(
            run=run,
            known=known,
            cells=cells,
            marks_most=min(_MARKS_MOST, max(_MARKS_FEW, wanted)),
        )

    def behind(self, address: str) -> tuple[str, Mapping[int, _Known]]:
        """Address, names and frames of the nearest walls that went into a cell."""
        for cell in self.run.upstream(address):
            for given in cell.inputs.values():
                if given.digest in self.known:
                    return self.cells[given.digest], self.known[given.digest]
        return "", {}


def _tie_overlays(address: str, cameras: Cameras, ties: Ties, frames: _Frames) -> Iterator[Overlay]:
    walls_cell, known = frames.behind(address)
    lengths_m = np.full((len(ties.photo), 2), np.nan)
    by_name = {camera.photo: camera for camera in cameras.cameras}
    for index, name in enumerate(ties.photo_names):
        camera = by_name.get(name)
        if camera is None or camera.status != "ok":
            continue
        for wall, at in known.items():
            here = (ties.photo == index) & (ties.wall == wall)
            lengths_m[here] = residuals_on_wall(
                camera, ties.points_world[here], ties.residual_px[here], at.frame
            )
    kinds = np.array([_ROLES[TieRole(role)] for role in ties.role.tolist()], dtype=np.str_)
    for wall, at in known.items():
        here = np.flatnonzero((ties.wall == wall) & np.isfinite(lengths_m).all(axis=1))
        if len(here):
            vectors = Vectors(
                pixels_wall=at.frame.wall_from_world(ties.points_world[here])[:, :2],
                lengths_m=lengths_m[here],
                kinds=kinds[here],
            )
            place = _Place(cell=address, walls_cell=walls_cell, wall=wall, known=at)
            yield _overlay(place, vectors, what="ties of", marks_most=frames.marks_most)


def _inspection_overlays(
    address: str, inspection: Inspection, frames: _Frames
) -> Iterator[Overlay]:
    if not len(inspection.wall):
        return
    walls_cell, known = frames.behind(address)
    for wall, at in known.items():
        here = np.flatnonzero(
            (inspection.wall == wall) & np.isfinite(inspection.displacement_m).all(axis=1)
        )
        if len(here):
            vectors = Vectors(
                pixels_wall=at.frame.wall_from_world(inspection.points_world[here])[:, :2],
                lengths_m=inspection.displacement_m[here],
                kinds=np.full(len(here), "shown"),
            )
            place = _Place(cell=address, walls_cell=walls_cell, wall=wall, known=at)
            names = np.array(inspection.kinds)[inspection.kind[here]]
            yield _overlay(
                place,
                vectors,
                what="displacements in the orthoimage of",
                marks_most=frames.marks_most,
                # The numbers of a method leave out what lies beside depth steps.
                counted=f"{_counts(replace(vectors, kinds=names))}, beside depth steps, too",
            )


@dataclass(frozen=True, kw_only=True)
class _Place:
    """Where a drawing belongs."""

    cell: str
    walls_cell: str
    wall: int
    known: _Known


def _overlay(
    place: _Place, vectors: Vectors, *, what: str, marks_most: int, counted: str = ""
) -> Overlay:
    frame = place.known.frame
    judged = vectors.kinds != "rejected"
    magnification = magnification_for(frame, vectors.lengths_m[judged])
    shown = _spread_evenly(vectors, marks_most)
    # Rejected ties may be metres off: a mark says that they are there, a vector would cross all.
    lengths_m = np.where((shown.kinds == "rejected")[:, None], 0.0, shown.lengths_m)
    shown = Vectors(pixels_wall=shown.pixels_wall, lengths_m=lengths_m, kinds=shown.kinds)
    caption = f"{counted or _counts(vectors)}; vectors drawn {magnification:g} times as long" + (
        "" if len(shown.kinds) == len(vectors.kinds) else f", {len(shown.kinds)} of them shown"
    )
    title = f"{what} {place.known.name}, {place.cell}"
    return Overlay(
        svg=draw_vectors(frame, shown, label=f"{title}: {caption}", magnification=magnification),
        title=title[0].upper() + title[1:],
        caption=caption,
        cell=place.cell,
        walls_cell=place.walls_cell,
        wall=place.wall,
        name=place.known.name,
        check_rms_mm=_rms_mm(vectors, "check") if "check" in vectors.kinds else None,
    )


def _rms_mm(vectors: Vectors, kind: str) -> tuple[float, float]:
    u, v = 1e3 * np.sqrt(np.mean(vectors.lengths_m[vectors.kinds == kind] ** 2, axis=0))
    return float(u), float(v)


def _counts(vectors: Vectors) -> str:
    parts = []
    for kind in dict.fromkeys(vectors.kinds.tolist()):
        here = vectors.kinds == kind
        u, v = _rms_mm(vectors, kind)
        rms = "" if kind == "rejected" else f" (RMS {u:.2f} mm along u, {v:.2f} mm along v)"
        parts.append(f"{int(here.sum())} {kind}{rms}")
    return ", ".join(parts)


def _spread_evenly(vectors: Vectors, most: int) -> Vectors:
    n_vectors = len(vectors.kinds)
    if n_vectors <= most:
        return vectors
    chosen = np.unique(np.linspace(0, n_vectors - 1, most).astype(np.int64))
    return Vectors(
        pixels_wall=vectors.pixels_wall[chosen],
        lengths_m=vectors.lengths_m[chosen],
        kinds=vectors.kinds[chosen],
    )


def _mark(kind: str, foot: Sequence[float], radius: float) -> str:
    u, v = foot
    if kind == "check":
        side = 2 * radius
        return (
            f'<rect class="{kind}" x="{u - radius:.1f}" y="{v - radius:.1f}" '
            f'width="{side:.3g}" height="{side:.3g}"/>'
        )
    if kind == "rejected":
        return (
            f'<path class="{kind}" d="M{u - radius:.1f} {v - radius:.1f}L{u + radius:.1f} '
            f"{v + radius:.1f}M{u - radius:.1f} {v + radius:.1f}L{u + radius:.1f} "
            f'{v - radius:.1f}"/>'
        )
    return f'<circle class="{escape(kind)}" cx="{u:.1f}" cy="{v:.1f}" r="{radius:.3g}"/>'


def _line(kind: str, foot: Sequence[float], end: Sequence[float]) -> str:
    if end == foot:
        return ""
    return (
        f'<path class="{escape(kind)}" d="M{foot[0]:.1f} {foot[1]:.1f}L{end[0]:.1f} {end[1]:.1f}"/>'
    )
