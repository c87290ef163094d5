"""`simulate.curved`: scans and photos of a simulated curved building, with ground truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np
from pydantic import Field

from orthoflow.geometry import Sphere
from orthoflow.geometry.surfaces import middle_direction, transformed
from orthoflow.products import (
    Calibration,
    Cameras,
    Intrinsics,
    Photos,
    PointCloud,
    Surface,
    Surfaces,
    Truth,
    surface_kind,
)
from orthoflow.sdk import Determinism, Method, MethodParams, MetricSpec, Ports, StepContext
from orthoflow_plugins.simulate.curved_model import Building, Subject, build
from orthoflow_plugins.simulate.photographs import (
    WORST_ROLL_DEG,
    Film,
    Shot,
    draw_lens,
    shot_at,
    take_photos,
)

if TYPE_CHECKING:
    from orthoflow_plugins.simulate.deliverables import Delivery

# Range of elevations that the scanner measures; it includes vaults above the scanner.
_LOWEST_RAD: Final = math.radians(-60.0)
_HIGHEST_RAD: Final = math.radians(88.0)
# Distance from the scanner at which the point spacing is `scan_step_m`.
_STEP_AT_M: Final = 3.0
_FOOTPRINT_M: Final = (2.7, 2.0)
_GAP: Final = 0.3


class SimulateCurved(Method):
    """Scan and photograph a building with curved walls and random dimensions.

    The building is a barrel vault, a cross vault, an apse, a round tower seen from outside, a
    column of which half is hidden, a conical spire, a dome over an octagon, or a baptistery: a dome
    over columns and a font with a conical cover. It has furniture, mouldings and painted textures.
    Errors of the scanner and the photos are those of `simulate.room`.
    """

    id: ClassVar[str] = "simulate.curved"
    determinism: ClassVar[Determinism] = "seeded"
    result_version: ClassVar[int] = 2
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_points", label="points"),
        MetricSpec("n_photos", label="photos"),
        MetricSpec("n_true_surfaces", label="true curved surfaces"),
        MetricSpec("outlier_share", label="simulated outliers"),
    )

    class Params(MethodParams):
        """Parameters of the building, the scans and the photos."""

        subject: Subject = Field("barrel-vault", description="The kind of building.")
        scan_step_m: float = Field(
            0.01, gt=0.0, le=0.5, description="Point spacing at a distance of 3 m."
        )
        noise_m: float = Field(
            0.002,
            ge=0.0,
            le=0.1,
            description="Range noise (one standard deviation) at 3 m and normal incidence.",
        )
        outlier_share: float = Field(
            0.004, ge=0.0, le=0.5, description="Share of points with a random range (outliers)."
        )
        beam_m: float = Field(
            0.003,
            ge=0.0,
            le=0.05,
            description="Diameter of the laser spot, which causes mixed points at edges.",
        )
        relief_scale: float = Field(
            1.0, ge=0.0, le=2.0, description="Scale of the mouldings; 1 gives 3 to 6 cm."
        )
        max_stations: int | None = Field(
            None, ge=1, description="Maximum number of stations; by default, two to four."
        )
        photo_gsd_m: float | None = Field(
            None, gt=0.0, le=0.1, description="Photo pixel size on the wall; by default no photos."
        )
        shift_world_m: tuple[float, float, float] = Field(
            (0.0, 0.0, 0.0), description="World position of the building's origin."
        )

    class In(Ports):
        """No inputs."""

    class Out(Ports):
        """The scan, the photos and the ground truth; `cameras` are the true poses."""

        cloud: PointCloud
        photos: Photos
        cameras: Cameras
        calibration: Calibration
        truth: Truth

    @classmethod
    def tools(cls) -> Mapping[str, str]:
        """Return numba and NumPy, which compute the points, and OpenCV, which writes JPEG files."""
        return {name: version(name) for name in ("numba", "numpy", "opencv-python-headless")}

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Build the scene, simulate scans and photos, and return these with the ground truth."""
        del inputs
        from orthoflow.geometry.scene_views import SceneCameras
        from orthoflow_plugins.simulate.deliverables import (
            Delivery,
            cloud_of,
            report_photos,
            truth_of,
        )
        from orthoflow_plugins.simulate.room_model import Room
        from orthoflow_plugins.simulate.scanning import Errors, Sweep, scan_scene

        rng, scan_rng, photo_rng = ctx.rng.spawn(3)
        building = build(params.subject, rng, relief=params.relief_scale, gap=_GAP)
        step = params.scan_step_m / _STEP_AT_M
        sweeps = [
            Sweep(
                station=station,
                azimuth=0.0,
                elevation=_LOWEST_RAD,
                step=step,
                n_columns=max(1, math.floor(2.0 * math.pi / step)),
                n_rows=max(1, math.floor((_HIGHEST_RAD - _LOWEST_RAD) / step)),
                seed=int(scan_rng.integers(0, 2**62)),
            )
            for station in building.stations[: params.max_stations]
        ]
        errors = Errors(
            noise_m=params.noise_m,
            outlier_share=params.outlier_share,
            beam_m=params.beam_m,
            colour_noise=2.0,
            inversion=0.0,
            band_seed=0,
        )
        delivery = Delivery(
            room=Room(scene=building.scene, planes=building.planes),
            scan=scan_scene(building.scene, sweeps, errors, ctx),
            world_from_room=np.eye(3),
            shift_world_m=np.array(params.shift_world_m),
        )
        shots = _shots(building, params.photo_gsd_m, photo_rng)
        known = (Intrinsics.of(shots[0].camera),) if shots else ()
        photos = take_photos(
            SceneCameras(building.scene, cores=ctx.cores) if shots else (),
            shots,
            Film(noise_grey=1.5, vignetting=0.1, supersample=2, exposures=0.0),
            ctx,
            photo_rng,
            intrinsics=known[0] if known else None,
        )
        cloud = cloud_of(delivery)
        truth = truth_of(delivery, cloud, shots, params.model_dump(mode="json"))
        truth = replace(
            truth,
            surfaces=_true_surfaces(building, delivery),
            lowest_elevation_deg=math.degrees(_LOWEST_RAD),
            highest_elevation_deg=math.degrees(_HIGHEST_RAD),
        )
        ctx.metric("n_points", len(cloud), "1")
        ctx.metric("n_true_surfaces", len(building.surfaces), "1")
        ctx.metric("outlier_share", truth.n_spoilt / max(1, len(cloud)), "1")
        report_photos(photos, shots, ctx)
        return self.Out(
            cloud=cloud,
            photos=photos,
            cameras=truth.cameras or Cameras(cameras=()),
            calibration=Calibration(patterns=("*",) * len(known), intrinsics=known),
            truth=truth,
        )


def _true_surfaces(building: Building, delivery: Delivery) -> Surfaces:
    rectangle = delivery.scan.points.rectangle
    own = building.on_surface[rectangle[rectangle >= 0]]
    counts = np.bincount(own + 1, minlength=len(building.surfaces) + 1)[1:]
    surfaces = []
    for index, chosen in enumerate(np.argsort(-counts, kind="stable").tolist()):
        true = building.surfaces[chosen]
        shape, zero = transformed(true.shape, np.eye(3), delivery.shift_world_m), true.zero
        if isinstance(shape, Sphere):
            zero = middle_direction(zero[None], delivery.up_world)
        surfaces.append(
            Surface(
                name=f"{surface_kind(shape, delivery.up_world, zero)} {index}",
                shape=shape,
                covariance=np.zeros((7, 7)),
                n_points=int(counts[chosen]),
                rms_m=0.0,
                zero_world=zero,
                along_m=true.along_m,
                arc_rad=true.arc_rad,
            )
        )
    return Surfaces(surfaces=tuple(surfaces), up=delivery.up_world, details={"true": True})


def _shots(building: Building, gsd_m: float | None, rng: np.random.Generator) -> tuple[Shot, ...]:
    if gsd_m is None:
        return ()
    lens = draw_lens(rng, _FOOTPRINT_M, building.photographed[0][2], gsd_m)
    shots = []
    for place, (point, normal, distance_m) in enumerate(building.photographed):
        aside = rng.uniform(-0.15, 0.15, 3) * distance_m
        centre = point + distance_m * normal + aside - float(aside @ normal) * normal
        roll_deg = float(rng.uniform(-WORST_ROLL_DEG, WORST_ROLL_DEG))
        name = f"photo_{place:02d}.jpg"
        shots.append(shot_at(name, "", lens, centre, (point, normal), roll_deg))
    return tuple(shots)
