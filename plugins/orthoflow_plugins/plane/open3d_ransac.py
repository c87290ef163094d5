"""`plane.open3d-ransac`: open3d's segment_plane, plane after plane, as a comparator."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from pydantic import Field

from orthoflow.geometry import Plane
from orthoflow.sdk import Method, StepContext
from orthoflow_plugins.plane.detector import (
    DETECTOR_METRICS,
    Candidate,
    DetectorIn,
    DetectorOut,
    DetectorParams,
)

if TYPE_CHECKING:
    from orthoflow_plugins.plane.cloud import Search

# Points of a candidate, as a share of those that a plane needs.
PART_SHARE: Final = 0.2


def open3d_version() -> Mapping[str, str]:
    """Version of open3d under whichever name it is installed."""
    for name in ("open3d-cpu", "open3d"):
        try:
            return {"open3d": version(name)}
        except PackageNotFoundError:
            continue
    return {"open3d": "none"}


class Open3dRansac(Method):
    """Find planes with open3d's `segment_plane` on the points that remain, plane after plane.

    For comparison: it looks at the same sample of the cloud as the other detectors, takes longer
    than plane.ransac, and does not repeat itself exactly, whatever the seed. `refit: false` shows
    what it finds by itself; with the common refit its planes are as good as those of any other
    detector, where it finds them.
    """

    id = "plane.open3d-ransac"
    determinism = "loose"
    metrics = DETECTOR_METRICS
    citations = (
        "Zhou, Park, Koltun 2018: Open3D, a modern library for 3D data, arXiv:1801.09847",
        "Fischler, Bolles 1981: Random sample consensus, doi:10.1145/358669.358692",
    )

    class Params(DetectorParams):
        """What may be set."""

        n_iterations: int = Field(1000, ge=1, le=1_000_000, description="Hypotheses per plane.")

    In = DetectorIn
    Out = DetectorOut

    def run(self, inputs: DetectorIn, params: Params, ctx: StepContext) -> DetectorOut:
        """Detect the planes of a cloud."""
        from orthoflow_plugins.plane.open3d_library import load_open3d
        from orthoflow_plugins.plane.search import detect

        open3d = load_open3d(self.id)
        open3d.utility.random.seed(int(ctx.rng.integers(2**31)))
        proposer_of = partial(SegmentProposer, params=params, open3d=open3d)
        return detect(inputs.cloud, params, ctx, proposer_of, method=self.id).out

    @classmethod
    def tools(cls) -> Mapping[str, str]:
        """Version of open3d, which decides about results."""
        return open3d_version()


class SegmentProposer:
    """Proposes the plane of `segment_plane` among the points that remain, again and again."""

    # Any: the library has no types.
    def __init__(self, search: Search, params: Open3dRansac.Params, open3d: Any) -> None:
        """Get ready to propose; open3d takes no constraint, so other planes are passed over."""
        self._params, self._open3d = params, open3d
        self._passed_over = np.zeros(len(search.claims), dtype=bool)
        self._last = np.zeros(0, dtype=np.int64)

    def propose(self, search: Search) -> Candidate | None:
        """Name the plane with most inliers, or None when it has too few."""
        free = np.flatnonzero((search.claims < 0) & ~self._passed_over)
        if len(free) < max(3.0, search.least_points):
            return None
        cloud = self._open3d.geometry.PointCloud()
        cloud.points = self._open3d.utility.Vector3dVector(search.cloud.sample.offsets_m[free])
        model, inliers = cloud.segment_plane(search.tolerance_m, 3, self._params.n_iterations)
        normal = np.array(model[:3], dtype=np.float64)
        length = float(np.linalg.norm(normal))
        if len(inliers) < PART_SHARE * search.least_points or not length > 0.0:
            return None
        self._last = free[np.asarray(inliers, dtype=np.int64)]
        return Candidate(
            plane=Plane(normal=normal / length, offset_m=-float(model[3]) / length),
            constraint=self._params.constraint,
            votes=float(len(inliers)),
        )

    def reject(self, candidate: Candidate) -> None:
        """Leave the inliers of what was no plane out of the next search."""
        del candidate
        self._passed_over[self._last] = True
