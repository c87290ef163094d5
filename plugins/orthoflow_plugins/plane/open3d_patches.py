"""`plane.open3d-patches`: open3d's detect_planar_patches, as a comparator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.geometry import Plane
from orthoflow.sdk import Method, StepContext
from orthoflow_plugins.plane.open3d_ransac import PART_SHARE, open3d_version
from orthoflow_plugins.plane.parameters import (
    DETECTOR_METRICS,
    DetectorIn,
    DetectorOut,
    DetectorParams,
)

if TYPE_CHECKING:
    from orthoflow_plugins.plane.candidates import Candidate, Rules
    from orthoflow_plugins.plane.sample import PreparedCloud, Unassigned


class Open3dPatches(Method):
    """Find planes with open3d's `detect_planar_patches`, which grows patches by robust statistics.

    For comparison: it looks at the same sample of the cloud as the other detectors, with normals of
    nearest neighbours there. `refit: false` shows what it finds by itself: the middle of the box
    about a patch, which mouldings pull off the wall.
    """

    id = "plane.open3d-patches"
    result_version = 6
    determinism = "loose"
    metrics = DETECTOR_METRICS
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

    In = DetectorIn
    Out = DetectorOut

    def run(self, inputs: DetectorIn, params: Params, ctx: StepContext) -> DetectorOut:
        """Detect the planes of a cloud."""
        from orthoflow_plugins.plane.detecting import Detector, detect
        from orthoflow_plugins.plane.open3d_library import load_open3d

        open3d = load_open3d(self.id)

        def proposer_of(_: PreparedCloud, unassigned: Unassigned, rules: Rules) -> PatchProposer:
            least_points = PART_SHARE * rules.least_share * len(unassigned.claims)
            points_m = unassigned.sample.offsets_m
            return patches(open3d, points_m, params, least_points=max(10, int(least_points)))

        detector = Detector(method=self.id, proposer_of=proposer_of)
        detection = detect(inputs.cloud, params, ctx, detector)
        return DetectorOut(planes=detection.planes, labels=detection.labels)

    @classmethod
    def tools(cls) -> Mapping[str, str]:
        """Version of open3d, which decides about results."""
        return open3d_version()


@dataclass(kw_only=True)
class PatchProposer:
    """Proposes the patches of `detect_planar_patches`, largest first."""

    candidates: list[Candidate]

    def propose(self, unassigned: Unassigned) -> Candidate | None:
        """Name the next patch."""
        del unassigned
        return self.candidates.pop(0) if self.candidates else None

    def reject(self, candidate: Candidate) -> None:
        """Patches are named once in any case."""


# Any: the library has no types.
def patches(
    open3d: Any, points_m: NDArray[np.float64], params: Open3dPatches.Params, *, least_points: int
) -> PatchProposer:
    """Find all patches at once; a patch counts the points in its box.

    Raises:
        MethodError: open3d gave up.
    """
    from orthoflow_plugins.plane.candidates import Candidate

    cloud = open3d.geometry.PointCloud()
    cloud.points = open3d.utility.Vector3dVector(points_m)
    neighbours = open3d.geometry.KDTreeSearchParamKNN(knn=params.n_neighbours)
    try:
        cloud.estimate_normals(neighbours)
        boxes = cloud.detect_planar_patches(
            normal_variance_threshold_deg=params.normal_variance_deg,
            coplanarity_deg=params.coplanarity_deg,
            outlier_ratio=params.outlier_share,
            min_num_points=least_points,
            search_param=neighbours,
        )
    except RuntimeError as error:
        raise MethodError(
            f"open3d's detect_planar_patches gave up on the {len(points_m)} points "
            f"({str(error).splitlines()[0]}): try another n_neighbours or thinning"
        ) from error
    candidates = []
    for box in boxes:
        normal = np.asarray(box.R, dtype=np.float64)[:, 2]
        centre_m = np.asarray(box.center, dtype=np.float64)
        inside = len(box.get_point_indices_within_bounding_box(cloud.points))
        candidates.append(
            Candidate(
                plane=Plane(normal=normal, offset_m=float(normal @ centre_m)),
                family=params.family,
                votes=float(inside),
            )
        )
    candidates.sort(key=lambda candidate: -candidate.votes)
    return PatchProposer(candidates=candidates)
