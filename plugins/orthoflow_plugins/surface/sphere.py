"""`surface.sphere`: domes, semi-domes and balls."""

from __future__ import annotations

from orthoflow_plugins.surface.detector import Detector
from orthoflow_plugins.surface.parameters import DetectorParams


class SurfaceSphere(Detector):
    """Find spheres of which a part with an arc of at least 40 degrees was scanned.

    The search is that of `surface.cylinder`, but each pair of voxels defines a centre and a radius.
    A sphere is rejected if the normals do not rotate with the angle in all directions, as on
    cylinders and flat facets.
    """

    id = "surface.sphere"
    form = "sphere"

    class Params(DetectorParams):
        """Parameters of the search; the defaults suit scans of buildings."""
