"""Where photos were taken: walls and cameras from above, as a drawing, and a row per photo."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.alike import first_few
from orthoflow.foreign_text import shown
from orthoflow.geometry import WallFrame
from orthoflow.products import Camera, Cameras, Planes, TieRole, Ties
from orthoflow.records.runs import Run
from orthoflow.report.combinations import baseline_cells
from orthoflow.report.legends import length_words, round_length_m
from orthoflow.report.pictures import Picture, embedded_products

# The drawing's longer side; its style sheet sizes letters for it.
_SIDE: Final = 1000.0
_MARGIN: Final = 70.0
_LEVEL: Final = 1.0 - 1e-6
_LOOK_SHARE: Final = 0.045  # length of a viewing direction, of the drawing
_NAMES_MOST: Final = 60  # of more photos only the dots are drawn
_NAME_SIZE: Final = (120.0, 18.0)  # of a photo's name; one that would lie on another is left out
_WALL_NAME_SIZE: Final = (70.0, 18.0)  # one that would lie on another stands below it
_LETTER: Final = 9.5  # width of one, at most


@dataclass(frozen=True, kw_only=True)
class PhotoRow:
    """How well one photo is oriented.

    Attributes:
        name: of the photo.
        status: `ok`, or why it is not oriented.
        n_control: ties that determine its pose; None where the orientation hands on no ties.
        n_check: ties that were withheld and agree, likewise.
        check_mm: RMS of a coordinate of these on the wall; None without any.
        sigma_wall_mm: expected error of a coordinate on the wall; None where none is stated.
    """

    name: str
    status: str
    n_control: int | None = None
    n_check: int | None = None
    check_mm: float | None = None
    sigma_wall_mm: float | None = None


@dataclass(frozen=True, kw_only=True)
class PhotoPlan:
    """The plan of one orientation.

    Attributes:
        svg: an `<svg>` element.
        caption: what it shows, and which photos are missing, in words.
        cell: address of the orientation.
        rows: a row per photo; none where nothing is known of any but its pose.
    """

    svg: str
    caption: str
    cell: str
    rows: tuple[PhotoRow, ...] = ()


def photo_plan(run: Run, walls: Sequence[Picture]) -> PhotoPlan | None:
    """Draw the photos of the baseline's last orientation; None where none is oriented.

    Args:
        run: the run.
        walls: pictures of its walls.
    """
    baseline = {cell.address for cell in baseline_cells(run)}
    every = embedded_products(run, "cameras")
    places = [place for place in every if place[0] in baseline][-1:] or list(every[-1:])
    for (address, _), payload in zip(places, run.payloads(places), strict=True):
        orientation = Cameras.from_payload(payload)
        cameras = orientation.cameras
        oriented = [one for one in cameras if one.status == "ok"]
        if oriented:
            # Of one wall its intensity and its depth are shown.
            frames = {
                picture.number: (picture.name, picture.frame)
                for picture in walls
                if picture.frame is not None and picture.cell in (baseline or {picture.cell})
            }
            plan = _Plan.of(_up(run), oriented, [frame for _, frame in frames.values()])
            return PhotoPlan(
                svg=plan.drawn(oriented, list(frames.values())),
                caption=_caption(address, cameras, oriented),
                cell=address,
                rows=_rows(orientation),
            )
    return None


def _rows(orientation: Cameras) -> tuple[PhotoRow, ...]:
    squares: dict[str, list[float]] = {}
    for residual in orientation.residual_table:
        if (residual.role, residual.unit) == ("check", "mm"):
            squares.setdefault(residual.photo, []).append(residual.rmse**2)
    cameras, ties = orientation.cameras, orientation.ties
    is_stated = any(camera.sigma_wall_m is not None for camera in cameras)
    if not (squares or is_stated or ties is not None):
        return ()
    control, check = (_counts(ties, role) for role in (TieRole.CONTROL, TieRole.CHECK))
    return tuple(
        PhotoRow(
            name=camera.photo,
            status=camera.status,
            n_control=None if ties is None else control.get(camera.photo, 0),
            n_check=None if ties is None else check.get(camera.photo, 0),
            check_mm=_mean_root(squares.get(camera.photo, [])),
            sigma_wall_mm=None if camera.sigma_wall_m is None else 1000 * camera.sigma_wall_m,
        )
        if camera.status == "ok"
        else PhotoRow(name=camera.photo, status=camera.status)
        for camera in cameras
    )


def _counts(ties: Ties | None, role: TieRole) -> dict[str, int]:
    """How many ties of a role each photo has."""
    if ties is None:
        return {}
    counts = np.bincount(ties.photo[ties.role == role], minlength=len(ties.photo_names))
    return dict(zip(ties.photo_names, counts.tolist(), strict=True))


def _mean_root(squares: Sequence[float]) -> float | None:
    return math.sqrt(sum(squares) / len(squares)) if squares else None


def _up(run: Run) -> NDArray[np.float64]:
    places = embedded_products(run, "planes")[:1]
    for payload in run.payloads(places):
        return np.asarray(Planes.from_payload(payload).up, dtype=np.float64)
    return np.array([0.0, 0.0, 1.0])


def _caption(address: str, cameras: Sequence[Camera], oriented: Sequence[Camera]) -> str:
    refused = [one.photo for one in cameras if one.status != "ok"]
    missing = f" Not oriented, and so not drawn: {first_few(refused, most=6)}." if refused else ""
    return (
        f"{len(oriented)} of {len(cameras)} photos, {address}: walls from above, dots where photos "
        "were taken, strokes which way they look. A photo behind a wall, or one that looks away "
        f"from all of them, is oriented wrongly; a wall that none looks at squarely is painted "
        f"badly.{missing}"
    )


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """A view from above.

    Attributes:
        axes: (3, 2) unit vectors of the world, to the right and upwards on the page.
        low: (2,) metres, lower left corner of what is drawn.
        scale: of the drawing, per metre.
        size: (2,) width and height of the drawing.
    """

    axes: NDArray[np.float64]
    low: NDArray[np.float64]
    scale: float
    size: tuple[float, float]

    @classmethod
    def of(
        cls, up: NDArray[np.float64], oriented: Sequence[Camera], frames: Sequence[WallFrame]
    ) -> _Plan:
        """Fit the view to walls and photos."""
        axes = _axes(up, frames)
        points = [_centre(camera) for camera in oriented]
        for frame in frames:
            points.extend(np.asarray(frame.corners_world(), dtype=np.float64))
        flat = np.array(points) @ axes
        low, high = flat.min(axis=0), flat.max(axis=0)
        span = np.maximum(high - low, 0.15 * float((high - low).max()))
        span = np.maximum(span, 1e-3)
        low = 0.5 * (low + high) - 0.5 * span
        scale = (_SIDE - 2 * _MARGIN) / float(span.max())
        width, height = (scale * span + 2 * _MARGIN).tolist()
        return cls(axes=axes, low=low, scale=scale, size=(width, height))

    def at(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Give places (n, 2) of the drawing, y down, for points (n, 3)."""
        flat = self.scale * (points_world @ self.axes - self.low) + _MARGIN
        flat[:, 1] = self.size[1] - flat[:, 1]
        return np.asarray(flat, dtype=np.float64)

    def drawn(self, oriented: Sequence[Camera], walls: Sequence[tuple[str, WallFrame]]) -> str:
        """Draw all of it."""
        width, height = self.size
        names: list[NDArray[np.float64]] = []
        parts = [part for name, frame in walls for part in self._wall(name, frame, names)]
        taken: list[NDArray[np.float64]] = []
        for one in oriented:
            foot = self.at(_centre(one)[None])[0]
            is_free = all(np.any(np.abs(foot - other) > _NAME_SIZE) for other in taken)
            with_name = is_free and len(oriented) <= _NAMES_MOST
            taken.extend([foot] if with_name else [])
            parts += self._photo(one, with_name=with_name)
        length_m = round_length_m(0.25 * width / self.scale)
        bar = length_m * self.scale
        parts.append(
            f'<rect class="ink" x="10" y="{height - 18:.1f}" width="{bar:.1f}" height="5"/>'
            f'<text x="{bar + 18:.1f}" y="{height - 10:.1f}">{length_words(length_m)}</text>'
        )
        return (
            f'<svg class="plan" viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="plan '
            f'of {len(oriented)} photos and {len(walls)} walls">{"".join(parts)}</svg>'
        )

    def _wall(self, name: str, frame: WallFrame, taken: list[NDArray[np.float64]]) -> list[str]:
        ring = self.at(np.asarray(frame.corners_world(), dtype=np.float64))
        line = "L".join(f"{x:.1f} {y:.1f}" for x, y in ring.tolist())
        # The bottom of the picture, as the viewer has it before himself.
        at = 0.5 * (ring[1] + ring[2]) - [0.0, 8.0]
        # Walls back to back have one place: the second name stands below the first.
        while any(np.all(np.abs(at - other) < _WALL_NAME_SIZE) for other in taken):
            at = at + np.array([0.0, _WALL_NAME_SIZE[1]])
        taken.append(at)
        x, y = at.tolist()
        return [
            f'<path class="wall" d="M{line}Z"/>',
            (
                f'<text class="wall-name" x="{x:.1f}" y="{y:.1f}" text-anchor="middle">'
                f"{escape(shown(name))}</text>"
            ),
        ]

    def _photo(self, camera: Camera, *, with_name: bool) -> list[str]:
        centre = _centre(camera)
        foot = self.at(centre[None])[0]
        look = _looks_at(camera) @ self.axes
        end = foot + _LOOK_SHARE * _SIDE * np.array([look[0], -look[1]])
        parts = [
            (
                f'<path class="look" d="M{foot[0]:.1f} {foot[1]:.1f}L{end[0]:.1f} {end[1]:.1f}"/>'
                f'<circle class="photo" cx="{foot[0]:.1f}" cy="{foot[1]:.1f}" r="6">'
                f"<title>{escape(shown(camera.photo))}</title></circle>"
            )
        ]
        if with_name:
            is_cut = foot[0] + 9 + _LETTER * len(camera.photo) > self.size[0]
            x, end = (foot[0] - 9, ' text-anchor="end"') if is_cut else (foot[0] + 9, "")
            parts.append(
                f'<text x="{x:.1f}" y="{foot[1] + 17:.1f}"{end}>'
                f"{escape(shown(camera.photo))}</text>"
            )
        return parts


def _axes(up: NDArray[np.float64], frames: Sequence[WallFrame]) -> NDArray[np.float64]:
    """World x and y where z is up, as maps have them; else along the first wall."""
    if up[2] > _LEVEL:
        return np.eye(3)[:, :2]
    along = frames[0].u_world if frames else np.array([1.0, 0.0, 0.0])
    right = along - (along @ up) * up
    if float(np.linalg.norm(right)) < 1e-6:
        right = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    right = right / np.linalg.norm(right)
    return np.column_stack([right, np.cross(up, right)])


def _centre(camera: Camera) -> NDArray[np.float64]:
    rotation, translation = _pose(camera)
    return np.asarray(-rotation.T @ translation, dtype=np.float64)


def _looks_at(camera: Camera) -> NDArray[np.float64]:
    """Where the middle of the photo looks, a unit vector of the world."""
    rotation, _ = _pose(camera)
    return np.asarray(rotation[2], dtype=np.float64)


def _pose(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rotation, translation = camera.rotation_camera_from_world, camera.translation_camera_from_world
    if rotation is None or translation is None:
        raise AssertionError("only oriented photos are drawn")
    return rotation, translation
