"""`orient.dlt`: each photo by itself by a direct linear transform (markiewicz2015, 3.6 and 4.3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import GeometryError
from orthoflow.geometry.lenses import LensFreedom
from orthoflow.geometry.resection import SeenPoints
from orthoflow.products import Cameras, Photo, Photos, Ties
from orthoflow.sdk import Method, Ports, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.orient.direct_linear import direct_linear, relief
from orthoflow_plugins.orient.estimating import (
    Estimate,
    EstimationRule,
    Start,
    adjusted,
    no_pose,
    robust_start,
)
from orthoflow_plugins.orient.lens_lack import with_what_is_missing
from orthoflow_plugins.orient.parameters import OrientParams
from orthoflow_plugins.orient.photowise import each_by_itself
from orthoflow_plugins.orient.reporting import told

Distortion = Literal["none", "k1", "k1 k2 p1 p2"]

# Nearly free: what points with relief say of a lens outweighs these by far.
_FREE: Final = {"focal_sigma": 1.0, "aspect_sigma": 0.5}
_CENTRE_SHARE: Final = 0.5
# Decentring and principal point explain each other on all but the deepest relief.
_PINNED_CENTRE_SHARE: Final = 0.05
_FULL: Final = "k1 k2 p1 p2"
_FREEDOMS: Final[Mapping[Distortion, LensFreedom]] = {
    "none": LensFreedom(**_FREE),
    "k1": LensFreedom(**_FREE, k1_sigma=0.5),
    _FULL: LensFreedom(**_FREE, k1_sigma=0.5, k2_sigma=0.5, tangential_sigma=0.01),
}
_LEAST: Final[Mapping[Distortion, int]] = {"none": 12, "k1": 16, _FULL: 24}
# Relief below this many standard deviations of the points is mostly their noise.
_RELIEF_SIGMAS: Final = 10.0
# Flatter control leaves the eleven parameters to the rounding of its coordinates.
_CONDITION_MOST: Final = 5000.0


class OrientDlt(Method):
    """Orient each photo by eleven parameters, or more with distortion, known from its ties alone.

    Calibration and EXIF serve only to reject wrong ties. The linear solution starts a weighted
    adjustment of pose, fx, fy and principal point (and distortion); of the eleven parameters the
    skew is recorded but not kept, since no lens of today has one. Control that lies near one plane
    does not determine the parameters and is refused. Everything is judged as in `orient.pnp`.
    """

    id: ClassVar[str] = "orient.dlt"
    result_version: ClassVar[int] = 4
    determinism: ClassVar[Determinism] = "seeded"
    citations: ClassVar[tuple[str, ...]] = (
        "abdelaziz1971: Direct linear transformation, doi:10.14358/PERS.81.2.103",
        "hartley1997: In defense of the eight-point algorithm, doi:10.1109/34.601246",
        "markiewicz2015: orthoimages of cultural heritage objects from TLS and images, 3.6, 4.3",
    )

    class Params(OrientParams):
        """The distortion that is estimated besides, and what `orient.pnp` takes, too."""

        distortion: Distortion = Field(
            default="none",
            description="Distortion estimated with the eleven parameters: none, k1, or "
            "k1 k2 p1 p2.",
        )

    class In(Ports):
        """Ties, and the photos they are in."""

        ties: Ties
        photos: Photos

    class Out(Ports):
        """One orientation per photo."""

        cameras: Cameras

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Orient the photos one after the other."""
        estimator = partial(estimate_dlt, distortion=params.distortion)
        found = each_by_itself(inputs.ties, inputs.photos, params, ctx, estimator)
        return self.Out(cameras=told(ctx, inputs.ties, inputs.photos.photos, found))

    @classmethod
    def tools(cls) -> dict[str, str]:
        """OpenCV rejects wrong ties."""
        return {name: version(name) for name in ("opencv-python-headless", "scipy")}


def estimate_dlt(
    photo: Photo,
    seen: SeenPoints,
    is_check: NDArray[np.bool_],
    rule: EstimationRule,
    *,
    distortion: Distortion,
) -> Estimate | str:
    """Orient a photo by a direct linear transform of its control ties, or say why not."""
    robust = robust_start(photo, seen, is_check, rule)
    if robust is None:
        return no_pose(seen)
    control = seen.take(robust.agreeing & ~is_check)
    reason = _too_few(len(control), distortion) or too_flat(control)
    if reason:
        return reason
    size_px = (photo.width, photo.height)
    try:
        linear = direct_linear(control.pixels_photo, control.points_world, size_px)
        if linear.condition > _CONDITION_MOST:
            return _flat(control, f"the equations have condition {linear.condition:.0f}")
        start = Start(
            camera=linear.camera,
            prior=replace(linear.camera, cx=0.5 * photo.width, cy=0.5 * photo.height),
            agreeing=robust.agreeing,
            freedom=_freedom(distortion, size_px),
            source="dlt",
            n_least_for_lens=_LEAST[distortion],
        )
        estimate = adjusted(photo, seen, is_check, start, rule)
    except GeometryError as error:
        return f"{error}: use orient.pnp or orient.colmap-bundle"
    estimate = replace(estimate, details={"skew_px": linear.skew_px, "condition": linear.condition})
    control = seen.take(estimate.agreeing & ~is_check)
    if distortion == _FULL or len(control) < _LEAST[_FULL]:
        return estimate
    return with_what_is_missing(estimate, control, start, _freedom(_FULL, size_px))


def _freedom(distortion: Distortion, size_px: tuple[int, int]) -> LensFreedom:
    share = _PINNED_CENTRE_SHARE if distortion == _FULL else _CENTRE_SHARE
    return replace(_FREEDOMS[distortion], centre_sigma_px=share * max(size_px))


def _too_few(n_control: int, distortion: Distortion) -> str:
    if n_control >= _LEAST[distortion]:
        return ""
    return (
        f"only {n_control} control ties agree with one pose, a DLT with distortion "
        f'"{distortion}" needs {_LEAST[distortion]}'
    )


def too_flat(control: SeenPoints) -> str:
    """Say that control lies too near a plane for eleven parameters; empty when it does not."""
    depth = relief(control.points_world)
    sigma_m = float(np.sqrt(np.mean(control.sigma_m**2)))
    if depth.rms_m < _RELIEF_SIGMAS * sigma_m:
        return _flat(
            control,
            f"its points are known to {1000 * sigma_m:.1f} mm, and a DLT needs "
            f"{_RELIEF_SIGMAS:g} times as much relief",
        )
    if depth.rms_m < depth.extent_m / _CONDITION_MOST:
        return _flat(control, "a DLT needs relief")
    return ""


def _flat(control: SeenPoints, why: str) -> str:
    depth = relief(control.points_world)
    return (
        f"the control lies within {1000 * depth.rms_m:.1f} mm (RMS) of one plane; {why}: use "
        "orient.pnp or orient.colmap-bundle"
    )
