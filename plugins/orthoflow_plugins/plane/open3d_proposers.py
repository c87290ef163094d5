"""What open3d finds, proposed plane by plane, so that it goes the way of every detector."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry import Plane
from orthoflow_plugins.plane.candidates import Candidate, Family
from orthoflow_plugins.plane.remainders import Remainder

_PART_SHARE: Final = 0.2


def _points_m(remainder: Remainder, free: NDArray[np.bool_]) -> NDArray[np.float64]:
    points = remainder.points
    return np.column_stack([points.x[free], points.y[free], points.z[free]]).astype(np.float64)


@dataclass(kw_only=True)
class SegmentProposer:
    """Proposes the plane of `segment_plane` among the points that remain, again and again.

    Attributes:
        open3d: the library.
        family: which planes are looked for; open3d cannot be told, so others are passed over.
        tolerance_m: distance of an inlier.
        n_iterations: hypotheses.
        least_points: a plane needs.
    """

    # Any: the library has no types.
    open3d: Any
    family: Family
    tolerance_m: float
    n_iterations: int
    least_points: float
    _passed_over: NDArray[np.bool_] | None = None
    _last: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def propose(self, remainder: Remainder) -> Candidate | None:
        """Name the plane with most inliers, or None when it has too few."""
        if self._passed_over is None:
            self._passed_over = np.zeros(len(remainder.claims), dtype=bool)
        free = np.flatnonzero((remainder.claims < 0) & ~self._passed_over)
        if len(free) < max(3.0, self.least_points):
            return None
        cloud = self.open3d.geometry.PointCloud()
        chosen = np.zeros(len(remainder.claims), dtype=bool)
        chosen[free] = True
        cloud.points = self.open3d.utility.Vector3dVector(_points_m(remainder, chosen))
        model, inliers = cloud.segment_plane(self.tolerance_m, 3, self.n_iterations)
        normal = np.array(model[:3], dtype=np.float64)
        length = float(np.linalg.norm(normal))
        if len(inliers) < _PART_SHARE * self.least_points or not length > 0.0:
            return None
        self._last = free[np.asarray(inliers, dtype=np.int64)]
        return Candidate(
            plane=Plane(normal=normal / length, offset_m=-float(model[3]) / length),
            family=self.family,
            support=float(len(inliers)),
        )

    def reject(self, candidate: Candidate) -> None:
        """Leave the inliers of what was no plane out of the next search."""
        del candidate
        if self._passed_over is not None:
            self._passed_over[self._last] = True


@dataclass(kw_only=True)
class PatchProposer:
    """Proposes the patches of `detect_planar_patches`, largest first."""

    candidates: list[Candidate]

    def propose(self, remainder: Remainder) -> Candidate | None:
        """Name the next patch."""
        del remainder
        return self.candidates.pop(0) if self.candidates else None

    def reject(self, candidate: Candidate) -> None:
        """Patches are named once in any case."""


@dataclass(frozen=True, kw_only=True)
class PatchSearch:
    """What `detect_planar_patches` is asked for, by its own names."""

    n_neighbours: int
    normal_variance_deg: float
    coplanarity_deg: float
    outlier_share: float
    least_points: int


# Any: the library has no types.
def patches(
    open3d: Any, remainder: Remainder, search: PatchSearch, family: Family
) -> PatchProposer:
    """Find all patches at once; a patch counts the points in its box.

    Raises:
        MethodError: open3d gave up.
    """
    points_m = _points_m(remainder, np.ones(len(remainder.claims), dtype=bool))
    cloud = open3d.geometry.PointCloud()
    cloud.points = open3d.utility.Vector3dVector(points_m)
    neighbours = open3d.geometry.KDTreeSearchParamKNN(knn=search.n_neighbours)
    try:
        cloud.estimate_normals(neighbours)
        boxes = cloud.detect_planar_patches(
            normal_variance_threshold_deg=search.normal_variance_deg,
            coplanarity_deg=search.coplanarity_deg,
            outlier_ratio=search.outlier_share,
            min_num_points=search.least_points,
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
                family=family,
                support=float(inside),
            )
        )
    candidates.sort(key=lambda candidate: -candidate.support)
    return PatchProposer(candidates=candidates)
