"""Ties between photos: key points matched in pairs of photos and joined into tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import photo_grey, reduced
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.frames import cross_matrix
from orthoflow.geometry.key_points import Features, find_features, mutual_matches
from orthoflow.products import Photo
from orthoflow_plugins.orient.pose import camera_rays

# Larger photos are reduced. SIFT needs 0.23 GB per million pixels, and thousands of key points at
# half the resolution are as good as a larger number at full resolution.
_MAX_SIDE_PX: Final = 1600
_MAX_RATIO: Final = 0.85
_MAX_PARTNERS: Final = 8
# Limits for matches between photos whose poses are accurate to a few pixels.
_MAX_OFF_LINE_PX: Final = 6.0
_MAX_OFF_POINT_PX: Final = 8.0
_MIN_ANGLE: Final = np.radians(2.0)


@dataclass(frozen=True, kw_only=True)
class PhotoTies:
    """Points that are not in the scan but visible in several photos.

    Attributes:
        photo: (m,) index of the photo of each observation.
        point: (m,) index of the observed point, 0..k-1; each point is observed at least twice.
        pixels: (m, 2) photo pixels of each observation.
        scale: (m,) photo pixels per pixel of the reduced image in which the key point was found.
        points_world: (k, 3) points in metres, intersected from the rays of the given poses.
    """

    photo: NDArray[np.intp]
    point: NDArray[np.intp]
    pixels: NDArray[np.float64]
    scale: NDArray[np.float64]
    points_world: NDArray[np.float64]


def photo_features(photo: Photo, n_most: int) -> Features:
    """Find the strongest key points of a photo, distributed over the photo."""
    scale = _reduction(photo.width, photo.height)
    return find_features(reduced(photo_grey(photo), 1.0 / scale), n_most).scaled(scale)


def _reduction(width: int, height: int) -> float:
    """Return the number of photo pixels per pixel of the image in which key points are found."""
    return max(1.0, max(width, height) / _MAX_SIDE_PX)


def overlapping_pairs(
    cameras: Sequence[ViewingCamera], points: Sequence[NDArray[np.float64]], least_share: float
) -> list[tuple[int, int]]:
    """Select the pairs of photos with enough overlap.

    Args:
        cameras: cameras of the photos.
        points: for each photo, the wall points (n, 3) that it shows.
        least_share: minimum share of the points of each photo that the other photo must show.
    """
    shares = np.zeros((len(cameras), len(cameras)))
    for first, shown in enumerate(points):
        for second, camera in enumerate(cameras):
            if first != second and len(shown):
                shares[first, second] = camera.sees(camera.project(shown)[:, :2]).mean()
    both = np.minimum(shares, shares.T)
    pairs = set()
    for first in range(len(cameras)):
        for second in np.argsort(-both[first], kind="stable")[:_MAX_PARTNERS].tolist():
            if both[first, second] >= least_share:
                pairs.add((min(first, second), max(first, second)))
    return sorted(pairs)


def tie_photos(
    cameras: Sequence[ViewingCamera],
    features: Sequence[Features],
    pairs: Sequence[tuple[int, int]],
    n_most: int,
) -> PhotoTies:
    """Match key points of photo pairs, and join matches that agree with the poses into tracks.

    Args:
        cameras: cameras of the photos, accurate to a few pixels.
        features: key points of the photos.
        pairs: pairs of photos to match.
        n_most: maximum number of points; points with the most observations are preferred.
    """
    starts = np.concatenate([[0], np.cumsum([len(item.pixels) for item in features])])
    rays = [
        camera_rays(camera, item.pixels) for camera, item in zip(cameras, features, strict=True)
    ]
    links = [np.empty((0, 2), dtype=np.intp)]
    for first, second in pairs:
        matched = mutual_matches(
            features[first].descriptors, features[second].descriptors, ratio=_MAX_RATIO
        )
        off = _off_line_px(
            (cameras[first], rays[first][matched.first]),
            (cameras[second], rays[second][matched.second]),
        )
        near = matched.take(off <= _MAX_OFF_LINE_PX)
        links.append(np.column_stack([near.first + starts[first], near.second + starts[second]]))
    tracks = tracks_of(np.vstack(links), starts)
    return _located(cameras, features, rays, tracks[:n_most])


def _off_line_px(
    first: tuple[ViewingCamera, NDArray[np.float64]],
    second: tuple[ViewingCamera, NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Return the distances (n,), in pixels, between rays of the second photo and epipolar lines."""
    rotation = second[0].rotation @ first[0].rotation.T
    baseline = second[0].translation - rotation @ first[0].translation
    lines = first[1] @ (cross_matrix(baseline) @ rotation).T
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.abs((second[1] * lines).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)
    return np.where(np.isfinite(off), off * second[0].fx, np.inf)


def tracks_of(links: NDArray[np.intp], starts: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Return tracks of linked key points, longest first, with at most one key point per photo."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(links):
        return []
    n_all = int(starts[-1])
    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(n_all, n_all))
    label = connected_components(graph, directed=False)[1]
    used = np.unique(links)
    order = used[np.argsort(label[used], kind="stable")]
    ends = np.flatnonzero(np.diff(label[order])) + 1
    tracks = []
    for track in np.split(order, ends):
        photos = np.searchsorted(starts, track, side="right")
        if len(np.unique(photos)) == len(track):
            tracks.append(track)
    return sorted(tracks, key=lambda track: -len(track))


def _located(
    cameras: Sequence[ViewingCamera],
    features: Sequence[Features],
    rays: Sequence[NDArray[np.float64]],
    tracks: Sequence[NDArray[np.intp]],
) -> PhotoTies:
    """Intersect the rays of each track, and keep the tracks whose rays agree, grouped by length."""
    counts = [len(item.pixels) for item in features]
    photo_of = np.repeat(np.arange(len(cameras)), counts)
    pixels = np.vstack([item.pixels for item in features])
    centres = np.array([camera.centre_world for camera in cameras])
    world = np.vstack([own @ camera.rotation for camera, own in zip(cameras, rays, strict=True)])
    kept = [np.empty(0, dtype=np.intp)]
    points = [np.empty((0, 3))]
    for length in sorted({len(track) for track in tracks}, reverse=True):
        some = np.array([track for track in tracks if len(track) == length])
        some, found = _meeting(some, centres[photo_of[some]], world[some])
        off = np.full(some.shape, np.inf)
        for at, camera in enumerate(cameras):
            row, column = np.nonzero(photo_of[some] == at)
            seen = camera.project(found[row])[:, :2]
            off[row, column] = np.linalg.norm(seen - pixels[some[row, column]], axis=1)
        near = (off <= _MAX_OFF_POINT_PX).all(axis=1)
        kept += list(some[near])
        points.append(found[near])
    of_all = np.concatenate(kept)
    return PhotoTies(
        photo=photo_of[of_all],
        point=np.repeat(np.arange(len(kept) - 1), [len(track) for track in kept[1:]]),
        pixels=pixels[of_all],
        scale=np.array([_reduction(camera.width, camera.height) for camera in cameras])[
            photo_of[of_all]
        ],
        points_world=np.vstack(points),
    )


def _meeting(
    tracks: NDArray[np.intp], centres: NDArray[np.float64], directions: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Select the tracks (k, m) whose rays intersect in front of the cameras at sufficient angles.

    Also return the points of intersection (k, 3).
    """
    unit = directions / np.linalg.norm(directions, axis=2, keepdims=True)
    cosines = np.einsum("nid,njd->nij", unit, unit)
    wide = cosines.min(axis=(1, 2)) < np.cos(_MIN_ANGLE)
    tracks, centres, unit = tracks[wide], centres[wide], unit[wide]
    across = np.eye(3) - unit[:, :, :, None] * unit[:, :, None, :]
    pulled = np.einsum("nmij,nmj->ni", across, centres)
    points = np.linalg.solve(across.sum(axis=1), pulled[:, :, None])[:, :, 0]
    ahead = ((points[:, None] - centres) * unit).sum(axis=2)
    in_front = (ahead > 0.0).all(axis=1)
    return tracks[in_front], points[in_front]
