"""`inspect.truth` as its tests call it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from orthoflow_plugins.inspect.truth import InspectTruth

from orthoflow.products import Orthoimage, Orthoimages, Truth, Wall, Walls
from orthoflow.sdk import StepContext

BUFFER_M = 0.15


def inspect(
    folder: Path,
    truth: Truth,
    image: Orthoimage,
    wall: Wall,
    params: InspectTruth.Params | None = None,
    **more: object,
) -> tuple[dict[str, float], InspectTruth.Out, StepContext]:
    context = StepContext(rng=np.random.default_rng(0), cores=2, scratch=folder)
    inputs = InspectTruth.In(
        orthoimages=Orthoimages(images=(image,)),
        walls=Walls(
            walls=(wall,),
            up=truth.planes.up,
            intensity_source="laser",
            buffer_front_m=BUFFER_M,
            buffer_behind_m=BUFFER_M,
        ),
        truth=truth,
        **more,  # type: ignore[arg-type] # planes and labels of the tests below
    )
    out = InspectTruth().run(inputs, params or InspectTruth.Params(), context)
    return {metric.name: metric.value for metric in context.metrics}, out, context
