"""A block of photos: cameras that share lenses and points, as one adjustment takes them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.lenses import LensFreedom, linearised

# A known point is never exact: an adjustment divides by its variance.
SIGMA_LEAST_M: Final = 1e-6


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A lens that one photo or several were taken with.

    Attributes:
        prior: what it is beforehand; its pose says nothing.
        freedom: how far it may change.
        source: what `prior` is known from.
    """

    prior: ViewingCamera
    freedom: LensFreedom
    source: str


@dataclass(frozen=True, kw_only=True)
class Observations:
    """Pixels at which photos see points.

    Attributes:
        photo: (m,) index of the camera.
        point: (m,) index of the point.
        pixels: (m, 2).
        sigma_px: (m,) standard deviation of each coordinate.
    """

    photo: NDArray[np.intp]
    point: NDArray[np.intp]
    pixels: NDArray[np.float64]
    sigma_px: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.photo)

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Observations:
        """Give some of them."""
        return Observations(
            photo=self.photo[chosen],
            point=self.point[chosen],
            pixels=self.pixels[chosen],
            sigma_px=self.sigma_px[chosen],
        )


@dataclass(frozen=True, kw_only=True)
class Points:
    """Points that photos see.

    Attributes:
        now: (k, 3) metres, where the adjustment has them.
        known: (k, 3) metres, where the scan has them; anything without the scan.
        sigma_m: (k,) standard deviation of each coordinate of `known`; inf without the scan.
    """

    now: NDArray[np.float64]
    known: NDArray[np.float64]
    sigma_m: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.now)


@dataclass(frozen=True, kw_only=True)
class Block:
    """Cameras, lenses, points and what is seen of them, in a world with its origin nearby.

    Attributes:
        cameras: one per photo.
        lens_of: index of each camera's lens.
        lenses: the lenses.
        points: the points.
        seen: the observations.
    """

    cameras: tuple[ViewingCamera, ...]
    lens_of: tuple[int, ...]
    lenses: tuple[Lens, ...]
    points: Points
    seen: Observations

    @property
    def is_joint(self) -> NDArray[np.bool_]:
        """Points (k,) seen more than once: they move; the others only widen their pixel."""
        return np.bincount(self.seen.point, minlength=len(self.points)) > 1

    @property
    def column_starts(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """First columns of poses and of lenses in the block's normal matrix."""
        sizes = [lens.freedom.sigmas.size for lens in self.lenses]
        poses = 6 * np.arange(len(self.cameras) + 1, dtype=np.intp)
        lenses = poses[-1] + np.concatenate([[0], np.cumsum(sizes)]).astype(np.intp)
        return poses, lenses

    def columns(self, photo: int) -> NDArray[np.intp]:
        """Columns of a photo's pose and of its lens in the normal matrix."""
        poses, lenses = self.column_starts
        lens = self.lens_of[photo]
        return np.concatenate(
            [np.arange(poses[photo], poses[photo] + 6), np.arange(lenses[lens], lenses[lens + 1])]
        )

    def moved(self, cameras: tuple[ViewingCamera, ...], now: NDArray[np.float64]) -> Block:
        """Give the block after an adjustment."""
        return replace(self, cameras=cameras, points=replace(self.points, now=now))


def pixel_covariances(block: Block) -> NDArray[np.float64]:
    """Covariances (m, 2, 2) of the pixels; of points seen once, with that of the point."""
    seen = block.seen
    covariances = (seen.sigma_px**2)[:, None, None] * np.eye(2)
    alone = ~block.is_joint[seen.point]
    for photo, camera in enumerate(block.cameras):
        mine = np.flatnonzero(alone & (seen.photo == photo))
        points = seen.point[mine]
        by_point = linearised(camera, block.points.known[points], LensFreedom()).by_camera_point
        variances = (block.points.sigma_m[points] ** 2)[:, None, None]
        covariances[mine] += variances * (by_point @ by_point.transpose(0, 2, 1))
    return covariances
