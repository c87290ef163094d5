"""Simulated photos: camera positions, the camera and JPEG files.

The layouts are those of markiewicz2015. Photos have the defects of real lenses and sensors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import encode_jpeg
from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.geometry.scenes import Scene, SurfaceRole, TextureKind
from orthoflow.products import (
    Camera,
    Cameras,
    Intrinsics,
    Photo,
    Photos,
    TakenPhoto,
)
from orthoflow.sdk import StepContext
from orthoflow_plugins.simulate.building import Paint, SceneDraft, Surface
from orthoflow_plugins.simulate.room_model import DESIGNED, Geometry, main_wall_axes

if TYPE_CHECKING:
    from orthoflow.geometry.scene_views import SceneCameras

PhotoLayout = Literal["none", "quick", "variant1", "variant2"]

# Bounds of the space free of furniture and walls, in metres from the room's origin: along the main
# wall, towards it, and upwards.
_FREE_LOW_M: Final = (-2.3, -1.65, -1.15)
_FREE_HIGH_M: Final = (2.3, 1.95, 1.3)
# Up to this height above the room's origin, there is furniture in the half of the room that is
# farther from the main wall.
_FURNITURE_M: Final = -0.45
WORST_ROLL_DEG: Final = 3.0
_UP: Final = np.array([0.0, 0.0, 1.0])
_JPEG_QUALITY: Final = 95
# Legs and upper body of a person: heights of the lower and upper ends above the room's origin, and
# half the width, in metres.
_BODY_M: Final = ((-1.45, -0.6, 0.17), (-0.6, 0.3, 0.25))
_ABSENT: Final = 0.5
_OF_PEOPLE: Final = (
    *("centre", "axis_a", "axis_b", "extent"),
    *("plane_index", "role", "texture", "texture_params"),
)
# Maximum relative error of the focal length in the EXIF data.
_EXIF_ERROR: Final = 0.02
# Grey levels are approximately proportional to light intensity to the power of 1 / gamma.
_GAMMA: Final = 2.2


@dataclass(frozen=True, kw_only=True)
class Shot:
    """A photo to be taken.

    Attributes:
        taken: name of the photo, and acquisition parameters.
        camera: the camera, in the room frame.
    """

    taken: TakenPhoto
    camera: ViewingCamera


@dataclass(frozen=True, kw_only=True)
class Film:
    """Degradation of images.

    Attributes:
        noise_grey: standard deviation of the noise per pixel and channel, grey levels.
        vignetting: share of the light that is lost in the corners.
        supersample: number of rays along each side of a pixel.
        exposures: maximum relative deviation of a photo's exposure.
    """

    noise_grey: float
    vignetting: float
    supersample: int
    exposures: float


def _block(
    along: Sequence[float], up: Sequence[float], walls: Sequence[int] = (0,)
) -> tuple[tuple[int, float, float], ...]:
    return tuple((wall, a, b) for wall in walls for b in up for a in along)


# For each layout: width and height of the area shown on the wall, and distance from the wall, in
# metres; targets of the photos, given by the number of the wall and a position (a, b) on it.
_LAYOUTS: Final = {
    # Six photos of the main wall with 25 % overlap.
    "quick": ((2.4, 1.8), 2.6, _block((-1.75, 0.0, 1.75), (-0.65, 0.75))),
    # Eight photos, each of a whole wall: two of each of the four walls.
    "variant1": ((5.9, 3.5), 3.95, _block((-0.1, 0.1), (0.05,), range(4))),
    # A block of photos of the main wall, with an overlap of 70 % in a row and 50 % between rows.
    "variant2": (
        (2.4, 1.8),
        2.6,
        _block((-1.8, -1.08, -0.36, 0.36, 1.08, 1.8), (-0.8, 0.1, 1.0)),
    ),
}
_WALL_NAMES: Final = ("main wall", "opposite wall", "right wall", "left wall")


def planned_shots(
    layout: PhotoLayout,
    rng: np.random.Generator,
    *,
    gsd_m: float,
    obliquity_deg: float,
    geometry: Geometry = DESIGNED,
) -> tuple[Shot, ...]:
    """Plan the photos of a layout, with random variations of their positions.

    The camera is aimed at a target, but is displaced sideways and slightly rotated about its axis.
    All photos are taken with the same camera, with Brown distortion.

    Args:
        layout: the layout of the photos.
        rng: random generator for the lens and the positions.
        gsd_m: pixel size on the wall in metres.
        obliquity_deg: maximum intended angle between the optical axis and the wall normal.
        geometry: positions of the walls.
    """
    if layout == "none":
        return ()
    footprint_m, distance_m, targets = _LAYOUTS[layout]
    sides = geometry.sides(SceneDraft())
    lens = draw_lens(rng, footprint_m, distance_m, gsd_m)
    shots = []
    for place, (wall, *target) in enumerate(targets):
        side = sides[wall]
        a, b = np.array(target) + rng.uniform(-0.02, 0.02, 2) * footprint_m
        aim = side.foot + a * side.axis_a + b * side.axis_b
        tilt = math.radians(obliquity_deg) * rng.uniform(0.4, 1.0)
        turn = rng.uniform(0.0, 2.0 * math.pi)
        aside = math.cos(turn) * side.axis_a + math.sin(turn) * side.axis_b
        centre = place_to_stand(
            aim + distance_m * (math.cos(tilt) * side.normal + math.sin(tilt) * aside)
        )
        roll_deg = float(rng.uniform(-WORST_ROLL_DEG, WORST_ROLL_DEG))
        name = f"photo_{place:02d}.jpg"
        shots.append(shot_at(name, _WALL_NAMES[wall], lens, centre, (aim, side.normal), roll_deg))
    return tuple(shots)


def draw_lens(
    rng: np.random.Generator, footprint_m: tuple[float, float], distance_m: float, gsd_m: float
) -> Intrinsics:
    """Return a random lens that shows an area, at a given distance, with a given pixel size."""
    width, height = (max(16, round(side / gsd_m)) for side in footprint_m)
    off_centre = rng.uniform(-0.006, 0.006, 2) * width
    scatter = np.append(rng.uniform(-1.0, 1.0, 4), 0.0)
    distortion = np.array([-0.08, 0.02, 0.0, 0.0, 0.0])
    distortion += np.array([0.01, 0.005, 0.0005, 0.0005, 0.0]) * scatter
    return Intrinsics(
        width=width,
        height=height,
        fx=distance_m / gsd_m,
        fy=distance_m / gsd_m,
        cx=float(width / 2 + off_centre[0]),
        cy=float(height / 2 + off_centre[1]),
        distortion=tuple(distortion.tolist()),
        source="truth",
    )


def shot_at(
    name: str,
    wall: str,
    lens: Intrinsics,
    centre: NDArray[np.float64],
    aim: tuple[NDArray[np.float64], NDArray[np.float64]],
    roll_deg: float,
) -> Shot:
    """Return a photo that is taken from a centre, aimed at a point on a wall, and rotated.

    If the camera looks straight up or down, the upper side of the photo is in the direction of x.
    """
    target, normal = aim
    cos, sin = math.cos(math.radians(roll_deg)), math.sin(math.radians(roll_deg))
    about_axis = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    is_level = np.linalg.norm((target - centre)[:2]) > 1e-6
    rotation = about_axis @ looking_at(centre, target, _UP if is_level else np.eye(3)[0])
    taken = TakenPhoto(
        photo=name,
        wall=wall,
        gsd_m=float(np.linalg.norm(target - centre)) / lens.fx,
        obliquity_deg=math.degrees(math.acos(min(1.0, float(-rotation[2] @ normal)))),
        roll_deg=roll_deg,
    )
    return Shot(taken=taken, camera=lens.posed(rotation, -rotation @ centre))


def with_passers_by(
    scene: Scene, n_photos: int, count: int, rng: np.random.Generator
) -> tuple[Scene, ...]:
    """Return the scene of each photo, with people in front of the main wall; empty if count is 0.

    Each person is in about half of the photos, chosen at random, 0.5 to 1.4 m in front of the wall,
    and wears the same clothes in all photos.
    """
    if not count:
        return ()
    # Use a separate random stream, so that people do not change the other random numbers.
    drawn = rng.spawn(1)[0]
    clothes = drawn.uniform(15.0, 240.0, (count, 2, 3))
    along, towards = main_wall_axes()
    side = DESIGNED.sides(SceneDraft())[0]
    scenes = []
    for _ in range(n_photos):
        draft = SceneDraft()
        for person in range(count):
            place, before_m = drawn.uniform(-2.2, 2.2), drawn.uniform(0.5, 1.4)
            if drawn.random() >= _ABSENT:
                continue
            foot = side.foot + place * along - before_m * towards
            centre = np.array([foot[0], foot[1], 0.0])
            for (low, high, half), rgb in zip(_BODY_M, clothes[person], strict=True):
                paint = Paint(TextureKind.PLAIN, tuple(rgb), 0.5, 0.1, 0.3, 900 + person)
                extent = (-half, half, low, high)
                draft.surfaces.append(
                    Surface(centre, along, _UP, extent, paint, SurfaceRole.OBJECT)
                )
        if not draft.surfaces:
            scenes.append(scene)
            continue
        people = draft.finished(spectral_gap=0.0)
        joined = {
            name: np.concatenate([getattr(scene, name), getattr(people, name)])
            for name in _OF_PEOPLE
        }
        scenes.append(replace(scene, **joined))
    return tuple(scenes)


def take_photos(
    views: SceneCameras | Sequence[SceneCameras],
    shots: tuple[Shot, ...],
    film: Film,
    ctx: StepContext,
    rng: np.random.Generator,
    *,
    intrinsics: Intrinsics | None = None,
) -> Photos:
    """Render all photos of a room, in the room frame.

    Args:
        views: the room, or one scene per photo.
        shots: the photos.
        film: degradation of the images.
        ctx: context of the step.
        rng: random generator for the noise.
        intrinsics: known calibration of the camera, or None.
    """
    if not shots:
        return Photos(photos=())
    exif_focal = shots[0].camera.fx * (1.0 + rng.uniform(-_EXIF_ERROR, _EXIF_ERROR))
    # Use a separate random stream, so that exposures do not change the other random numbers.
    light = 1.0 + film.exposures * rng.spawn(1)[0].uniform(-1.0, 1.0, len(shots))
    photos = []
    for place, shot in enumerate(shots):
        ctx.progress(0.5 + 0.5 * place / len(shots), f"photo {place + 1} of {len(shots)}")
        seed = int(rng.integers(0, 2**62))
        view = views[place] if isinstance(views, Sequence) else views
        image = view.expose(shot.camera, supersample=film.supersample, seed=seed)
        if film.exposures > 0.0:
            image *= np.float32(light[place] ** (1.0 / _GAMMA))
        photos.append(
            Photo(
                name=shot.taken.photo,
                encoded=encode_jpeg(developed_photo(image, film, rng), quality=_JPEG_QUALITY),
                width=shot.camera.width,
                height=shot.camera.height,
                exif_focal_px=exif_focal,
                intrinsics=intrinsics,
            )
        )
    return Photos(photos=tuple(photos))


def true_cameras(
    shots: tuple[Shot, ...],
    world_from_room: NDArray[np.float64],
    shift_world_m: NDArray[np.float64],
) -> Cameras:
    """Return the true camera poses in world coordinates.

    Args:
        shots: the photos, in the room frame.
        world_from_room: (3, 3) rotation from the room frame to world axes.
        shift_world_m: (3,) world position of the room's origin.
    """
    cameras = []
    for shot in shots:
        rotation = shot.camera.rotation @ world_from_room.T
        cameras.append(
            Camera(
                photo=shot.taken.photo,
                status="ok",
                intrinsics=Intrinsics.of(shot.camera, source="truth"),
                rotation_camera_from_world=rotation,
                translation_camera_from_world=shot.camera.translation - rotation @ shift_world_m,
            )
        )
    return Cameras(cameras=tuple(cameras))


def place_to_stand(wanted: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the free position in the room that is nearest to a given position (3,)."""
    axes = np.vstack([main_wall_axes(), _UP])
    place = np.clip(axes @ wanted, _FREE_LOW_M, _FREE_HIGH_M)
    if place[1] < -0.35 or place[1] > 1.2:
        place[2] = max(place[2], _FURNITURE_M + (0.4 if place[1] > 1.2 else 0.0))
    return axes.T @ place


def developed_photo(
    image: NDArray[np.float32], film: Film, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Apply vignetting, add noise, and round to grey levels."""
    height, width = image.shape[:2]
    rows = (np.arange(height, dtype=np.float32) + 0.5) / height - 0.5
    columns = (np.arange(width, dtype=np.float32) + 0.5) / width - 0.5
    radius2 = 2.0 * (rows[:, None] ** 2 + columns[None, :] ** 2)  # 1 in the corners
    noisy = image * (1.0 - film.vignetting * radius2**2)[:, :, None]
    if film.noise_grey > 0.0:
        noisy = noisy + film.noise_grey * rng.standard_normal(image.shape, dtype=np.float32)
    developed: NDArray[np.uint8] = np.clip(np.rint(noisy), 0.0, 255.0).astype(np.uint8)
    return developed
