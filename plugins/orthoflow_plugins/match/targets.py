"""Walls as photos are traced on them: what is compared, computed once and shared."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from threading import Lock
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import Wall
from orthoflow_plugins.match.channels import Channels, gradient_channels, grey_channels
from orthoflow_plugins.match.places import texture

CHANNELS: Final[Mapping[str, Callable[[NDArray[np.float32]], Channels]]] = {
    "gradients": gradient_channels,
    "grey": grey_channels,
}


@dataclass(frozen=True, kw_only=True)
class WallTarget:
    """A wall ready to be matched.

    Attributes:
        wall: the wall.
        grey: its intensity, NaN where it has no depth; None where it shows nothing.
        channels: of its intensity, by content, as far as they were needed.
        textures: of these channels, likewise.
    """

    wall: Wall
    grey: NDArray[np.float32] | None
    channels: dict[str, Channels] = field(default_factory=dict)
    textures: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    lock: Lock = field(default_factory=Lock)

    def prepare(self, content: str, half_patch_cells: int) -> None:
        """Compute channels and texture unless that was done before, maybe by another thread."""
        with self.lock:
            if self.grey is None or content in self.channels:
                return
            channels = CHANNELS[content](self.grey)
            self.textures[content] = texture(channels, half_patch_cells=half_patch_cells)
            self.channels[content] = channels


def target_of(wall: Wall) -> WallTarget:
    """Prepare a wall for matching."""
    if wall.intensity is None:
        return WallTarget(wall=wall, grey=None)
    grey = np.where(np.isfinite(wall.depth_m), wall.intensity, np.nan).astype(np.float32)
    return WallTarget(wall=wall, grey=grey)
