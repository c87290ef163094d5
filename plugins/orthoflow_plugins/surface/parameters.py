"""Parameters that all detectors of curved surfaces share."""

from __future__ import annotations

from pydantic import Field

from orthoflow.sdk import MethodParams


class DetectorParams(MethodParams):
    """Parameters of the search; the defaults suit scans of buildings."""

    tolerance_m: float = Field(
        0.05, gt=0.0, le=1.0, description="Maximum distance of points from their surface."
    )
    min_radius_m: float = Field(0.15, gt=0.0, description="Smallest radius.")
    max_radius_m: float = Field(20.0, gt=0.0, le=200.0, description="Largest radius.")
    min_arc_deg: float = Field(
        40.0,
        ge=10.0,
        le=360.0,
        description="Minimum angle around the axis over which there are points.",
    )
    min_area_m2: float = Field(0.3, gt=0.0, description="Smallest area of a surface.")
    max_scatter_share: float = Field(
        0.006,
        gt=0.0,
        le=0.1,
        description="Largest scatter of the surface about a cylinder or cone, beyond the noise of "
        "the scan, as a share of its radius; stepped cornices have more.",
    )
    max_surfaces: int = Field(32, ge=1, le=1000, description="Maximum number of surfaces.")
