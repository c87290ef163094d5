"""Base class, ports and metrics of all detectors."""

from __future__ import annotations

from abc import abstractmethod
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Final

from orthoflow.products import Planes, PointCloud, PointLabels
from orthoflow.sdk import Method, MetricSpec, Ports, StepContext
from orthoflow_plugins.plane.proposing import Proposer

if TYPE_CHECKING:
    from orthoflow_plugins.plane.search import Search

# Metrics that all detectors report.
DETECTOR_METRICS: Final = (
    MetricSpec("n_planes", label="planes found"),
    MetricSpec("thinning", label="points of the cloud per point used in the search"),
    MetricSpec("labelled_share", label="share of points on a plane"),
    MetricSpec("first_share", label="share of points on the first plane"),
    MetricSpec("tolerance_m", label="maximum distance of points that belong to a plane"),
    MetricSpec("fit_tolerance_m", label="maximum distance of points used to fit a plane"),
    MetricSpec("noise_mm", label="scan noise normal to the surfaces"),
    MetricSpec("detection_s", label="detection time", better="lower"),
    MetricSpec("first_plane_s", label="time to the first plane", better="lower"),
    MetricSpec("next_plane_s", label="time per further plane", better="lower"),
    MetricSpec("detection_cpu_s", label="CPU time of the detection", better="lower"),
    MetricSpec("first_plane_cpu_s", label="CPU time to the first plane", better="lower"),
    MetricSpec("next_plane_cpu_s", label="CPU time per further plane", better="lower"),
    MetricSpec(
        "rms_mm",
        label="distance of points from the first plane, RMS",
        headline=True,
        description="includes the relief of the wall, so it is not an error of the image",
    ),
    MetricSpec("fit_rms_mm", label="distance of the fitted points from the first plane, RMS"),
    MetricSpec("omega_deg", label="direction of the first normal (omega)"),
    MetricSpec("phi_deg", label="inclination of the first normal (phi)"),
    MetricSpec("offset_m", label="offset of the first plane"),
    MetricSpec("r_m", label="distance of the first plane (r)"),
    MetricSpec(
        "sigma_angle_deg",
        label="predicted standard deviation of the first plane's direction",
        better="lower",
    ),
    MetricSpec(
        "sigma_offset_mm",
        label="predicted standard deviation of the first plane's position",
        better="lower",
    ),
    MetricSpec("n_independent", label="effective number of independent points on the first plane"),
    MetricSpec("skewness", label="skewness of the distances from the first plane"),
    MetricSpec("excess_kurtosis", label="excess kurtosis of the distances from the first plane"),
    MetricSpec(
        "within_[123]_sigma", label="share of distances from the first plane within {0} sigma"
    ),
    MetricSpec("raw_omega_deg", label="direction of the first normal (omega); before the fit"),
    MetricSpec("raw_phi_deg", label="inclination of the first normal (phi); before the fit"),
    MetricSpec("raw_r_m", label="distance of the first plane (r); before the fit"),
    MetricSpec(
        "raw_angle_deg",
        label="angle to the fitted plane; before the fit",
        better="lower",
    ),
    MetricSpec(
        "raw_offset_mm",
        label="distance from the fitted plane; before the fit",
        better="lower",
    ),
    MetricSpec("thickest_mm", label="largest thickness of the cloud"),
    MetricSpec("thickness_mm", label="thickness of the cloud on the first plane"),
    MetricSpec(
        "thickness_width_mm", label="width that contains 95 % of the distances from the first plane"
    ),
    MetricSpec(
        "thickness_scan_steps", label="thickness on the first plane divided by the point spacing"
    ),
    MetricSpec("scan_step_mm", label="point spacing on the first plane, without relief"),
)
PAPER: Final = (
    "Markiewicz, Podlasiak, Zawieska 2015: A New Approach to the Generation of Orthoimages "
    "of Cultural Heritage Objects. Remote Sensing 7(12), doi:10.3390/rs71215869"
)


class DetectorIn(Ports):
    """The cloud in which planes are detected."""

    cloud: PointCloud


class DetectorOut(Ports):
    """The planes, and the plane of each point."""

    planes: Planes
    labels: PointLabels


class Detector(Method):
    """Base class of methods that detect planes; subclasses provide the proposer."""

    result_version = 4
    metrics: ClassVar[tuple[MetricSpec | str, ...]] = DETECTOR_METRICS
    In = DetectorIn
    Out = DetectorOut

    def run(self, inputs: DetectorIn, params: Any, ctx: StepContext) -> DetectorOut:
        """Detect the planes of a cloud."""
        from orthoflow_plugins.plane.search import detect

        proposer_of = partial(self.proposer, params=params, ctx=ctx)
        planes, labels = detect(inputs.cloud, params, ctx, proposer_of, method=self.id)
        return DetectorOut(planes=planes, labels=labels)

    # The type of `params` is Any, because each detector has other parameters.
    @abstractmethod
    def proposer(self, search: Search, params: Any, ctx: StepContext) -> Proposer:
        """Return the proposer of this detector for a new search."""
