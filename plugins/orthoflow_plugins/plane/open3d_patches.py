"""`plane.open3d-patches`: open3d's detect_planar_patches, as a comparator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from pydantic import Field

from orthoflow.products import Planes, PointCloud, PointLabels
from orthoflow.sdk import Method, Ports, StepContext
from orthoflow_plugins.plane.open3d_ransac import open3d_version
from orthoflow_plugins.plane.parameters import DetectorParams

if TYPE_CHECKING:
    from orthoflow_plugins.plane.candidates import FoundPlane, Rules
    from orthoflow_plugins.plane.detecting import Report
    from orthoflow_plugins.plane.remainders import Remainder


class Open3dPatches(Method):
    """Find planes with open3d's `detect_planar_patches`, which grows patches by robust statistics.

    For comparison: it needs the normals of nearest neighbours and half a kilobyte for each point
    (`thinning` helps). `refit: false` shows what it finds by itself: the middle of the box about a
    patch, which mouldings pull off the wall.
    """

    id = "plane.open3d-patches"
    result_version = 3
    determinism = "loose"
    citations = (
        "Zhou, Park, Koltun 2018: Open3D, a modern library for 3D data, arXiv:1801.09847",
        (
            "Araujo, Oliveira 2020: A robust statistics approach for plane detection in "
            "unorganized point clouds, doi:10.1016/j.patcog.2019.107115"
        ),
    )

    class Params(DetectorParams):
        """What may be set; the last three bear the meaning that open3d gives them."""

        n_neighbours: int = Field(
            30, ge=3, le=1000, description="Points of a neighbourhood, for normals and growing."
        )
        normal_variance_deg: float = Field(
            60.0, gt=0.0, lt=90.0, description="Largest spread of the normals in a patch."
        )
        coplanarity_deg: float = Field(
            75.0, gt=0.0, lt=90.0, description="How flat a patch must be; 90 is perfectly flat."
        )
        outlier_share: float = Field(
            0.75, gt=0.0, lt=1.0, description="Share of points off the plane that a patch may have."
        )

    class In(Ports):
        """What it works on."""

        cloud: PointCloud

    class Out(Ports):
        """What it finds."""

        planes: Planes
        labels: PointLabels

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Detect the planes of a cloud."""
        from orthoflow.files.open3d_guard import load_open3d
        from orthoflow_plugins.plane.detecting import detect
        from orthoflow_plugins.plane.open3d_proposers import PatchSearch, patches
        from orthoflow_plugins.plane.peeling import find_planes

        open3d = load_open3d(self.id)

        def find(remainder: Remainder, rules: Rules, report: Report) -> list[FoundPlane]:
            search = PatchSearch(
                n_neighbours=params.n_neighbours,
                normal_variance_deg=params.normal_variance_deg,
                coplanarity_deg=params.coplanarity_deg,
                outlier_share=params.outlier_share,
                least_points=max(10, int(0.2 * rules.least_share * len(remainder.claims))),
            )
            proposer = patches(open3d, remainder, search, params.family)
            return find_planes(remainder, proposer, rules, report)

        detection = detect(inputs.cloud, params, ctx, find, method=self.id)
        return self.Out(planes=detection.planes, labels=detection.labels)

    @classmethod
    def tools(cls) -> Mapping[str, str]:
        """Version of open3d, which decides about results."""
        return open3d_version()
