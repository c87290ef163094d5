"""`simulate.room`: a scanned palace room of which everything is known."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from orthoflow.geometry import UpDirection, basis_from_up, up_vector
from orthoflow.products import PointCloud, Truth
from orthoflow.sdk import Determinism, Method, MethodParams, Ports, StepContext
from orthoflow_plugins.simulate.palace import RoomPlan, build_room

if TYPE_CHECKING:
    from orthoflow_plugins.simulate.scan_kernels import Errors


class SimulateRoom(Method):
    """Scan a decorated room with relief, niche, door recess and an object before the main wall.

    Two scans per station: a panorama, and a detail scan of the main wall. Points come scan by
    scan, column by column, from the lowest row up. Distances are noisy by range, incidence and
    material; some points are gross outliers, and at edges the distances of two surfaces mix. All
    noise is a function of the seed and the place in the scan, so threads cannot change it.
    """

    id: ClassVar[str] = "simulate.room"
    result_version: ClassVar[int] = 1
    determinism: ClassVar[Determinism] = "seeded"
    citations: ClassVar[tuple[str, ...]] = (
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71114870 (the kind of room)",
    )

    class Params(MethodParams):
        """How the room is scanned, and where in the world it lies."""

        scan_step_m: float = Field(
            0.0042,
            gt=0.0,
            le=0.5,
            description="Spacing of a station's points on the main wall, right before the station.",
        )
        panorama_step_m: float = Field(
            0.012,
            gt=0.0,
            le=0.5,
            description="The same for the panoramas, which cover the rest of the room.",
        )
        n_stations: int = Field(2, ge=1, le=4, description="Number of scanner stations.")
        noise_m: float = Field(
            0.0015,
            ge=0.0,
            le=0.1,
            description="Standard deviation of a distance at 3 m, square onto a plain wall.",
        )
        colour_noise_grey: float = Field(
            2.0, ge=0.0, le=50.0, description="Standard deviation of a point's colour."
        )
        outlier_share: float = Field(
            0.004, ge=0.0, le=0.5, description="Share of points at a random distance."
        )
        beam_m: float = Field(
            0.003,
            ge=0.0,
            le=0.05,
            description="Diameter of the laser spot; distances mix at edges. 0 mixes none.",
        )
        relief: float = Field(
            1.0,
            ge=0.0,
            le=2.0,
            description="Scale of all mouldings; 1 gives 2 to 15 cm, 0 none.",
        )
        obstacle: bool = Field(
            default=True, description="An object stands free 0.6 m before the main wall."
        )
        spectral_gap: float = Field(
            0.3,
            ge=0.0,
            le=1.0,
            description="0: the laser sees the painted patterns; 1: it sees other ones.",
        )
        up: UpDirection = Field("z", description="World direction that is up.")
        shift_world_m: tuple[float, float, float] = Field(
            (0.0, 0.0, 0.0), description="World position of the room's origin, survey coordinates."
        )

    class In(Ports):
        """No inputs."""

    class Out(Ports):
        """The scan and the truth about it."""

        cloud: PointCloud
        truth: Truth

    @classmethod
    def tools(cls) -> Mapping[str, str]:
        """Give the compiler, whose mathematical functions make the points."""
        return {"numba": version("numba"), "numpy": version("numpy")}

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Build the room, scan it, and write down the truth."""
        del inputs
        from orthoflow_plugins.simulate.deliverables import Delivery, cloud_of, truth_of
        from orthoflow_plugins.simulate.reporting import report_room
        from orthoflow_plugins.simulate.scanner import SweepPlan, planned_sweeps, scan_scene

        room = build_room(
            RoomPlan(
                relief=params.relief, obstacle=params.obstacle, spectral_gap=params.spectral_gap
            )
        )
        plan = SweepPlan(
            n_stations=params.n_stations,
            scan_step_m=params.scan_step_m,
            panorama_step_m=params.panorama_step_m,
        )
        main_wall = room.planes[0]
        seeds = ctx.rng.integers(0, 2**62, size=2 * params.n_stations)
        sweeps = planned_sweeps(plan, main_wall.plane, main_wall.outline, seeds)
        scan = scan_scene(room.scene, sweeps, _errors(params), ctx)
        delivery = Delivery(
            room=room,
            scan=scan,
            world_from_room=basis_from_up(up_vector(params.up)).T,
            shift_world_m=np.array(params.shift_world_m),
        )
        cloud = cloud_of(delivery)
        truth = truth_of(delivery, cloud, params.model_dump(mode="json"))
        report_room(truth, cloud, ctx)
        return self.Out(cloud=cloud, truth=truth)


def _errors(params: SimulateRoom.Params) -> Errors:
    from orthoflow_plugins.simulate.scan_kernels import Errors

    return Errors(
        noise_m=params.noise_m,
        outlier_share=params.outlier_share,
        beam_m=params.beam_m,
        colour_noise=params.colour_noise_grey,
    )
