"""What every inspection says of an orthoimage, whatever it is compared with."""

from __future__ import annotations

from typing import Final

import numpy as np

from orthoflow.products import Cameras, Finding, Orthoimage, OrthoMask, Wall
from orthoflow_plugins.inspect.matching import GreyImage
from orthoflow_plugins.inspect.sampling import shown
from orthoflow_plugins.inspect.sharpness import sharpness_findings
from orthoflow_plugins.inspect.stretches import stretch_findings

# Rec. 601 luma on the values as they are.
LUMINANCE: Final = np.array([0.299, 0.587, 0.114])


def grey_of(image: Orthoimage) -> GreyImage:
    """The grey of what an orthoimage shows, 0 elsewhere."""
    shows = shown(image)
    grey = np.where(shows, image.rgb @ LUMINANCE, 0.0)
    return GreyImage(grey=grey, valid=shows, region=shows)


def completeness(image: Orthoimage, wall: Wall) -> Finding:
    """How much of the scanned surface the image shows; both lie on the same cells."""
    surface = np.isfinite(wall.depth_m)
    both = np.count_nonzero(surface & shown(image))
    share = both / max(1, int(np.count_nonzero(surface)))
    return Finding(name="completeness", value=share, unit="1", wall=image.wall)


def quality_findings(
    image: Orthoimage, wall: Wall, grey: GreyImage, cameras: Cameras | None
) -> list[Finding]:
    """Sharpness, and the shares of what is shown that is filled, stretched or smeared.

    Args:
        image: the orthoimage.
        wall: the wall it is of, on the same cells.
        grey: of the image, as `grey_of` gives it.
        cameras: of its photos; without them nothing is said of stretches.
    """
    n_filled = int(np.count_nonzero(image.mask == OrthoMask.FILLED))
    share = n_filled / max(1, int(np.count_nonzero(grey.valid)))
    return [
        Finding(name="filled_share", value=share, unit="1", wall=image.wall),
        *sharpness_findings(grey, image.wall),
        *stretch_findings(image, wall, cameras),
    ]
