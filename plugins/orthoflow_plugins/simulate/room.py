"""`simulate.room`: scans and photos of a simulated palace room, with ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from typing import ClassVar, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from orthoflow.geometry import UpDirection, basis_from_up, up_vector
from orthoflow.products import (
    Calibration,
    Cameras,
    CheckPoints,
    Intrinsics,
    Photos,
    PointCloud,
    Truth,
)
from orthoflow.sdk import Determinism, Method, MethodParams, MetricSpec, Ports, StepContext
from orthoflow_plugins.simulate.photographs import (
    Film,
    PhotoLayout,
    planned_shots,
    take_photos,
    with_passers_by,
)
from orthoflow_plugins.simulate.room_model import (
    DESIGNED,
    MOST_TEXTILE,
    TEXTILE_BY_DESIGN,
    Geometry,
    build_room,
)

SpectralGap = Literal["none", "easy", "hard", "inverted"]

_PANORAMA_FACTOR: Final = 3.0
# Share of the pattern measured by the laser that differs from the visible pattern.
_SPECTRAL_GAPS: Final[Mapping[SpectralGap, float]] = {
    "none": 0.0,
    "easy": 0.3,
    "hard": 0.7,
    "inverted": 0.3,
}


class SimulateRoom(Method):
    """Scan and photograph a decorated room with relief, a niche, a door and a free-standing object.

    There are two scans per station: a panorama, and a detail scan of the main wall. Points are
    sorted by scan, column and row (from bottom to top). The noise of a distance depends on range,
    incidence angle and material. Some points are gross outliers, and at edges, the distances of two
    surfaces are mixed. All noise is a function of the seed and the position in the scan, so it does
    not depend on the number of threads.

    Photos are taken with a hand-held camera, which has Brown distortion and is slightly displaced
    and rotated, and are stored as JPEG files in the sRGB colours of the scene. `photos` is empty
    for `photo_layout: none`, and `calibration` is empty if the camera is not calibrated. The EXIF
    data always contain the focal length, with an error of up to 2 %.
    """

    id: ClassVar[str] = "simulate.room"
    determinism: ClassVar[Determinism] = "seeded"
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_points", label="points"),
        MetricSpec("n_photos", label="photos"),
        MetricSpec("n_true_planes", label="true planes"),
        MetricSpec("main_wall_points", label="points on the main wall"),
        MetricSpec("outlier_share", label="simulated outliers"),
        MetricSpec("photo_gsd_mm", label="photo pixel size on the wall"),
        MetricSpec("photo_megapixels", label="megapixels in total"),
        MetricSpec(
            "photo_obliquity_max_deg", label="largest angle between optical axis and wall normal"
        ),
        MetricSpec("scan_step_median_mm", label="point spacing on the main wall, median"),
        MetricSpec("scan_step_p90_mm", label="point spacing on the main wall, 90th percentile"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (the kind of room)",
    )

    class Params(MethodParams):
        """Parameters of the room, its position in the world, the scans and the photos."""

        scan_step_m: float = Field(
            0.0042,
            gt=0.0,
            le=0.5,
            description="Point spacing on the main wall, directly in front of the station.",
        )
        panorama_step_m: float | None = Field(
            None,
            gt=0.0,
            le=0.5,
            description="Point spacing of the panoramas, which cover the rest of the room; by "
            "default three times scan_step_m.",
        )
        n_stations: int = Field(2, ge=1, le=4, description="Number of scanner stations.")
        noise_m: float = Field(
            0.0015,
            ge=0.0,
            le=0.1,
            description="Range noise (one standard deviation) at 3 m and normal incidence on a "
            "plain wall.",
        )
        registration_error_m: float = Field(
            0.0,
            ge=0.0,
            le=0.1,
            description="Registration error of a station: standard deviation of each coordinate "
            "of its position.",
        )
        bending_m: float = Field(
            0.0,
            ge=0.0,
            le=0.5,
            description="Bending of the cloud: displacement 5 m from the middle of the room, as "
            "in clouds from SLAM or photos.",
        )
        shared_noise_m: float = Field(
            0.0,
            ge=0.0,
            le=0.1,
            description="Standard deviation of the coordinate error that neighbouring points "
            "share, as in clouds from photos.",
        )
        shared_noise_length_m: float = Field(
            1.0, gt=0.0, le=50.0, description="Correlation length of the shared error."
        )
        colour_noise_grey: float = Field(
            2.0, ge=0.0, le=50.0, description="Colour noise of the points (one standard deviation)."
        )
        outlier_share: float = Field(
            0.004, ge=0.0, le=0.5, description="Share of points with a random range (outliers)."
        )
        beam_m: float = Field(
            0.003,
            ge=0.0,
            le=0.05,
            description="Diameter of the laser spot, which causes mixed points at edges; 0: no "
            "mixed points.",
        )
        relief_scale: float = Field(
            1.0,
            ge=0.0,
            le=2.0,
            description="Scale of the relief of all mouldings: 1 gives 2 to 15 cm, 0 none. "
            "Niches and doors keep their depth.",
        )
        decoration: Literal["designed", "drawn"] = Field(
            "designed",
            description="designed: a fixed wall; drawn: random cornices, pilasters, niches, "
            "panels and recessed doors, with relief up to 0.3 m and recesses up to 0.45 m.",
        )
        design_seed: int | None = Field(
            default=None,
            ge=0,
            description="Seed of a drawn room, with which each dataset can have a different "
            "room; by default, the seed of the workflow. Scanning errors do not depend on "
            "this seed.",
        )
        obstacle: bool = Field(
            default=True, description="Place an object 0.6 m in front of the main wall."
        )
        spectral_gap: SpectralGap = Field(
            "easy",
            description="How the laser intensity relates to the colours. none: it shows the "
            "painted patterns; easy: mostly the painted patterns; hard: mostly other patterns; "
            "inverted: it decreases where red increases, with wet patches and retroreflective "
            "spots.",
        )
        spectral_inversion_share: float | None = Field(
            None,
            ge=0.0,
            le=1.0,
            description="Share of the inverted contrast in the laser intensity; by default 1 for "
            "`inverted`, else 0. Gains, signs and exponents are random for each material.",
        )
        textile_share: float | None = Field(
            None,
            ge=0.0,
            le=MOST_TEXTILE,
            description="Share of the main wall covered by cloth with a repeated motif; by "
            "default 0.095 for the designed wall and 0 for a drawn one.",
        )
        n_plaques: int = Field(
            0,
            ge=0,
            le=40,
            description="Number of plaques on a drawn main wall, 12 to 45 cm wide and 2 to 15 "
            "cm thick. Their corners serve as check points at edges. If there is not enough "
            "space, fewer are added.",
        )
        photo_layout: PhotoLayout = Field(
            "none",
            description="none: no photos; quick: 6 photos of the main wall; variant1: 8 photos "
            "of four walls, each of a whole wall; variant2: a block of 18 photos of the main wall "
            "with 70 % forward and 50 % side overlap.",
        )
        photo_gsd_m: float = Field(
            0.002, gt=0.0, le=0.1, description="Photo pixel size on the wall."
        )
        photo_obliquity_deg: float = Field(
            12.0,
            ge=0.0,
            le=45.0,
            description="Largest intended angle between optical axis and wall normal.",
        )
        photo_noise_grey: float = Field(
            1.5,
            ge=0.0,
            le=50.0,
            description="Image noise (one standard deviation of a pixel value).",
        )
        photo_vignetting_share: float = Field(
            0.1,
            ge=0.0,
            le=0.9,
            description="Vignetting: share of the light lost in the corners of a photo.",
        )
        photo_exposure_share: float = Field(
            0.0,
            ge=0.0,
            le=0.9,
            description="Largest relative change x of the exposure: each photo gets between 1 - "
            "x and 1 + x times the light.",
        )
        n_passers_by: int = Field(
            0,
            ge=0,
            le=20,
            description="Number of people who walk in front of the main wall while photos are "
            "taken: each appears in about half of the photos, in different positions. The "
            "scan does not contain them.",
        )
        photo_supersample: int = Field(
            2,
            ge=1,
            le=8,
            description="Rays per pixel along each axis; a pixel is the mean of all its rays.",
        )
        calibrated: bool = Field(default=True, description="Output the calibration of the camera.")
        check_points_most: int = Field(
            24,
            ge=1,
            description="Maximum number of check points on flat parts of the main wall, and "
            "likewise on vertical edges.",
        )
        up: UpDirection = Field("z", description="World direction that is up.")
        geometry: Literal["designed", "drawn"] = Field(
            "designed",
            description="designed: a fixed room; drawn: random directions, tilts and distances "
            "of all planes, station positions and rotation of the room, so that nothing "
            "coincides with the steps of a search.",
        )
        turn_deg: float = Field(0.0, description="Rotation of the room about the up axis.")
        shift_world_m: tuple[float, float, float] = Field(
            (0.0, 0.0, 0.0),
            description="World position of the room's origin, such as survey coordinates.",
        )

        @model_validator(mode="after")
        def _only_drawn_rooms_have_a_seed(self) -> Self:
            if self.n_plaques and self.decoration != "drawn":
                raise ValueError(
                    f"n_plaques {self.n_plaques} is for drawn walls, but decoration is "
                    f"{self.decoration}: set decoration to drawn, or omit n_plaques"
                )
            if self.design_seed is not None and self.decoration != "drawn":
                raise ValueError(
                    f"design_seed {self.design_seed} applies only to drawn rooms, but decoration "
                    f"is {self.decoration}: set decoration to drawn, or omit design_seed"
                )
            return self

    class In(Ports):
        """No inputs."""

    class Out(Ports):
        """The scan, the photos and the ground truth; `cameras` are the true poses."""

        cloud: PointCloud
        photos: Photos
        cameras: Cameras
        calibration: Calibration
        checkpoints: CheckPoints
        truth: Truth

    @classmethod
    def tools(cls) -> Mapping[str, str]:
        """Return numba and NumPy, which compute the points, and OpenCV, which writes JPEG files."""
        return {name: version(name) for name in ("numba", "numpy", "opencv-python-headless")}

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Build the room, simulate scans and photos, and return these with the ground truth."""
        del inputs
        from orthoflow.geometry.scene_views import SceneCameras
        from orthoflow_plugins.simulate.deliverables import (
            Delivery,
            check_points,
            cloud_of,
            report_photos,
            report_room,
            truth_of,
        )
        from orthoflow_plugins.simulate.scanning import (
            Errors,
            planned_sweeps,
            scan_scene,
            station_positions,
        )

        scan_rng, photo_rng, wall_rng = ctx.rng.spawn(3)
        # Use a separate random stream, so that noise and photos are the same as in the designed
        # room.
        place_rng = ctx.rng.spawn(1)[0]
        if params.design_seed is not None:
            wall_rng = np.random.default_rng(params.design_seed)
            place_rng = wall_rng.spawn(1)[0]
        is_moved, is_drawn = params.geometry == "drawn", params.decoration == "drawn"
        geometry = Geometry.drawn(place_rng) if is_moved else DESIGNED
        textile_share = params.textile_share
        if textile_share is None:
            textile_share = 0.0 if is_drawn else TEXTILE_BY_DESIGN
        room = build_room(
            wall_rng if is_drawn else None,
            relief=params.relief_scale,
            obstacle=params.obstacle,
            spectral_gap=_SPECTRAL_GAPS[params.spectral_gap],
            textile_share=textile_share,
            n_plaques=params.n_plaques,
            geometry=geometry,
        )
        turn_deg = params.turn_deg + (float(place_rng.uniform(0.0, 360.0)) if is_moved else 0.0)
        stations = station_positions(params.n_stations, place_rng if is_moved else None)
        seeds = scan_rng.integers(0, 2**62, size=2 * params.n_stations)
        inversion = params.spectral_inversion_share
        if inversion is None:
            inversion = float(params.spectral_gap == "inverted")
        errors = Errors(
            noise_m=params.noise_m,
            outlier_share=params.outlier_share,
            beam_m=params.beam_m,
            colour_noise=params.colour_noise_grey,
            inversion=inversion,
            band_seed=int(seeds[0]),
            registration_m=params.registration_error_m,
            bending_m=params.bending_m,
            shared_m=params.shared_noise_m,
            shared_length_m=params.shared_noise_length_m,
        )
        panorama_step_m = params.panorama_step_m or _PANORAMA_FACTOR * params.scan_step_m
        main = room.planes[0]
        sweeps = planned_sweeps(
            stations, (panorama_step_m, params.scan_step_m), main.plane, main.outline, seeds
        )
        delivery = Delivery(
            room=room,
            scan=scan_scene(room.scene, sweeps, errors, ctx),
            world_from_room=basis_from_up(up_vector(params.up)).T @ turn_about_up(turn_deg),
            shift_world_m=np.array(params.shift_world_m),
        )
        shots = planned_shots(
            params.photo_layout,
            photo_rng,
            gsd_m=params.photo_gsd_m,
            obliquity_deg=params.photo_obliquity_deg,
            geometry=geometry,
        )
        known = (Intrinsics.of(shots[0].camera),) if shots and params.calibrated else ()
        views = SceneCameras(room.scene, cores=ctx.cores)
        crowd = with_passers_by(room.scene, len(shots), params.n_passers_by, photo_rng)
        film = Film(
            noise_grey=params.photo_noise_grey,
            vignetting=params.photo_vignetting_share,
            supersample=params.photo_supersample,
            exposures=params.photo_exposure_share,
        )
        photos = take_photos(
            [SceneCameras(scene, cores=ctx.cores) for scene in crowd] or views,
            shots,
            film,
            ctx,
            photo_rng,
            intrinsics=known[0] if known else None,
        )
        cloud = cloud_of(delivery)
        settings = params.model_dump(mode="json") | {"textile_share": textile_share}
        truth = truth_of(delivery, cloud, shots, settings)
        report_room(truth, cloud, ctx)
        report_photos(photos, shots, ctx)
        return self.Out(
            cloud=cloud,
            photos=photos,
            cameras=truth.cameras or Cameras(cameras=()),
            calibration=Calibration(patterns=("*",) * len(known), intrinsics=known),
            checkpoints=check_points(delivery, views, n_most=params.check_points_most),
            truth=truth,
        )


def turn_about_up(turn_deg: float) -> NDArray[np.float64]:
    """Return the rotation (3, 3) about the room's z axis; for 0 degrees, exactly the identity."""
    if turn_deg == 0.0:
        return np.eye(3)
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
