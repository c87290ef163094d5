"""One survey and some painters."""

from __future__ import annotations

import time

import numpy as np
from pydantic import Field

from orthoflow.errors import InputError, MethodError
from orthoflow.geometry.frames import WallFrame
from orthoflow.products import InputFiles, Orthoimage, Orthoimages, OrthoMask, Planes
from orthoflow.sdk import Method, MethodParams, Ports, StepContext


class SurveyOffset(Method):
    """One plane that faces -y, at the distance that a file or a parameter says."""

    id = "survey.offset"
    citations = ("https://doi.org/10.1000/workshop",)

    class Params(MethodParams):
        offset_m: float = Field(2.0, ge=-10, le=10, description="Distance of the plane.")

    class In(Ports):
        files: InputFiles | None = None

    class Out(Ports):
        planes: Planes

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        offset_m = params.offset_m
        if inputs.files is not None:
            path = inputs.files.paths[0]
            text = path.read_text(encoding="utf-8").strip()
            if not text:
                raise InputError(f"{path.name} is empty, expected one number")
            offset_m = float(text)
        if offset_m < 0:
            ctx.warn("the plane lies behind the viewer")
        ctx.metric("offset_m", offset_m, "m")
        corners = [[0, 1, 1], [0, 1, 0], [1, 1, 0], [1, 1, 1]] * np.array([1, offset_m, 1])
        planes = Planes(
            normal=np.array([[0.0, -1.0, 0.0]]),
            offset=np.array([-offset_m]),
            corners=corners[None],
            covariance=np.zeros((1, 4, 4)),
            n_points=np.array([4]),
            rms_m=np.zeros(1),
            up=np.array([0.0, 0.0, 1.0]),
            names=("wall 0",),
        )
        return self.Out(planes=planes)


class PaintPlain(Method):
    """One colour all over."""

    id = "paint.plain"

    class Params(MethodParams):
        gsd_m: float = Field(0.5, gt=0, description="Side of a cell.")
        grey: int = Field(128, ge=0, le=255, description="Grey level.")

    class In(Ports):
        planes: Planes

    class Out(Ports):
        orthoimages: Orthoimages

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        n_cells = round(1 / params.gsd_m)
        frame = WallFrame(
            origin_world=inputs.planes.corners[0, 0],
            u_world=np.array([1.0, 0.0, 0.0]),
            v_world=np.array([0.0, 0.0, -1.0]),
            normal_world=np.array([0.0, -1.0, 0.0]),
            gsd_m=params.gsd_m,
            width=n_cells,
            height=n_cells,
        )
        image = Orthoimage(
            frame=frame,
            wall=0,
            name="wall 0",
            rgb=np.full((n_cells, n_cells, 3), params.grey, dtype=np.uint8),
            mask=np.full((n_cells, n_cells), OrthoMask.PAINTED, dtype=np.uint8),
            source=np.zeros((n_cells, n_cells), dtype=np.int16),
            sources=("paint",),
        )
        ctx.metric("painted_share", 1.0, "1")
        return self.Out(orthoimages=Orthoimages(images=(image,)))


class PaintFail(PaintPlain):
    """Never finds a result."""

    id = "paint.fail"

    def run(self, inputs: PaintPlain.In, params: PaintPlain.Params, ctx: StepContext) -> object:
        raise MethodError("no colour sticks to this plane")


class PaintKernel(PaintPlain):
    """Runs a kernel that needs another."""

    id = "paint.kernel"

    def run(self, inputs: PaintPlain.In, params: PaintPlain.Params, ctx: StepContext) -> object:
        from workshop.kernels import doubled_sum

        ctx.metric("doubled_sum", doubled_sum(inputs.planes.offset), "1")
        return super().run(inputs, params, ctx)


class PaintLacking(PaintPlain):
    """Needs a library that nobody has."""

    id = "paint.lacking"

    def run(self, inputs: PaintPlain.In, params: PaintPlain.Params, ctx: StepContext) -> object:
        import no_such_library  # noqa: F401

        return None


class PaintSlow(PaintPlain):
    """Takes a minute, and stops when it is asked to."""

    id = "paint.slow"

    def run(self, inputs: PaintPlain.In, params: PaintPlain.Params, ctx: StepContext) -> object:
        for tick in range(600):
            ctx.progress(tick / 600, "drying")
            time.sleep(0.1)
        return super().run(inputs, params, ctx)
