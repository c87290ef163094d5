"""Plane detectors of open3d, for comparison: `segment_plane` and `detect_planar_patches`."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from orthoflow.errors import MethodError, PluginError
from orthoflow.geometry import Plane
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.detector import Detector
from orthoflow_plugins.plane.proposing import Candidate, DetectorParams, Proposer

if TYPE_CHECKING:
    from orthoflow_plugins.plane.search import Search

# Minimum number of points of a candidate, as a share of the minimum number of points of a plane.
PART_SHARE: Final = 0.2
# Number of neighbours for normals and for region growing.
_NEIGHBOURS: Final = 30
# Number of hypotheses of `segment_plane` per plane.
_HYPOTHESES: Final = 1000


# The type is Any, because open3d has no type annotations.
def load_open3d(purpose: str) -> Any:
    """Import open3d.

    The wheel of open3d needs libusb-1.0.so.0, which may not be installed. The package
    libusb-package contains this library, and open3d finds it after it has been loaded globally.

    Args:
        purpose: feature that needs open3d, for error messages.

    Raises:
        PluginError: open3d is not installed or cannot be loaded.
    """
    try:
        usb = import_module("libusb_package")
        ctypes.CDLL(str(usb.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        # libusb may be installed in the system; otherwise, the import of open3d fails below.
        pass
    try:
        return import_module("open3d")
    except ModuleNotFoundError as error:
        raise PluginError(
            f"{purpose} needs open3d, which is not installed: install it with "
            "`python -m pip install open3d-cpu libusb-package`, or use a method without it"
        ) from error
    except (ImportError, OSError) as error:
        raise PluginError(
            f"{purpose} needs open3d, which does not load ({str(error).splitlines()[0]}): install "
            "the system library that it names (Debian: apt-get install libgl1 libx11-6 "
            "libusb-1.0-0), or use a method without it"
        ) from error


class _Open3dMethod(Detector):
    determinism = "loose"

    @classmethod
    def tools(cls) -> Mapping[str, str]:
        """Return open3d, whose version affects results, under its distribution's name."""
        for name in ("open3d-cpu", "open3d"):
            try:
                return {"open3d": version(name)}
            except PackageNotFoundError:
                continue
        return {"open3d": "none"}


class Open3dRansac(_Open3dMethod):
    """Find planes one by one with open3d's `segment_plane`.

    This method is meant for comparison. It uses the same sample of the cloud as the other
    detectors, takes longer than plane.ransac, and is not exactly reproducible, even with a fixed
    seed. `refit: false` returns the planes as computed by open3d; after the common refit, they are
    as accurate as those of other detectors.
    """

    id = "plane.open3d-ransac"
    citations = (
        "Zhou, Park, Koltun 2018: Open3D, a modern library for 3D data, arXiv:1801.09847",
        "Fischler, Bolles 1981: Random sample consensus, doi:10.1145/358669.358692",
    )

    Params = DetectorParams

    def proposer(self, search: Search, params: DetectorParams, ctx: StepContext) -> Proposer:
        """Load open3d and seed it."""
        open3d = load_open3d(self.id)
        open3d.utility.random.seed(int(ctx.rng.integers(2**31)))
        return SegmentProposer(search, params, open3d)


class SegmentProposer(Proposer):
    """Proposes the planes that `segment_plane` finds in the remaining points."""

    # The type is Any, because open3d has no type annotations.
    def __init__(self, search: Search, params: DetectorParams, open3d: Any) -> None:
        """Store the settings; open3d has no constraints, so the search rejects other planes."""
        self._params, self._open3d = params, open3d
        self._passed_over = np.zeros(len(search.is_free), dtype=bool)
        self._last = np.zeros(0, dtype=np.int64)

    def propose(self, search: Search) -> Candidate | None:
        """Return the plane with the most inliers; None if it has too few."""
        free = np.flatnonzero(search.is_free & ~self._passed_over)
        if len(free) < max(3.0, search.least_points):
            return None
        cloud = self._open3d.geometry.PointCloud()
        cloud.points = self._open3d.utility.Vector3dVector(search.cloud.sample.offsets_m[free])
        model, inliers = cloud.segment_plane(search.cloud.tolerance_m, 3, _HYPOTHESES)
        normal = np.array(model[:3], dtype=np.float64)
        length = float(np.linalg.norm(normal))
        if len(inliers) < PART_SHARE * search.least_points or not length > 0.0:
            return None
        self._last = free[np.asarray(inliers, dtype=np.int64)]
        return Candidate(
            plane=Plane(normal=normal / length, offset_m=-float(model[3]) / length),
            constraint=self._params.constraint,
        )

    def reject(self) -> None:
        """Exclude the inliers of the rejected plane from the next searches."""
        self._passed_over[self._last] = True


class Open3dPatches(_Open3dMethod):
    """Find planes by region growing with open3d's `detect_planar_patches`.

    This method is meant for comparison. It uses the same sample of the cloud as the other
    detectors, and computes normals from nearest neighbours in the sample. `refit: false` returns
    the planes as computed by open3d. These pass through the centre of the box around a patch, so
    mouldings bias them.
    """

    id = "plane.open3d-patches"
    citations = (
        "Zhou, Park, Koltun 2018: Open3D, a modern library for 3D data, arXiv:1801.09847",
        (
            "Araujo, Oliveira 2020: A robust statistics approach for plane detection in "
            "unorganized point clouds, doi:10.1016/j.patcog.2019.107115"
        ),
    )

    Params = DetectorParams

    def proposer(self, search: Search, params: DetectorParams, ctx: StepContext) -> Proposer:
        """Find all patches."""
        return PatchProposer(search, params, load_open3d(self.id))


class PatchProposer(Proposer):
    """Proposes the patches found by `detect_planar_patches`, those with the most points first."""

    # The type is Any, because open3d has no type annotations.
    def __init__(self, search: Search, params: DetectorParams, open3d: Any) -> None:
        """Find all patches at once.

        Raises:
            MethodError: open3d raised an error.
        """
        points_m = search.cloud.sample.offsets_m
        cloud = open3d.geometry.PointCloud()
        cloud.points = open3d.utility.Vector3dVector(points_m)
        neighbours = open3d.geometry.KDTreeSearchParamKNN(knn=_NEIGHBOURS)
        try:
            cloud.estimate_normals(neighbours)
            boxes = cloud.detect_planar_patches(
                min_num_points=max(10, int(PART_SHARE * search.least_points)),
                search_param=neighbours,
            )
        except RuntimeError as error:
            raise MethodError(
                f"open3d's detect_planar_patches failed on the {len(points_m)} points "
                f"({str(error).splitlines()[0]}): try another thinning"
            ) from error
        self._constraint = params.constraint
        self._boxes = sorted(
            boxes, key=lambda box: -len(box.get_point_indices_within_bounding_box(cloud.points))
        )

    def propose(self, search: Search) -> Candidate | None:
        """Return the next patch."""
        del search
        if not self._boxes:
            return None
        box = self._boxes.pop(0)
        normal = np.asarray(box.R, dtype=np.float64)[:, 2]
        offset_m = float(normal @ np.asarray(box.center, dtype=np.float64))
        return Candidate(plane=Plane(normal=normal, offset_m=offset_m), constraint=self._constraint)
