"""`surface.cone`: spires, tapering towers and funnels."""

from __future__ import annotations

from orthoflow_plugins.surface.detector import Detector
from orthoflow_plugins.surface.parameters import DetectorParams


class SurfaceCone(Detector):
    """Find cones with half angles of 1 to about 35 degrees and arcs of at least 40 degrees.

    The search is that of `surface.cylinder`, whose hypotheses are cylinders that touch the cone;
    in the fits, the radius changes along the axis. Surfaces with smaller half angles are cylinders.
    """

    id = "surface.cone"
    form = "cone"

    class Params(DetectorParams):
        """Parameters of the search; the defaults suit scans of buildings."""
