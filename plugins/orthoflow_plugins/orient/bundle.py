"""`orient.colmap-bundle`: all photos at once, from their ties with the walls and between them."""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from importlib.metadata import version
from typing import ClassVar, Final

import numpy as np
from pydantic import Field

from orthoflow.errors import GeometryError
from orthoflow.products import JsonValue, Photo, Ties
from orthoflow.sdk import DiagnosticSpec, Method, MetricSpec, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.orient.adjustment import Adjusted, adjust_block, of_another_lens
from orthoflow_plugins.orient.block import correlation_notes, lens_statistics, lenses_json
from orthoflow_plugins.orient.gates import GATES_BEFORE_BLOCK, refusal
from orthoflow_plugins.orient.lenses import Refined, Sharing, lens_groups
from orthoflow_plugins.orient.parameters import (
    ORIENTATION_METRICS,
    OrientIn,
    OrientOut,
    OrientParams,
)
from orthoflow_plugins.orient.photo_ties import (
    PhotoTies,
    no_features,
    no_photo_ties,
    overlapping_pairs,
    photo_features,
    tie_photos,
)
from orthoflow_plugins.orient.photos import (
    Trusted,
    by_itself,
    candidate_of,
    looked_at,
    refused,
    require,
    tied_photo,
    with_believable_priors,
)
from orthoflow_plugins.orient.pose import TiedPhoto, estimate_pose
from orthoflow_plugins.orient.report import Oriented, hand_over

_SHARE_BY_ITSELF: Final = 0.4
_SHARE_FEATURES: Final = 0.7
# Photos are tied when each shows so much of what the other shows of the walls.
_MIN_OVERLAP: Final = 0.2
# So many points between photos fix a block; more would only take time.
_MAX_PHOTO_POINTS: Final = 1000
# So shared, a lens is asked of each of its photos whether it can be its own.
_TESTED: Final = "focal-group"
NO_BLOCK: Final = DiagnosticSpec(
    code="bundle-without-result",
    severity="warning",
    text="the photos keep their separate orientations: {reason}",
)


class OrientColmapBundle(Method):
    """Orient all photos at once: bundle adjustment with the scan as control.

    Each photo is first oriented by itself, and one whose pose agrees with its ties no better than
    chance stays out. Key points that photos share tie them to each other. COLMAP's cost functions
    and the Ceres solver then adjust poses, lenses and points together: every tie with a wall pulls
    with the standard deviation that its matcher gives, ties between photos with the one that their
    residuals show. Lenses without calibration start from EXIF and are refined, common to the photos
    that share a focal length, or without EXIF to those whose ties do not contradict that. Photos
    are judged as in `orient.pnp`, by the same withheld ties.
    """

    id: ClassVar[str] = "orient.colmap-bundle"
    determinism: ClassVar[Determinism] = "seeded"
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        *ORIENTATION_METRICS,
        MetricSpec("n_photo_points", label="points seen in several photos"),
        MetricSpec("photo_tie_rmse_px", label="ties between photos, RMS", better="lower"),
        MetricSpec("sigma0", label="sigma of unit weight"),
        MetricSpec("redundancy", label="redundancy of the adjustment"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        (
            "Schoenberger, Frahm 2016, Structure-from-motion revisited (COLMAP), "
            "doi:10.1109/CVPR.2016.445"
        ),
        "Triggs et al. 2000, Bundle adjustment, a modern synthesis, doi:10.1007/3-540-44480-7_21",
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (4.3)",
    )

    class Params(OrientParams):
        """Lenses and ties between photos, and what `orient.pnp` takes, too."""

        intrinsics: Sharing = Field(
            default="focal-group",
            description="Which photos share a lens: those of one size and one focal length, or of "
            "one size where no file says it and their ties do not contradict (focal-group), "
            "all of one size (shared), or none (per-photo).",
        )
        refine: Refined = Field(
            default="uncalibrated",
            description="Which lenses the adjustment refines: uncalibrated, all, or none.",
        )
        photo_ties: bool = Field(
            default=True, description="Tie the photos to each other, too, where they overlap."
        )
        max_features: int = Field(
            default=3000, ge=100, description="Key points per photo for ties between photos."
        )

    In = OrientIn
    Out = OrientOut

    def run(self, inputs: OrientIn, params: Params, ctx: StepContext) -> OrientOut:
        """Orient each photo, then all of them together."""
        ties = inputs.ties
        require(ties, inputs.photos)
        photos = with_believable_priors(inputs.photos.photos, ties, params, ctx)
        tied = [tied_photo(photo, ties, params, ctx.rng) for photo in photos]
        looks = looked_at(
            tied, lambda one: _by_itself(one, ties, params), ctx, share=_SHARE_BY_ITSELF
        )
        found = {nth: look for nth, look in enumerate(looks) if isinstance(look, Oriented)}
        trusted = {nth: look for nth, look in enumerate(looks) if isinstance(look, Trusted)}
        details: dict[str, JsonValue] = {}
        if trusted:
            block = list(trusted.values())
            estimates = [item.estimate for item in block]
            adjusted = _adjusted(block, params, ctx)
            if adjusted is not None:
                estimates = list(adjusted.estimates)
                details = _report_block(ctx, adjusted, [item.tied.photo for item in block])
            for at, item, estimate in zip(trusted, block, estimates, strict=True):
                found[at] = item.judged(ties, params, estimate)
        every = [found[nth] for nth in range(len(photos))]
        return OrientOut(cameras=hand_over(ctx, ties, photos, every, details))

    @classmethod
    def tools(cls) -> dict[str, str]:
        """COLMAP and Ceres adjust, OpenCV finds key points."""
        names = ("pycolmap", "pyceres", "scipy", "opencv-python-headless")
        return {name: version(name) for name in names}


def _by_itself(
    tied: TiedPhoto, ties: Ties, params: OrientColmapBundle.Params
) -> Trusted | Oriented:
    """Orient a photo by its own ties; refused where they agree by chance only."""
    found = by_itself(tied, ties, params, estimate_pose)
    if isinstance(found, Oriented):
        return found
    # A wrong pose would pull at the photos that are tied to it.
    against = refusal(candidate_of(tied, ties, params, found.estimate), GATES_BEFORE_BLOCK)
    if against is None:
        return found
    return refused(tied, against.text if found.by_hand is None else found.by_hand.camera.status)


def _adjusted(
    block: Sequence[Trusted], params: OrientColmapBundle.Params, ctx: StepContext
) -> Adjusted | None:
    photos = [item.tied.photo for item in block]
    cameras = [item.estimate.resection.camera for item in block]
    between = _photo_ties(block, params, ctx)
    ctx.progress(_SHARE_FEATURES, "bundle adjustment")
    apart: Set[int] = frozenset()
    try:
        while True:
            groups = lens_groups(photos, cameras, params.intrinsics, params.refine, apart)
            adjusted = adjust_block(block, between, groups, params)
            others = of_another_lens(block, adjusted) if params.intrinsics == _TESTED else apart
            if others <= apart:
                return adjusted
            for at in sorted(others):
                ctx.log(
                    f"photo {photos[at].name}: its ties contradict the lens of the other photos of "
                    "its size, so it gets one of its own"
                )
            apart |= others
    except GeometryError as error:
        ctx.report(NO_BLOCK, reason=str(error))
        return None


def _photo_ties(
    block: Sequence[Trusted], params: OrientColmapBundle.Params, ctx: StepContext
) -> PhotoTies:
    cameras = [item.estimate.resection.camera for item in block]
    shown = [item.tied.control(item.estimate.agreeing).points_world for item in block]
    pairs = overlapping_pairs(cameras, shown, _MIN_OVERLAP)
    if not (params.photo_ties and pairs):
        return no_photo_ties()
    needed = {at for pair in pairs for at in pair}
    features = []
    for at, item in enumerate(block):
        done = _SHARE_BY_ITSELF + (_SHARE_FEATURES - _SHARE_BY_ITSELF) * at / len(block)
        ctx.progress(done, f"key points of {item.tied.photo.name}")
        wanted = photo_features(item.tied.photo, params.max_features) if at in needed else None
        features.append(wanted or no_features())
    return tie_photos(cameras, features, pairs, _MAX_PHOTO_POINTS)


def _report_block(
    ctx: StepContext, adjusted: Adjusted, photos: Sequence[Photo]
) -> dict[str, JsonValue]:
    """Report of the block as a whole; of its photos, each tells itself."""
    block, covariance = adjusted.block, adjusted.covariance
    for photo, (note, values) in correlation_notes(block, photos, covariance.cofactors):
        ctx.report(note, subject=photo, **values)
    ctx.metric("sigma0", covariance.sigma0, "1")
    ctx.metric("redundancy", covariance.redundancy, "1")
    ctx.metric("n_photo_points", adjusted.n_tie_points, "1")
    if math.isfinite(adjusted.tie_rmse_px):
        ctx.metric("photo_tie_rmse_px", adjusted.tie_rmse_px, "px")
    return {
        "sigma0": covariance.sigma0,
        "redundancy": covariance.redundancy,
        "lenses": lenses_json(block, photos, covariance.matrix),
        "lens_statistics": lens_statistics(block),
        "photo_ties": {
            "n_points": adjusted.n_tie_points,
            "n_observations": adjusted.n_tie_observations,
            "sigma_px": adjusted.tie_sigma_px if np.isfinite(adjusted.tie_sigma_px) else None,
        },
    }
