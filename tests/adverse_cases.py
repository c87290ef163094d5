"""Photos that are easy, hard or impossible to orient, as ties whose truth is known exactly.

What can be solved is said beforehand, kind by kind, not by what an orientation makes of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import encode_png
from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.products import Intrinsics, Photo, Ties
from tests import samples
from tests.scenes import SURVEY_SHIFT_M

WALL_M: Final = (4.0, 3.0)
GSD_M: Final = 0.004
PERIOD_M: Final = 0.15
SIZE_PX: Final = (1200, 900)
NOISE_PX: Final = 0.8
NOISE_M: Final = 0.001
_ENCODED: Final = encode_png(np.zeros((SIZE_PX[1] // 10, SIZE_PX[0] // 10), np.uint8))
_CORNERS: Final = 0.5 * np.array([[-1, 0, 1], [-1, 0, -1], [1, 0, -1], [1, 0, 1]]) * (4.0, 0.0, 3.0)


@dataclass(frozen=True, kw_only=True)
class AdverseCase:
    """A photo with its ties.

    Attributes:
        kind: what is the matter with it.
        is_solvable: whether an orientation has to succeed.
        camera: the true one, seeing the wall in the plane y = 0 from negative y.
        shift_m: (3,) the ties are in a world shifted by this.
        photo: what is known of the lens.
        ties: what a matcher would give.
    """

    kind: str
    is_solvable: bool
    camera: ViewingCamera
    shift_m: NDArray[np.float64]
    photo: Photo
    ties: Ties

    def wall_error_m(self, found: ViewingCamera) -> float:
        """RMS per coordinate of where the photo's pixels land on the wall, found less true."""
        grid = [(np.arange(n) + 0.5) / n * side for n, side in zip((12, 9), SIZE_PX, strict=True)]
        pixels = np.stack(np.meshgrid(*grid), axis=-1).reshape(-1, 2)
        landed = []
        for camera in (self.camera, found.shifted(self.shift_m)):
            rays = camera.rays_world(pixels)
            landed.append(camera.centre_world - camera.centre_world[1] / rays[:, 1:2] * rays)
        inside = (np.abs(landed[0][:, [0, 2]]) < 0.5 * np.array(WALL_M)).all(axis=1)
        off = (landed[1] - landed[0])[inside]
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1)) / 2.0))


@dataclass(frozen=True, kw_only=True)
class _Draft:
    """A photo in the making.

    Attributes:
        camera: the true one.
        pixels: (n, 2).
        points: (n, 3).
        exif_factor: EXIF states the focal length times this; 0: it states nothing.
        calibrated_factor: a calibration states it times this; 0: there is no calibration.
        shift_m: (3,).
    """

    camera: ViewingCamera
    pixels: NDArray[np.float64]
    points: NDArray[np.float64]
    exif_factor: float = 0.0
    calibrated_factor: float = 1.0
    shift_m: tuple[float, ...] = (0.0, 0.0, 0.0)


def every_case(n_seeds: int) -> Iterator[AdverseCase]:
    """All kinds, each with so many seeds."""
    for kind in KINDS:
        for seed in range(n_seeds):
            yield adverse_case(kind, seed)


def adverse_case(kind: str, seed: int) -> AdverseCase:
    """One photo of a kind."""
    rng = np.random.default_rng([list(KINDS).index(kind), seed])
    is_solvable, build = KINDS[kind]
    draft = build(rng)
    known, factor = Intrinsics.of(draft.camera), draft.calibrated_factor
    return AdverseCase(
        kind=kind,
        is_solvable=is_solvable,
        camera=draft.camera,
        shift_m=np.array(draft.shift_m),
        photo=Photo(
            name="a.png",
            encoded=_ENCODED,
            width=SIZE_PX[0],
            height=SIZE_PX[1],
            exif_focal_px=draft.camera.fx * draft.exif_factor or None,
            intrinsics=replace(known, fx=known.fx * factor, fy=known.fy * factor)
            if factor
            else None,
        ),
        ties=_ties_of(draft),
    )


def _ties_of(draft: _Draft) -> Ties:
    n, shift = len(draft.pixels), np.array(draft.shift_m)
    return samples.ties(
        draft.pixels,
        points_world=draft.points + shift,
        sigma_px=np.full(n, NOISE_PX),
        sigma_m=np.full(n, NOISE_M),
        walls=(samples.tie_wall(_CORNERS + shift, GSD_M),),
    )


def _draft(
    rng: np.random.Generator,
    n: int,
    *,
    relief_m: float = 0.0,
    tilt_deg: float = 15.0,
    aim: tuple[float, float] = (0.0, 0.0),
) -> _Draft:
    """Right ties all over a photo of a lens of its own, pilasters on the wall or none."""
    tilt, turn = np.radians(tilt_deg) * rng.uniform(0.7, 1.0), rng.uniform(0.0, 2.0 * np.pi)
    aside = np.tan(tilt) * np.array([np.cos(turn), 0.0, np.sin(turn)])
    foot = np.array([aim[0], 0.0, aim[1]]) + rng.uniform(-0.3, 0.3, 3) * [1.0, 0.0, 1.0]
    centre = foot + rng.uniform(2.4, 3.2) * (aside - np.array([0.0, 1.0, 0.0]))
    rotation = looking_at(centre, foot, np.array([0.0, 0.0, 1.0]))
    focal = rng.uniform(1000.0, 1300.0)
    camera = samples.camera(
        rotation,
        centre,
        width=SIZE_PX[0],
        height=SIZE_PX[1],
        fx=focal,
        fy=focal,
        cx=SIZE_PX[0] / 2 + rng.uniform(-8.0, 8.0),
        cy=SIZE_PX[1] / 2 + rng.uniform(-8.0, 8.0),
        distortion=np.array([-0.08, 0.02, 0.0, 0.0, 0.0])
        + np.array([0.01, 0.005, 0.0005, 0.0005, 0.0]) * rng.uniform(-1.0, 1.0, 5),
    )
    places = rng.uniform(-0.5, 0.5, (12 * n, 2)) * WALL_M
    depth = relief_m * (np.floor(places[:, 0] / 0.4) % 3.0 == 0.0)
    points = np.column_stack([places[:, 0], -depth, places[:, 1]])
    pixels = camera.project(points)[:, :2]
    seen = np.flatnonzero(camera.sees(pixels))[:n]
    return _Draft(
        camera=camera,
        pixels=pixels[seen] + NOISE_PX * rng.normal(size=(len(seen), 2)),
        points=points[seen] + NOISE_M * rng.normal(size=(len(seen), 3)),
    )


def _wrong(draft: _Draft, rng: np.random.Generator, share: float) -> _Draft:
    """Put a share of the ties at random pixels."""
    wrong = rng.random(len(draft.pixels)) < share
    return _guessed(draft, wrong, rng)


def _guessed(draft: _Draft, chosen: NDArray[np.bool_], rng: np.random.Generator) -> _Draft:
    pixels = draft.pixels.copy()
    pixels[chosen] = rng.uniform([0.0, 0.0], SIZE_PX, (int(chosen.sum()), 2))
    return replace(draft, pixels=pixels)


def _periods(draft: _Draft, chosen: NDArray[np.bool_], steps: NDArray[np.float64]) -> _Draft:
    """Shift chosen ties along the wall by whole periods of a textile."""
    points = draft.points.copy()
    points[chosen] += (PERIOD_M * np.atleast_2d(steps)) @ np.array([[1.0, 0, 0], [0, 0, 1.0]])
    return replace(draft, points=points)


def _half_shifted(rng: np.random.Generator) -> _Draft:
    """Two fifths of the ties agree with each other one period beside the truth."""
    draft = _wrong(_draft(rng, 240, relief_m=0.05), rng, 0.2)
    return _periods(draft, rng.random(len(draft.pixels)) < 0.4, np.array([1.0, 0.0]))


def _obstacle(rng: np.random.Generator) -> _Draft:
    """A quarter of the photo shows something before the wall; its ties are guesses."""
    draft = _draft(rng, 300)
    hidden = (draft.pixels > 0.5 * np.array(SIZE_PX)).all(axis=1)
    return _guessed(draft, hidden, rng)


def _crowded_elsewhere(rng: np.random.Generator) -> _Draft:
    """Another room, whose key points all look like a few of this wall's."""
    draft = _draft(rng, 200)
    few = draft.points[rng.integers(0, 12, len(draft.points))]
    return _wrong(replace(draft, points=few), rng, 1.0)


def _mirrored(rng: np.random.Generator) -> _Draft:
    draft = _draft(rng, 200, relief_m=0.05 * rng.integers(0, 2))
    return replace(draft, pixels=[SIZE_PX[0], 0.0] + draft.pixels * [-1.0, 1.0])


def _other_textile(rng: np.random.Generator) -> _Draft:
    """Another wall with the same textile: each tie at any of its repeats."""
    draft = _draft(rng, 300)
    steps = rng.integers(-5, 6, (len(draft.pixels), 2)).astype(np.float64)
    return _periods(draft, np.ones(len(draft.pixels), np.bool_), steps)


def _textile_alone(rng: np.random.Generator) -> _Draft:
    """Ties on a textile that fills a third of the photo agree one period beside the truth."""
    draft = _draft(rng, 300)
    on_textile = draft.pixels[:, 0] < SIZE_PX[0] / 3
    step = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 1.0]])[rng.integers(3)]
    shifted = _periods(draft, on_textile, step)
    return _guessed(shifted, ~on_textile, rng)


def _wrong_calibration(rng: np.random.Generator) -> _Draft:
    """The calibration of another lens, a tenth to a third longer or shorter."""
    factor = rng.uniform(1.1, 1.33) ** rng.choice([-1.0, 1.0])
    draft = _wrong(_draft(rng, 200, relief_m=0.12 * rng.integers(0, 2)), rng, 0.2)
    return replace(draft, calibrated_factor=factor)


def _exif(draft: _Draft, factor: float) -> _Draft:
    return replace(draft, calibrated_factor=0.0, exif_factor=factor)


KINDS: Final[Mapping[str, tuple[bool, Callable[[np.random.Generator], _Draft]]]] = {
    "plane": (True, lambda rng: _wrong(_draft(rng, 200), rng, 0.3)),
    "plane, EXIF 2 % off": (
        True,
        lambda rng: _exif(_wrong(_draft(rng, 300), rng, 0.3), rng.choice([0.98, 1.02])),
    ),
    "relief, 60 % wrong": (True, lambda rng: _wrong(_draft(rng, 300, relief_m=0.12), rng, 0.6)),
    "relief, EXIF 5 % off": (
        True,
        lambda rng: _exif(
            _wrong(_draft(rng, 300, relief_m=0.12), rng, 0.4), rng.choice([0.95, 1.05])
        ),
    ),
    "80 % wrong": (True, lambda rng: _wrong(_draft(rng, 500, relief_m=0.05), rng, 0.8)),
    "40 ties": (True, lambda rng: _draft(rng, 40)),
    "oblique": (True, lambda rng: _wrong(_draft(rng, 300, tilt_deg=45.0), rng, 0.3)),
    "two fifths a period off": (True, _half_shifted),
    "end of the wall": (True, lambda rng: _wrong(_draft(rng, 200, aim=(1.7, 0.0)), rng, 0.3)),
    "obstacle": (True, _obstacle),
    "survey coordinates": (
        True,
        lambda rng: replace(
            _wrong(_draft(rng, 200), rng, 0.3), shift_m=tuple(SURVEY_SHIFT_M.tolist())
        ),
    ),
    "8 to 14 ties": (False, lambda rng: _wrong(_draft(rng, int(rng.integers(8, 15))), rng, 0.2)),
    "no focal length": (
        False,
        lambda rng: _exif(_wrong(_draft(rng, 300, relief_m=0.05), rng, 0.3), 0.0),
    ),
    "EXIF 30 % off": (
        False,
        lambda rng: _exif(_wrong(_draft(rng, 300), rng, 0.3), rng.choice([0.7, 1.3])),
    ),
    "calibration of another lens": (False, _wrong_calibration),
    "another room": (False, lambda rng: _wrong(_draft(rng, 300), rng, 1.0)),
    "another room, few places": (False, _crowded_elsewhere),
    "mirrored": (False, _mirrored),
    "the same textile elsewhere": (False, _other_textile),
    "textile a period off": (False, _textile_alone),
}
