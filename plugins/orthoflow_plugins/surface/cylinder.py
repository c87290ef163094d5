"""`surface.cylinder`: vaults, apses, towers and columns."""

from __future__ import annotations

from orthoflow_plugins.surface.detector import Detector
from orthoflow_plugins.surface.parameters import DetectorParams


class SurfaceCylinder(Detector):
    """Find cylinders with axes in any direction and arcs of at least 40 degrees.

    A sample of the points is sorted into voxels of several sizes, each with a normal from the
    points around it. Pairs of neighbouring voxels whose normals are not parallel give an axis, a
    centre and a radius; the cylinder with which most pairs agree is fitted to the voxels and
    tested. Coarse voxels find large radii, fine ones columns. All surfaces are then fitted to all
    points by the means of small cells, with Tukey's weights, so mouldings and furniture have no
    weight. The covariance follows from the scatter of tiles of cells, as neighbouring points share
    errors.

    A cylinder is rejected if its arc or area is small, if its normals do not turn with the angle
    (flat facets, corners of a room), if its scatter is large relative to its radius, or if it is
    also curved along its axis (domes). The report states the numbers.

    With labels of planes, points of flat planes are left out. Planes that are strips of a curved
    surface, because their sagitta exceeds their noise, are searched.
    """

    id = "surface.cylinder"
    is_cone = False
    citations = (
        "Rabbani and van den Heuvel 2005, cylinders by Hough transform (ISPRS Laser Scanning 2005)",
        "Schnabel, Wahl, Klein 2007, doi:10.1111/j.1467-8659.2007.01016.x",
    )

    class Params(DetectorParams):
        """Parameters of the search; the defaults suit scans of buildings."""
