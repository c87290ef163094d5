"""Drawings of tie residuals and of displacements on pictures of the walls."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawing import COLUMN_INCHES, encode_chart, picture_figure, styled
from orthoflow.files.drawings.sheet_contents import round_below
from orthoflow.files.images import decode_image
from orthoflow.geometry import WallFrame
from orthoflow.products import Camera, Cameras, Inspection, TieRole
from orthoflow.records.runs import Run
from orthoflow.report.pictures import (
    Picture,
    data_uri,
    embedded_products,
    frame_of,
    products_of,
    side_px,
)

_MAX_MARKS: Final = 600  # per drawing
# Drawn lengths of a vector of RMS length and of the reference vector, as shares of the longer side
# of the wall.
_RMS_SHARE: Final = 0.025
_REFERENCE_SHARE: Final = 0.08
_STEP_M: Final = 1e-3  # for derivatives; changes a position in a photo by about one pixel
# Kind of tie -> marker and colour, which are visible on light and dark pictures.
_MARKERS: Final = {
    "control": ("o", "#3ee066"),
    "check": ("s", "#ffe11f"),
    "rejected": ("x", "#ff3b30"),
}
_OTHERS: Final = ("o", "#4db8ff")
# World points (n, 3) in metres, vectors (n, 2) along u and v in metres, and kinds (n,).
_Vectors: TypeAlias = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.str_]]


def overlays(run: Run, walls: Sequence[Picture], *, share: float = 1.0) -> Iterator[Picture]:
    """Draw the ties of all orientations and the displacements of all inspections of a run.

    Args:
        run: the run.
        walls: pictures of the run's walls, used as backgrounds.
        share: the part of a page's size limit that the drawings may use, from 0 to 1.
    """
    cameras, inspections = (embedded_products(run, name) for name in ("cameras", "inspection"))
    # Digest of a walls product -> wall -> first picture of the wall.
    known: dict[str, dict[int, Picture]] = {}
    for picture in walls:
        for product in run.cells[picture.cell].outputs.values():
            if product.type_name == "walls" and picture.frame is not None:
                known.setdefault(product.digest, {}).setdefault(picture.wall, picture)
    n_drawings = (len(cameras) + len(inspections)) * max(map(len, known.values()), default=1)
    side = side_px(n_drawings / share)
    for address, oriented in products_of(run, Cameras):
        yield from _of_ties(address, oriented, _walls_before(run, address, known), side)
    for address, found in products_of(run, Inspection):
        for wall, ground in _walls_before(run, address, known).items():
            here = (found.wall == wall) & np.isfinite(found.displacement_m).all(axis=1)
            if here.any():
                yield _overlay(
                    address,
                    ground,
                    (
                        found.points_world[here],
                        found.displacement_m[here],
                        np.array(found.kinds)[found.kind[here]],
                    ),
                    f"Displacements in the orthoimage of {ground.name}, {address}",
                    side,
                    # The metrics of the method do not include these points.
                    remark="points next to depth steps are included; ",
                )


def _walls_before(
    run: Run, address: str, known: Mapping[str, Mapping[int, Picture]]
) -> Mapping[int, Picture]:
    for cell in run.upstream(address):
        for given in cell.inputs.values():
            if given.digest in known:
                return known[given.digest]
    return {}


def _of_ties(
    address: str, cameras: Cameras, grounds: Mapping[int, Picture], side: int
) -> Iterator[Picture]:
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
                side,
            )


def residuals_on_wall(
    camera: Camera,
    points_world: NDArray[np.float64],
    residual_px: NDArray[np.float64],
    frame: WallFrame,
) -> NDArray[np.float64]:
    """Convert residuals in a photo to displacements on a wall.

    Args:
        camera: an oriented photo.
        points_world: (n, 3) points in metres.
        residual_px: (n, 2) residuals, observed minus computed.
        frame: frame of the wall.

    Returns:
        (n, 2) displacements along u and v in metres; NaN for points outside the photo.
    """
    viewing = camera.viewing().shifted(frame.origin_world)
    points = points_world - frame.origin_world
    at = viewing.project(points)[:, :2]
    along = [
        (viewing.project(points + _STEP_M * axis)[:, :2] - at) / _STEP_M
        for axis in _axes_at(frame, points_world)
    ]
    jacobian = np.stack(along, axis=2)
    found = np.full((len(points), 2), np.nan)
    # There is no solution if the wall is seen edge-on.
    solvable = np.asarray(np.isfinite(jacobian).all(axis=(1, 2)))
    solvable[solvable] = np.linalg.det(jacobian[solvable]) != 0.0
    found[solvable] = np.linalg.solve(jacobian[solvable], residual_px[solvable, :, None])[..., 0]
    return found


def _axes_at(frame: WallFrame, points_world: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return u and v, (3,) each on a plane and (n, 3) each at the points of a cylinder."""
    if frame.bend is None:
        return [frame.u_world, frame.v_world]
    local = frame.axes_at(frame.wall_from_world(points_world)[:, :2])
    return [local[:, 0], local[:, 1]]


def magnification_for(frame: WallFrame, lengths_m: NDArray[np.float64]) -> float:
    """Return the magnification, a round number, at which vectors (n, 2) in metres are visible."""
    known = lengths_m[np.isfinite(lengths_m).all(axis=1)]
    rms_m = float(np.sqrt(np.mean(np.sum(known**2, axis=1)))) if len(known) else 0.0
    if rms_m == 0.0:
        return 1.0
    return max(1.0, round_below(_RMS_SHARE * max(frame.width, frame.height) * frame.gsd_m / rms_m))


def _overlay(
    address: str,
    ground: Picture,
    vectors: _Vectors,
    title: str,
    side: int,
    *,
    remark: str = "",
) -> Picture:
    points_world, lengths_m, kinds = vectors
    frame = frame_of(ground)
    magnification = magnification_for(frame, lengths_m[kinds != "rejected"])
    feet = frame.wall_from_world(points_world)[:, :2]
    # If there are too many marks, draw a subset at regular intervals.
    chosen = np.unique(np.linspace(0, len(kinds) - 1, min(_MAX_MARKS, len(kinds))).astype(np.int64))
    longest = max(frame.width, frame.height)
    reference_mm = round_below(1e3 * _REFERENCE_SHARE * longest * frame.gsd_m / magnification)
    some = "" if len(chosen) == len(kinds) else f", {len(chosen)} of them shown"
    return Picture(
        uri=data_uri(
            _drawn(
                ground,
                {kind: chosen[kinds[chosen] == kind] for kind in dict.fromkeys(kinds.tolist())},
                feet,
                magnification * lengths_m / frame.gsd_m,
                (f"{reference_mm:g} mm", 1e-3 * reference_mm * magnification / frame.gsd_m),
                side,
            ),
            "image/webp",
        ),
        title=title,
        caption=f"{_counts(kinds, lengths_m)}; {remark}vectors drawn {magnification:g} times as "
        f"long{some}",
        cell=address,
    )


def _drawn(
    ground: Picture,
    groups: Mapping[str, NDArray[np.int64]],
    feet: NDArray[np.float64],
    vectors: NDArray[np.float64],
    reference: tuple[str, float],
    side: int,
) -> bytes:
    """Draw marks and vectors on the picture of a wall, and encode it as WebP.

    Args:
        ground: background picture.
        groups: kind -> indices of its positions.
        feet: (n, 2) positions (column, row) in cells.
        vectors: (n, 2) vectors (column, row) in cells.
        reference: label of the reference vector, and length of this vector in cells.
        side: longer side of the drawing in pixels.
    """
    frame = frame_of(ground)
    content = base64.b64decode(ground.uri.partition(",")[2])
    columns_px = side * min(1.0, frame.width / frame.height)
    with styled({"font.size": 7.0, "savefig.dpi": columns_px / COLUMN_INCHES}):
        picture = decode_image(content, ground.title)
        figure, axes = picture_figure(picture, frame=frame, extra_inches=0.4)
        axes.autoscale(enable=False)
        for kind, members in groups.items():
            marker, colour = _MARKERS.get(kind, _OTHERS)
            u, v = feet[members].T
            axes.scatter(u, v, s=1.2, marker=marker, color=colour, linewidths=0.5, label=kind)
            # The residuals of rejected ties may be metres long, so draw only a mark.
            if kind != "rejected":
                ends = np.stack([feet[members], feet[members] + vectors[members]])
                axes.plot(*ends.T.swapaxes(1, 2), color=colour, linewidth=0.6)
        text, length = reference
        above = -0.03 * frame.height
        axes.plot([0.0, length], [above, above], color="black", clip_on=False)
        place = (length + 0.01 * frame.width, above)
        axes.annotate(text, place, va="center", annotation_clip=False)
        figure.legend(loc="outside lower right", ncols=3)
        return encode_chart(figure)


def _counts(kinds: NDArray[np.str_], lengths_m: NDArray[np.float64]) -> str:
    parts = []
    for kind in dict.fromkeys(kinds.tolist()):
        here = kinds == kind
        u, v = 1e3 * np.sqrt(np.mean(lengths_m[here] ** 2, axis=0))
        rms = "" if kind == "rejected" else f" (RMS {u:.2f} mm along u, {v:.2f} mm along v)"
        parts.append(f"{int(here.sum())} {kind}{rms}")
    return ", ".join(parts)
