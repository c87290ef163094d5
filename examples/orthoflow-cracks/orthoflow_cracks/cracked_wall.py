"""`simulate.cracked-wall`: an orthoimage with exactly known cracks."""

from __future__ import annotations

import numpy as np
from orthoflow.geometry import WallFrame
from orthoflow.products import Orthoimage, Orthoimages, OrthoMask
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from pydantic import Field

from orthoflow_cracks.cracks import Cracks

_SIZE_M = (2.0, 1.2)
_GSD_M = 0.004
# End points of the cracks, in metres across and down.
_ENDS_M = (((0.2, 0.15), (0.9, 0.95)), ((1.1, 0.9), (1.8, 0.3)), ((1.3, 0.1), (1.9, 0.12)))


class CrackedWall(Method):
    """Simulate a grey wall with three straight cracks; `cracks` is the truth."""

    id = "simulate.cracked-wall"
    result_version = 1
    determinism = "seeded"

    class Params(MethodParams):
        """Width of the cracks, and roughness of the wall."""

        width_m: float = Field(0.008, gt=0, description="Width of the cracks.")
        noise_grey: float = Field(4.0, ge=0, description="Standard deviation of the colours.")

    class In(Ports):
        """No inputs."""

    class Out(Ports):
        """The orthoimage and its cracks."""

        orthoimages: Orthoimages
        cracks: Cracks

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Draw the wall."""
        ctx.progress(0.0)
        width, height = (round(size / _GSD_M) for size in _SIZE_M)
        frame = WallFrame(
            origin_world=np.array([0.0, 0.0, _SIZE_M[1]]),
            u_world=np.array([1.0, 0.0, 0.0]),
            v_world=np.array([0.0, 0.0, -1.0]),
            normal_world=np.array([0.0, -1.0, 0.0]),
            gsd_m=_GSD_M,
            width=width,
            height=height,
        )
        across, down = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        places = np.stack([across, down], axis=-1) * _GSD_M
        nearest = np.min([distance_to(places, *map(np.array, ends)) for ends in _ENDS_M], axis=0)
        grey = np.where(nearest < params.width_m / 2, 70.0, 180.0)
        grey = grey + params.noise_grey * ctx.rng.normal(size=grey.shape)
        rgb = np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., np.newaxis], 3, axis=2)
        image = Orthoimage(
            frame=frame,
            wall=0,
            name="wall 0",
            rgb=rgb,
            mask=np.full(grey.shape, OrthoMask.PAINTED, dtype=np.uint8),
            source=np.zeros(grey.shape, dtype=np.int16),
            sources=("simulation",),
        )
        ends = np.array(_ENDS_M).reshape(-1, 2)
        cracks = Cracks(
            vertices_world=frame.world_from_wall(ends / _GSD_M),
            line=np.repeat(np.arange(len(_ENDS_M)), 2).astype(np.int32),
            wall=np.zeros(len(_ENDS_M), dtype=np.int32),
            width_m=np.full(len(_ENDS_M), params.width_m),
        )
        return self.Out(orthoimages=Orthoimages(images=(image,)), cracks=cracks)


def distance_to(places, start, end):
    """Return the distance of positions (rows, cols, 2) from the line between two points."""
    direction = end - start
    share = np.clip((places - start) @ direction / (direction @ direction), 0.0, 1.0)
    return np.linalg.norm(places - start - share[..., np.newaxis] * direction, axis=-1)
