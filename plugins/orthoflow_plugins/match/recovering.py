"""Photos that nobody could orient yet, found by what oriented photos show of the same walls.

Where a laser sees another colour than a camera, a photo may share too few key points with the
intensity of a wall. With another photo of the wall it shares hundreds. So the oriented photos are
painted on the walls, the missing one is matched with that picture, and its pose follows; then it is
traced on the scan as any other photo, so that its ties are known from the scan alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.opencv_border import opencv_matrix, to_opencv
from orthoflow.products import Camera, Intrinsics, Photo, Photos, Wall
from orthoflow_plugins.match.features import Features
from orthoflow_plugins.match.pairing import PairingParams, PhotoPairs, pair_photo, wall_features
from orthoflow_plugins.match.pictures import photo_grey
from orthoflow_plugins.match.ties import Trace, key_point_ties
from orthoflow_plugins.match.tracing import Desk, estimated_lens, lens_by_ties, trace_photo
from orthoflow_plugins.match.warping import View, view_of

# Two photos of one wall share hundreds of key points; fewer than so many may be a repeated motif.
_MIN_AGREEING: Final = 24
_POSE_LIMIT_SHARE: Final = 0.002
_POSE_TRIALS: Final = 2000
_SEED: Final = 1
_PARAMS: Final = PairingParams()


@dataclass(frozen=True, kw_only=True)
class PaintedWall:
    """A wall as photos show it.

    Attributes:
        wall: the wall, its intensity from the photos, NaN where none shows it.
        features: key points of that picture, None where there is none.
    """

    wall: Wall
    features: Features | None


def recovered_traces(
    photos: Photos,
    oriented: Mapping[str, Camera],
    desk: Desk,
    traces: Sequence[Trace],
) -> dict[str, Trace]:
    """Trace photos without a pose from the one that the traced photos give them.

    Args:
        photos: all photos.
        oriented: cameras of those with a pose, by name.
        desk: the walls.
        traces: of the oriented photos.

    Returns:
        By name, for each photo that was found.
    """
    recovered: dict[str, Trace] = {}
    known = [trace for trace in traces if trace.n_ties]
    settled = _settled(photos, oriented, known)
    missing = [k for k, photo in enumerate(photos.photos) if photo.name not in oriented]
    views = [_view(trace, photos, desk) for trace in known] if missing else []
    is_new = bool(known)
    while is_new and missing:
        # What was found shows more of the walls, for the next round.
        painted = painted_walls(views, desk.walls)
        n_before = len(recovered)
        for index in missing:
            photo = photos.photos[index]
            found = _recovered(index, photo, painted, lens_of(photo, settled, photos), desk)
            if found is not None:
                recovered[photo.name] = found
                views.append(_view(found, photos, desk))
        missing = [k for k in missing if photos.photos[k].name not in recovered]
        is_new = len(recovered) > n_before
    return recovered


def _settled(
    photos: Photos, oriented: Mapping[str, Camera], traces: Sequence[Trace]
) -> dict[str, Camera]:
    """Cameras of traced photos by name, first those whose ties tell most of the focal length.

    A lens that was only estimated is that by these ties.
    """
    cameras: list[tuple[float, Camera]] = []
    for trace in traces:
        photo = photos.photos[trace.photo]
        camera, sigma = oriented[photo.name], 0.0
        freedom = estimated_lens(photo, camera.intrinsics)
        if freedom is not None:
            found, sigma = lens_by_ties(trace, freedom)
            lens = Intrinsics.of(found, source="estimated")
            camera = replace(camera, intrinsics=lens)
        cameras.append((sigma, camera))
    cameras.sort(key=lambda each: each[0])
    return {camera.photo: camera for _, camera in cameras}


def _recovered(
    index: int,
    photo: Photo,
    painted: Sequence[PaintedWall],
    lens: Intrinsics | None,
    desk: Desk,
) -> Trace | None:
    if lens is None:
        return None
    pose = recovered_pose(photo_grey(photo), painted, lens.posed())
    freedom = estimated_lens(photo, lens)
    found = None if pose is None else trace_photo(index, photo, pose, desk, freedom)
    return found if found is not None and found.n_ties else None


def _view(trace: Trace, photos: Photos, desk: Desk) -> View:
    """Lay a photo onto the walls as it lay there in the end; its first pose hides what it hides."""
    photo = photos.photos[trace.photo]
    first = view_of(trace.photo, photo, trace.camera, desk.walls, desk.before)
    return first.posed(trace.settled, desk.walls)


def painted_walls(views: Sequence[View], walls: Sequence[Wall]) -> list[PaintedWall]:
    """Paint oriented photos on the walls, in each cell the one that shows the wall largest."""
    painted = []
    for index, wall in enumerate(walls):
        grey = np.full(wall.frame.shape, np.nan, dtype=np.float32)
        laid = [
            (view, projection)
            for view in views
            if (projection := view.projections[index]) is not None
        ]
        for view, projection in sorted(laid, key=lambda each: each[1].pixels_per_cell):
            shown = view.on_wall(index, projection)
            part = grey[projection.part]
            part[np.isfinite(shown)] = shown[np.isfinite(shown)]
        as_shown = replace(wall, intensity=grey / np.float32(255.0))
        features = wall_features(as_shown, _PARAMS) if np.isfinite(grey).any() else None
        painted.append(PaintedWall(wall=as_shown, features=features))
    return painted


def recovered_pose(
    grey: NDArray[np.uint8],
    painted: Sequence[PaintedWall],
    lens: ViewingCamera,
) -> ViewingCamera | None:
    """Find the pose of a photo by painted walls; None where they do not show what it shows.

    Args:
        grey: (height, width) of the photo.
        painted: the walls.
        lens: its interior orientation, roughly; the pose is ignored.
    """
    pairs = pair_photo(grey, [each.features for each in painted], _PARAMS)
    pixels, points = _agreeing(pairs, painted)
    if len(pixels) < _MIN_AGREEING:
        return None
    return _pose(pixels, points, lens, _POSE_LIMIT_SHARE * max(grey.shape))


def lens_of(photo: Photo, oriented: Mapping[str, Camera], photos: Photos) -> Intrinsics | None:
    """Return a photo's lens: calibrated, or as it came out for a photo of the same camera.

    What came out counts more than what EXIF states, which is wrong for all photos of a lens.

    Returns:
        None when nothing is known of it.
    """
    focal_px = {each.name: each.exif_focal_px for each in photos.photos}
    similar = [
        camera.intrinsics
        for name, camera in oriented.items()
        if camera.intrinsics is not None
        and (camera.intrinsics.width, camera.intrinsics.height) == (photo.width, photo.height)
        and (
            photo.exif_focal_px is None
            or focal_px.get(name) == photo.exif_focal_px
            or _is_near(camera.intrinsics.fx, photo.exif_focal_px)
        )
    ]
    return photo.intrinsics or next(iter(similar), None)


def _is_near(focal_px: float, exif_focal_px: float) -> bool:
    return abs(focal_px / exif_focal_px - 1.0) < 0.1


def _agreeing(
    pairs: PhotoPairs, painted: Sequence[PaintedWall]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (n, 2) and world points (n, 3) of the matches that agree."""
    pixels, points = [np.empty((0, 2))], [np.empty((0, 3))]
    for pair in pairs.pairs:
        features = painted[pair.wall].features
        if not pair.is_shown or features is None:
            continue
        matches = pair.matches.take(pair.agreeing)
        sets = (pairs.features.take(matches.first), features.take(matches.second))
        piece = key_point_ties((0, pair.wall), painted[pair.wall].wall, sets, scale=pairs.scale)
        pixels.append(piece.pixels_photo)
        points.append(piece.points_world)
    return np.concatenate(pixels), np.concatenate(points)


def _pose(
    pixels: NDArray[np.float64],
    points: NDArray[np.float64],
    lens: ViewingCamera,
    limit_px: float,
) -> ViewingCamera | None:
    """Pose that most points agree with, good enough to trace the photo from."""
    import cv2

    params: Any = cv2.UsacParams()
    params.threshold = limit_px
    params.maxIterations = _POSE_TRIALS
    params.randomGeneratorState = _SEED
    params.score = cv2.SCORE_METHOD_MSAC
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    middle = points.mean(axis=0)
    matrix = opencv_matrix(lens)
    observed = to_opencv(pixels)[:, None]
    straight: Any = cv2.undistortPoints(observed, matrix, lens.distortion, P=matrix)
    call: Any = cv2.solvePnPRansac
    found, _, turn, shift, agreed = call(
        points - middle, straight[:, 0], matrix, None, params=params
    )
    if not found or agreed is None or len(agreed) < _MIN_AGREEING:
        return None
    rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
    pose = replace(lens, rotation=rotation, translation=np.asarray(shift).ravel())
    return pose.shifted(-middle)
