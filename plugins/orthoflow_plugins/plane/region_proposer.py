"""Proposes the planes of regions, the one with most free points first, and labels by region."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow_plugins.plane.candidates import Candidate, Family, FoundPlane
from orthoflow_plugins.plane.regions import Regions
from orthoflow_plugins.plane.remainders import Remainder

# A region's plane may lean by this much more than what is looked for; the fit decides.
_LEAN_CAUTION_DEG: Final = 3.0
# Parts of a wall are regions of their own: together they may hold what each alone does not.
PART_SHARE: Final = 0.2


@dataclass(kw_only=True)
class RegionProposer:
    """Proposes the planes of regions.

    Attributes:
        regions: the regions, grown on all points.
        region_of_sample: (s,) region of each point of the sample, -1 for none.
        family: which planes are looked for.
        tilt_most_deg: how far they may be off vertical or level.
        least_points: of the sample, that a plane needs.
        proposes_once: a region has one plane, also where many of its points lie off it.
    """

    regions: Regions
    region_of_sample: NDArray[np.int32]
    family: Family
    tilt_most_deg: float
    least_points: float
    proposes_once: bool
    _barred: set[int] = field(default_factory=set)
    _last: int = -1

    def propose(self, remainder: Remainder) -> Candidate | None:
        """Name the plane of the region with most unclaimed points."""
        free = self.region_of_sample[(remainder.claims < 0) & (self.region_of_sample >= 0)]
        counts = np.bincount(free, minlength=len(self.regions.n_points))
        for region in np.argsort(-counts, kind="stable").tolist():
            if counts[region] < PART_SHARE * self.least_points:
                return None
            plane = self.regions.planes.get(region)
            if plane is None or region in self._barred:
                continue
            if self._leans_too_much(float(plane.normal @ remainder.up)):
                self._barred.add(region)
                continue
            if self.proposes_once:
                self._barred.add(region)
            self._last = region
            return Candidate(
                plane=plane,
                family=self.family,
                support=float(self.regions.n_points[region]),
                start=self.regions.starts[region],
            )
        return None

    def reject(self, candidate: Candidate) -> None:
        """Do not name the last region again."""
        del candidate
        self._barred.add(self._last)

    def _leans_too_much(self, rise: float) -> bool:
        tilt_deg = math.degrees(math.asin(min(1.0, abs(rise))))
        limit_deg = self.tilt_most_deg + _LEAN_CAUTION_DEG
        if self.family == "wall":
            return tilt_deg > limit_deg
        return self.family == "level" and tilt_deg < 90.0 - limit_deg


def claim_by_region(found: list[FoundPlane], regions: Regions, whole: Remainder) -> None:
    """Give each point to the plane of its region instead of the plane it is near.

    A region belongs to the plane that most of its points are near, if more than half of them are
    near any; the claims of the cloud say which those are.
    """
    claims = whole.sample_claims
    region_of = regions.region_of_cell
    region_of_sample = regions.region_of(whole.sample.points)
    near = (region_of_sample >= 0) & (claims >= 0)
    n_regions = len(regions.n_points)
    joint = np.zeros((n_regions, len(found)), dtype=np.int64)
    np.add.at(joint, (region_of_sample[near], claims[near]), 1)
    n_sampled = np.bincount(region_of_sample[region_of_sample >= 0], minlength=n_regions)
    owner = np.where(joint.sum(axis=1) * 2 > n_sampled, joint.argmax(axis=1), -1)
    # The last entry stands for cells in no region: a region of -1 picks it.
    owners = np.append(owner, -1).astype(np.int8)[region_of]
    regions.cells.claim(whole, owners)
