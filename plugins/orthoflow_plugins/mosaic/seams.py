"""`mosaic.seams`: join the layers of each wall into one orthoimage."""

from __future__ import annotations

from itertools import groupby
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.products import Layer, Layers, Orthoimage, Orthoimages, OrthoMask
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.mosaic.joining import joined
from orthoflow_plugins.mosaic.overlaps import displacements_cells
from orthoflow_plugins.mosaic.source_maps import caption, is_seam, source_map


class MosaicSeams(Method):
    """Take each cell from the layer that shows it best, its colour untouched.

    A single layer passes through. Of several the one with the best quality paints a cell, the
    first among equals; a cell that one layer measured is never taken from another's filling. Small
    patches from one source are given to the source around them where that one sees them too.
    """

    id: ClassVar[str] = "mosaic.seams"
    result_version: ClassVar[int] = 2
    determinism: ClassVar[Determinism] = "exact"
    citations: ClassVar[tuple[str, ...]] = (
        "markiewicz2015: orthoimages of cultural heritage objects from TLS and images, 4.4",
    )

    class Params(MethodParams):
        """How the choice between layers is kept calm."""

        island_cells_min: int = Field(
            default=100,
            ge=1,
            description="Smaller patches from one source are painted from the one around them, "
            "where it sees them too; 1 keeps every cell's best view.",
        )

    class In(Ports):
        """Layers of all walls."""

        layers: Layers

    class Out(Ports):
        """One orthoimage per wall."""

        orthoimages: Orthoimages

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Join wall by wall."""
        layers = sorted(inputs.layers.layers, key=lambda layer: layer.wall)
        if not layers:
            raise MethodError("there is no layer to make an orthoimage of, at least one is needed")
        images: list[Orthoimage] = []
        shifts: list[NDArray[np.float64]] = []
        for wall, members in groupby(layers, key=lambda layer: layer.wall):
            group: tuple[Layer, ...] = tuple(members)
            name = _name(inputs.layers, wall)
            ctx.progress(wall / (layers[-1].wall + 1), name)
            images.append(joined(group, name, island_cells_min=params.island_cells_min))
            shifts.append(displacements_cells(group))
            _show(ctx, images[-1])
        _report(ctx, images, np.concatenate(shifts))
        return self.Out(orthoimages=Orthoimages(images=tuple(images)))


def _name(layers: Layers, wall: int) -> str:
    return layers.names[wall] if wall < len(layers.names) else f"wall {wall}"


def _show(ctx: StepContext, image: Orthoimage) -> None:
    if not image.sources:
        ctx.warn(f"the orthoimage of {image.name} is empty: no source shows any of it")
    if len(image.sources) > 1:
        ctx.figure(f"wall_{image.wall}_sources", source_map(image), caption(image))


def _report(ctx: StepContext, images: list[Orthoimage], shifts_cells: NDArray[np.float64]) -> None:
    n_cells = sum(image.mask.size for image in images)
    ctx.metric("n_orthoimages", len(images), "1")
    for state in OrthoMask:
        share = sum(np.count_nonzero(image.mask == state) for image in images) / n_cells
        ctx.metric(f"{state.name.lower()}_share", share, "1")
    ctx.metric("n_sources", len({name for image in images for name in image.sources}), "1")
    n_shown = sum(np.count_nonzero(image.source >= 0) for image in images)
    n_seam = sum(np.count_nonzero(is_seam(image.source)) for image in images)
    ctx.metric("seam_share", n_seam / max(1, n_shown), "1")
    ctx.metric("n_overlap_patches", len(shifts_cells), "1")
    if len(shifts_cells):
        rms = np.sqrt(np.mean(shifts_cells**2, axis=0))
        ctx.metric("overlap_u_rms_cells", rms[0], "cells")
        ctx.metric("overlap_v_rms_cells", rms[1], "cells")
