"""`plane.open3d-ransac`: open3d's segment_plane, plane after plane, as a comparator."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from pydantic import Field

from orthoflow.products import Planes, PointCloud, PointLabels
from orthoflow.sdk import Method, Ports, StepContext
from orthoflow_plugins.plane.parameters import DetectorParams

if TYPE_CHECKING:
    from orthoflow_plugins.plane.candidates import FoundPlane, Rules
    from orthoflow_plugins.plane.detecting import Report
    from orthoflow_plugins.plane.remainders import Remainder


def open3d_version() -> Mapping[str, str]:
    """Version of open3d under whichever name it is installed."""
    for name in ("open3d-cpu", "open3d"):
        try:
            return {"open3d": version(name)}
        except PackageNotFoundError:
            continue
    return {"open3d": "none"}


class Open3dRansac(Method):
    """Find planes with open3d's `segment_plane` on all points that remain, plane after plane.

    For comparison: it takes minutes on a cloud for which plane.ransac takes a second (`thinning`
    helps), and it does not repeat itself exactly, whatever the seed. `refit: false` shows what it
    finds by itself; with the common refit its planes are as good as those of any other detector,
    where it finds them.
    """

    id = "plane.open3d-ransac"
    result_version = 3
    determinism = "loose"
    citations = (
        "Zhou, Park, Koltun 2018: Open3D, a modern library for 3D data, arXiv:1801.09847",
        "Fischler, Bolles 1981: Random sample consensus, doi:10.1145/358669.358692",
    )

    class Params(DetectorParams):
        """What may be set."""

        n_iterations: int = Field(1000, ge=1, le=1_000_000, description="Hypotheses per plane.")

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
        from orthoflow_plugins.plane.open3d_proposers import SegmentProposer
        from orthoflow_plugins.plane.peeling import find_planes

        open3d = load_open3d(self.id)
        open3d.utility.random.seed(int(ctx.rng.integers(2**31)))

        def find(remainder: Remainder, rules: Rules, report: Report) -> list[FoundPlane]:
            proposer = SegmentProposer(
                open3d=open3d,
                family=params.family,
                tolerance_m=rules.find_m,
                n_iterations=params.n_iterations,
                least_points=rules.least_share * len(remainder.claims),
            )
            return find_planes(remainder, proposer, rules, report)

        detection = detect(inputs.cloud, params, ctx, find, method=self.id)
        return self.Out(planes=detection.planes, labels=detection.labels)

    @classmethod
    def tools(cls) -> Mapping[str, str]:
        """Version of open3d, which decides about results."""
        return open3d_version()
