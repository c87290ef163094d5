"""`surface.cylinder`: vaults, apses, towers and columns."""

from __future__ import annotations

from orthoflow_plugins.surface.detector import Detector
from orthoflow_plugins.surface.parameters import DetectorParams


class SurfaceCylinder(Detector):
    """Find cylinders with axes in any direction and arcs of at least 40 degrees.

    A sample of the points is sorted into voxels of several sizes, and a normal is computed for each
    voxel from the points around it. Each pair of neighbouring voxels whose normals are not parallel
    defines an axis, a centre and a radius. The cylinder with which most pairs agree is fitted to
    the voxels and tested. Coarse voxels are used to find large radii, and fine voxels to find
    columns. All surfaces are then fitted to the means of all points in small cells, with Tukey's
    weights, so mouldings and furniture do not affect the fit. Neighbouring points have common
    errors, so the covariance is computed from the scatter between tiles of cells.

    A cylinder is rejected if its arc or area is too small, if its normals do not rotate with the
    angle (as on flat facets and in corners of a room), if its scatter is large relative to its
    radius, or if it is also curved along its axis (as a dome is). Diagnostics state these values.

    If labels of planes are given, the points of planes are excluded, except those of planes that
    are strips of a curved surface, i.e. whose sagitta exceeds their noise.
    """

    id = "surface.cylinder"
    form = "cylinder"
    citations = (
        "Rabbani and van den Heuvel 2005, cylinders by Hough transform (ISPRS Laser Scanning 2005)",
        "Schnabel, Wahl, Klein 2007, doi:10.1111/j.1467-8659.2007.01016.x",
    )

    class Params(DetectorParams):
        """Parameters of the search; the defaults suit scans of buildings."""
