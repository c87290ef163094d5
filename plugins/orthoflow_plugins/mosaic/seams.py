"""`mosaic.seams`: join the layers of each wall into one orthoimage."""

from __future__ import annotations

from itertools import groupby
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry import WallFrame
from orthoflow.products import Layer, LayerMask, Layers, Orthoimage, Orthoimages, OrthoMask
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from orthoflow.sdk.methods import Determinism


class MosaicSeams(Method):
    """Take each cell from the layer that shows it best.

    A single layer passes through. Of several the one with the best quality paints a cell, the
    first among equals; a cell that one layer measured is never taken from another's filling.
    """

    id: ClassVar[str] = "mosaic.seams"
    result_version: ClassVar[int] = 1
    determinism: ClassVar[Determinism] = "exact"

    class Params(MethodParams):
        """There is nothing to choose."""

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
        for wall, group in groupby(layers, key=lambda layer: layer.wall):
            ctx.progress(len(images) / (layers[-1].wall + 1), _name(inputs.layers, wall))
            images.append(_joined(tuple(group), _name(inputs.layers, wall)))
        _report(ctx, images)
        return self.Out(orthoimages=Orthoimages(images=tuple(images)))


def _name(layers: Layers, wall: int) -> str:
    return layers.names[wall] if wall < len(layers.names) else f"wall {wall}"


def _joined(layers: tuple[Layer, ...], name: str) -> Orthoimage:
    """Join the layers of one wall.

    Raises:
        MethodError: the layers do not share one frame.
    """
    first = layers[0]
    for layer in layers[1:]:
        if not _is_same_frame(layer.frame, first.frame):
            raise MethodError(
                f"the layers {first.source} and {layer.source} of {name} lie on different rasters: "
                "all layers of a wall must come from the same walls"
            )
    best = np.zeros(first.frame.shape, dtype=np.float32)
    rank = np.zeros(first.frame.shape, dtype=np.uint8)
    source = np.full(first.frame.shape, -1, dtype=np.int16)
    rgb = np.zeros((*first.frame.shape, 3), dtype=np.uint8)
    for index, layer in enumerate(layers):
        states = _ranks(layer)
        is_painted = layer.mask == LayerMask.PAINTED
        wins = (states > rank) | (is_painted & (states == rank) & (layer.quality > best))
        rank[wins] = states[wins]
        best[wins] = layer.quality[wins]
        shown = wins & is_painted
        rgb[shown] = layer.rgb[shown]
        source[shown] = index
    return Orthoimage(
        frame=first.frame,
        wall=first.wall,
        name=name,
        rgb=rgb,
        mask=_MASK_OF_RANK[rank],
        source=source,
        sources=tuple(layer.source for layer in layers),
    )


# A cell takes the highest of these that a layer gives it. Occluded: no source paints it, although
# at least one looks at it. A filled cell counts less than a painted one.
_RANKED = (
    OrthoMask.NONE,
    OrthoMask.NO_SURFACE,
    OrthoMask.OCCLUDED,
    OrthoMask.FILLED,
    OrthoMask.PAINTED,
)
_MASK_OF_RANK = np.array(_RANKED, dtype=np.uint8)
_RANK_OF_LAYER_MASK = np.array(
    [_RANKED.index(OrthoMask[name]) for name in ("NONE", "PAINTED", "OCCLUDED", "NO_SURFACE")],
    dtype=np.uint8,
)


def _ranks(layer: Layer) -> NDArray[np.uint8]:
    ranks = _RANK_OF_LAYER_MASK[layer.mask]
    if layer.filled is not None:
        is_filled = (layer.filled > 0) & (layer.mask == LayerMask.PAINTED)
        ranks[is_filled] = _RANKED.index(OrthoMask.FILLED)
    return ranks


def _is_same_frame(frame: WallFrame, other: WallFrame) -> bool:
    return (
        frame.shape == other.shape
        and frame.gsd_m == other.gsd_m
        and np.array_equal(frame.origin_world, other.origin_world)
        and np.array_equal(frame.u_world, other.u_world)
        and np.array_equal(frame.v_world, other.v_world)
    )


def _report(ctx: StepContext, images: list[Orthoimage]) -> None:
    n_cells = sum(image.mask.size for image in images)
    ctx.metric("n_orthoimages", len(images), "1")
    for state in OrthoMask:
        share = sum(np.count_nonzero(image.mask == state) for image in images) / n_cells
        ctx.metric(f"{state.name.lower()}_share", share, "1")
