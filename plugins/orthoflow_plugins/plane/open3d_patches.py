"""`plane.open3d-patches`: open3d's detect_planar_patches, as a comparator."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.geometry import Plane
from orthoflow.sdk import Method, StepContext
from orthoflow_plugins.plane.detector import (
    DETECTOR_METRICS,
    Candidate,
    DetectorIn,
    DetectorOut,
    DetectorParams,
)
from orthoflow_plugins.plane.open3d_ransac import PART_SHARE, open3d_version

if TYPE_CHECKING:
    from orthoflow_plugins.plane.cloud import Search


class Open3dPatches(Method):
    """Find planes with open3d's `detect_planar_patches`, which grows patches by robust statistics.

    For comparison: it looks at the same sample of the cloud as the other detectors, with normals of
    nearest neighbours there. `refit: false` shows what it finds by itself: the middle of the box
    about a patch, which mouldings pull off the wall.
    """

    id = "plane.open3d-patches"
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
        from orthoflow_plugins.plane.open3d_library import load_open3d
        from orthoflow_plugins.plane.search import detect

        proposer_of = partial(PatchProposer, params=params, open3d=load_open3d(self.id))
        return detect(inputs.cloud, params, ctx, proposer_of, method=self.id).out

    @classmethod
    def tools(cls) -> Mapping[str, str]:
        """Version of open3d, which decides about results."""
        return open3d_version()


class PatchProposer:
    """Proposes the patches of `detect_planar_patches`, that with most points in its box first."""

    # Any: the library has no types.
    def __init__(self, search: Search, params: Open3dPatches.Params, open3d: Any) -> None:
        """Find all patches at once.

        Raises:
            MethodError: open3d gave up.
        """
        points_m = search.cloud.sample.offsets_m
        cloud = open3d.geometry.PointCloud()
        cloud.points = open3d.utility.Vector3dVector(points_m)
        neighbours = open3d.geometry.KDTreeSearchParamKNN(knn=params.n_neighbours)
        try:
            cloud.estimate_normals(neighbours)
            boxes = cloud.detect_planar_patches(
                normal_variance_threshold_deg=params.normal_variance_deg,
                coplanarity_deg=params.coplanarity_deg,
                outlier_ratio=params.outlier_share,
                min_num_points=max(10, int(PART_SHARE * search.least_points)),
                search_param=neighbours,
            )
        except RuntimeError as error:
            raise MethodError(
                f"open3d's detect_planar_patches gave up on the {len(points_m)} points "
                f"({str(error).splitlines()[0]}): try another n_neighbours or thinning"
            ) from error
        self._candidates = []
        for box in boxes:
            normal = np.asarray(box.R, dtype=np.float64)[:, 2]
            offset_m = float(normal @ np.asarray(box.center, dtype=np.float64))
            inside = len(box.get_point_indices_within_bounding_box(cloud.points))
            self._candidates.append(
                Candidate(
                    plane=Plane(normal=normal, offset_m=offset_m),
                    constraint=params.constraint,
                    votes=float(inside),
                )
            )
        self._candidates.sort(key=lambda candidate: -candidate.votes)

    def propose(self, search: Search) -> Candidate | None:
        """Name the next patch."""
        del search
        return self._candidates.pop(0) if self._candidates else None

    def reject(self, candidate: Candidate) -> None:
        """Do nothing: patches are named once in any case."""
