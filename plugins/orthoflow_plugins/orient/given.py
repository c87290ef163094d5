"""`orient.given`: poses from other programs, unchanged or corrected by ties measured by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.resection import SeenPoints, misfit
from orthoflow.products import Camera, Cameras, JsonValue, Photo, Photos, Ties, TieWall, Walls
from orthoflow.sdk import DiagnosticSpec, Method, MetricSpec, Ports, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.orient.photos import MIN_TIES, oriented_by_hand, tied_photo
from orthoflow_plugins.orient.pose import (
    NOT_ORIENTED,
    ORIENTATION_METRICS,
    Note,
    OrientOut,
    OrientParams,
)
from orthoflow_plugins.orient.report import Oriented, hand_over, measure_expected

_SIDE: Final = 15
# A tie contradicts the pose if its residual exceeds this many standard deviations.
_DISAGREEING: Final = 3.5
POSE_DISAGREES: Final = DiagnosticSpec(
    code="pose-against-ties",
    severity="warning",
    text="photo {subject}: {n} of its {n_ties} ties measured by hand disagree with the given "
    "pose, by up to {longest_px:.1f} px",
    remedy="correct the ties, or measure at least {n_least}, from which the photo is then oriented",
    rank_by="longest_px",
)


class OrientGiven(Method):
    """Use poses from other programs unchanged.

    The poses are not verified: their status is `ok`, the source of their lens is `given`, and their
    error on the wall is known only if the files contain it. If the ties of the run that estimated
    the poses are connected, they show on which walls each pose is based. A photo with at least six
    ties measured by hand is oriented from these ties, with the given lens, and must pass the gates
    for such ties. If there are fewer, they are only used to check the given pose. The poses are
    rejected if no photo shows a wall with its given pose, since they cannot be in the coordinate
    system of the scan.
    """

    id: ClassVar[str] = "orient.given"
    determinism: ClassVar[Determinism] = "seeded"
    metrics: ClassVar[tuple[MetricSpec, ...]] = ORIENTATION_METRICS
    citations: ClassVar[tuple[str, ...]] = ()

    class Params(OrientParams):
        """Limits of the gates for poses from ties measured by hand."""

    class In(Ports):
        """Poses, photos, walls, and ties measured by hand."""

        cameras: Cameras
        photos: Photos
        walls: Walls | None = None
        ties: Ties | None = None

    Out = OrientOut

    def run(self, inputs: In, params: Params, ctx: StepContext) -> OrientOut:
        """Check the poses of photos with ties, and return all poses."""
        given = {camera.photo: camera for camera in inputs.cameras.cameras}
        if inputs.walls is not None:
            _require_a_wall_in_view(list(given.values()), inputs.walls)
        photos = inputs.photos.photos
        taken = [
            given.get(photo.name, Camera(photo=photo.name, status="no pose is given for it"))
            for photo in photos
        ]
        earlier = inputs.cameras.ties
        if earlier is not None:
            earlier = _on_walls(earlier, inputs.walls, is_within_buffer=True)
        if inputs.ties is None:
            ctx.progress(1.0, "poses")
            cameras = _as_they_are(ctx, taken)
            return OrientOut(cameras=replace(cameras, ties=earlier))
        ties = _on_walls(inputs.ties, inputs.walls, is_within_buffer=False)
        found = []
        for nth, (photo, camera) in enumerate(zip(photos, taken, strict=True)):
            ctx.progress(nth / len(photos), photo.name)
            known = replace(photo, intrinsics=camera.intrinsics or photo.intrinsics)
            found.append(_oriented(known, camera, ties, params, ctx))
        unchecked = [item.camera.photo for item in found if item.entry is None]
        cameras = hand_over(ctx, ties, photos, found, _details(unchecked))
        if cameras.ties is not None and earlier is not None:
            is_kept = [name in unchecked for name in earlier.photo_names]
            kept = np.array(is_kept, dtype=np.bool_)[earlier.photo]
            cameras = replace(cameras, ties=_joined(cameras.ties, earlier, kept))
        return OrientOut(cameras=cameras)


def _as_they_are(ctx: StepContext, cameras: Sequence[Camera]) -> Cameras:
    n_oriented = sum(camera.status == "ok" for camera in cameras)
    ctx.metric("n_photos", len(cameras), "1")
    ctx.metric("n_oriented", n_oriented, "1")
    ctx.metric("n_refused", len(cameras) - n_oriented, "1")
    measure_expected(ctx, cameras)
    for camera in cameras:
        if camera.status != "ok":
            ctx.report(NOT_ORIENTED, subject=camera.photo, status=camera.status)
    return Cameras(cameras=tuple(cameras), details=_details([camera.photo for camera in cameras]))


def _details(unchecked: Sequence[str]) -> dict[str, JsonValue]:
    return {"given": list(unchecked)}


def _oriented(
    photo: Photo, camera: Camera, ties: Ties, params: OrientGiven.Params, ctx: StepContext
) -> Oriented:
    tied = tied_photo(photo, ties, params, ctx.rng)
    if tied.by_hand.sum() >= MIN_TIES:
        return oriented_by_hand(tied, ties, params)[0]
    residuals_px = np.full((len(tied.chosen), 2), np.nan)
    notes: tuple[Note, ...] = ()
    if camera.status == "ok" and len(tied.seen):
        fit = misfit(tied.seen, camera.viewing())
        residuals_px = fit.residuals_px
        notes = _disagreement(tied.seen, fit.normalised, residuals_px)
    return Oriented(
        camera=camera,
        chosen=tied.chosen,
        role=ties.role[tied.chosen],
        residuals_px=residuals_px,
        notes=notes,
    )


def _disagreement(
    seen: SeenPoints, normalised: NDArray[np.float64], residuals_px: NDArray[np.float64]
) -> tuple[Note, ...]:
    off = normalised > _DISAGREEING
    if not off.any():
        return ()
    longest = float(np.nanmax(np.linalg.norm(residuals_px[off], axis=1), initial=0.0))
    values = {"n": int(off.sum()), "n_ties": len(seen), "longest_px": longest}
    return ((POSE_DISAGREES, {**values, "n_least": MIN_TIES}),)


def _joined(hand: Ties, earlier: Ties, kept: NDArray[np.bool_]) -> Ties:
    """Append ties of an earlier run, selected by `kept` (n,), to ties measured by hand."""
    names = tuple(dict.fromkeys((*hand.photo_names, *earlier.photo_names)))
    place = np.array([names.index(name) for name in earlier.photo_names], dtype=np.int32)
    # The arrays of the product are collected by name and have various types.
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(hand, name), getattr(earlier, name)[kept]])
        for name in (
            *("wall", "pixels_photo", "points_world", "sigma_px", "sigma_m"),
            *("role", "residual_px"),
        )
    }
    n_by_hand, n_kept = len(hand.photo), int(kept.sum())
    return replace(
        hand,
        photo_names=names,
        photo=np.concatenate([hand.photo, place[earlier.photo[kept]]]),
        by_hand=np.repeat(np.array([1, 0], dtype=np.uint8), [n_by_hand, n_kept]),
        search_radius_px=(),
        **columns,
    )


def _on_walls(ties: Ties, walls: Walls | None, *, is_within_buffer: bool) -> Ties:
    if walls is None:
        return ties
    return replace(
        ties,
        wall=walls.nearest(ties.points_world, is_within_buffer=is_within_buffer),
        walls=tuple(TieWall.of(wall) for wall in walls.walls),
    )


def _require_a_wall_in_view(cameras: Sequence[Camera], walls: Walls) -> None:
    """Check that at least one photo shows the front of a wall.

    Raises:
        MethodError: no photo shows the front of a wall.
    """
    oriented = [camera.viewing() for camera in cameras if camera.status == "ok"]
    for wall in walls.walls:
        frame = wall.frame
        steps = (np.arange(_SIDE) + 0.5) / _SIDE
        places = np.stack(np.meshgrid(steps * frame.width, steps * frame.height), axis=-1)
        places = places.reshape(-1, 2)
        points, normals = frame.world_from_wall(places), frame.axes_at(places)[:, 2]
        for camera in oriented:
            is_before = np.einsum("ij,ij->i", camera.centre_world - points, normals) > 0.0
            if (is_before & camera.sees(camera.project(points)[:, :2])).any():
                return
    if not oriented:
        return
    centres = np.array([camera.centre_world for camera in oriented])
    corners = np.concatenate([wall.frame.corners_world() for wall in walls.walls])
    raise MethodError(
        f"no given pose shows a wall: the cameras are at "
        f"{_extent(centres)}, the walls at {_extent(corners)} (x, y, z in metres). Cameras and "
        "scan must use the same coordinate system and unit: transform the cameras to the system "
        "of the scan before exporting them, or match the photos instead"
    )


def _extent(points: NDArray[np.float64]) -> str:
    low, high = points.min(axis=0), points.max(axis=0)
    return ", ".join(f"{first:.1f} to {last:.1f}" for first, last in zip(low, high, strict=True))
