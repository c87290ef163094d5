"""`match.sift`: match photos with walls by SIFT key points (markiewicz2015, 3.5, 3.6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from typing import TYPE_CHECKING, ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.geometry.key_points import Features
from orthoflow.products import (
    PHOTOS_UPSIDE_DOWN,
    JsonValue,
    Photo,
    Photos,
    TieRole,
    Ties,
    Walls,
)
from orthoflow.sdk import DiagnosticSpec, Method, MetricSpec, Ports, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.match.key_points import (
    CLEARLY,
    LEAST,
    PairingParams,
    PhotoPairs,
    pair_in_colours,
    wall_features,
)
from orthoflow_plugins.match.pictures import one_by_one, require_photos
from orthoflow_plugins.match.ties import (
    TiePiece,
    key_point_ties,
    paper_ties,
    ties_by_hand_alone,
    ties_of,
    with_ties_by_hand,
    without_twins,
)

if TYPE_CHECKING:
    from orthoflow_plugins.match.placing import Placed

MIRRORED: Final = DiagnosticSpec(
    code="photo-mirrored",
    severity="warning",
    text="photo {subject} gets no ties, because its mirror image matches the walls better than "
    "the photo itself: the photo is mirrored, it shows a repeating pattern or another wall, or "
    "the front sides of the planes are wrong",
    remedy="flip the photo if it is mirrored; check {step[read.scan]}.view_from",
)
NO_WALL: Final = DiagnosticSpec(
    code="photo-shows-no-wall",
    severity="warning",
    text="photo {subject} gets no ties, because no wall was recognised in it",
)


class MatchSift(Method):
    """Match photos with the intensity rasters of the walls (RootSIFT, mutual matches, ratio test).

    The strongest key points of a photo are matched with all walls, then all of its key points are
    matched with the recognised walls. If no wall is clearly recognised in grey, mixtures of the
    colours of the photo are tried. If these also fail, edges are compared regardless of which side
    is brighter; another photo must confirm the resulting position. Matches that do not fit a
    homography of the wall are kept as rejected ties. Ties include the depth of the surface. The
    step fails if most photos are upside down, because the vertical axis of the scan is then usually
    wrong.
    """

    id: ClassVar[str] = "match.sift"
    determinism: ClassVar[Determinism] = "exact"
    result_version: ClassVar[int] = 3
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_ties", label="ties"),
        MetricSpec("n_rejected", label="ties rejected"),
        MetricSpec("rejected_share", label="share of rejected ties"),
        MetricSpec("n_photos_matched", label="photos with accepted matches"),
        MetricSpec("ties_per_photo_median", label="ties per photo, median"),
        MetricSpec("n_wall_key_points", label="key points of the walls"),
        MetricSpec("n_by_hand", label="ties measured by hand"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (3.5, 3.6)",
        "Lowe 2004, Distinctive image features, doi:10.1023/B:VISI.0000029664.99615.94",
        (
            "Arandjelovic, Zisserman 2012, Three things everyone should know, "
            "doi:10.1109/CVPR.2012.6248018"
        ),
    )

    class Params(PairingParams):
        """Key points and criteria for matches."""

        preset: Literal["none", "paper"] = Field(
            default="none",
            description="paper: as in markiewicz2015, with OpenCV's default SIFT, no "
            "equalisation, and the best match in the photo for each key point of a wall; of the "
            "other parameters, only `ratio` is used.",
        )
        structure: Literal["never", "confirmed"] = Field(
            default="confirmed",
            description="If a photo has no clear key point matches, compare its edges with those "
            "of the walls in colours, intensity and relief. confirmed: accept a position if "
            "another photo, also placed on the walls, shows the same key points there. The errors "
            "of such ties are correlated, so the predicted error of an orientation computed from "
            "them is too small; match.guided measures the ties again.",
        )

    class In(Ports):
        """The photos, the wall rasters, and ties measured by hand."""

        photos: Photos
        walls: Walls
        hand: Ties | None = None

    class Out(Ports):
        """Tie points between photos and walls."""

        ties: Ties

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Match each photo with each wall, and return the ties."""
        photos, walls = inputs.photos, inputs.walls
        require_photos(photos)
        alone = ties_by_hand_alone(inputs.hand, photos, walls, ctx)
        if alone is not None:
            return self.Out(ties=alone)
        details: dict[str, JsonValue] = {"intensity_source": walls.intensity_source}
        radii_px: list[float] = []
        if params.preset == "paper":
            pieces, on_walls = paper_ties(photos, walls, None, params.ratio, ctx)
        else:
            ctx.progress(0.0, "key points of the walls")
            find = partial(wall_features, max_features=params.max_features)
            on_walls = list(one_by_one(find, walls.walls, ctx.cores))
            pieces, details["photos"], radii_px = _matched(photos, walls, on_walls, params, ctx)
        ties = ties_of(pieces, photos, walls, details, search_radius_px=tuple(radii_px))
        _report(ctx, ties, on_walls)
        if values := ties.upside_down(walls.up):
            ctx.report(PHOTOS_UPSIDE_DOWN, **values)
            raise MethodError("most photos are upside down, so all later results would be wrong")
        return self.Out(ties=with_ties_by_hand(ties, inputs.hand, walls, ctx))

    @classmethod
    def tools(cls) -> dict[str, str]:
        """OpenCV for detection and description of key points."""
        return {"opencv-python-headless": version("opencv-python-headless")}


def _matched(
    photos: Photos,
    walls: Walls,
    on_walls: Sequence[Features | None],
    params: MatchSift.Params,
    ctx: StepContext,
) -> tuple[list[TiePiece], dict[str, JsonValue], list[float]]:
    """Match photos with the walls by key points, and by structure if the result is unclear.

    Returns:
        Ties, details of each photo, and the search radius of each photo.
    """

    def pair(photo: Photo) -> PhotoPairs:
        return pair_in_colours(photo, on_walls, params)

    paired: list[PhotoPairs] = []
    for photo, pairs in zip(photos.photos, one_by_one(pair, photos.photos, ctx.cores), strict=True):
        paired.append(replace(pairs, features=pairs.features.undescribed()))
        ctx.progress(len(paired) / (len(photos.photos) + 1), photo.name)
    pieces: list[TiePiece] = []
    notes: dict[str, JsonValue] = {}
    radii_px: list[float] = []
    placed = _placed(photos, walls, paired, params, ctx)
    for index, (photo, pairs) in enumerate(zip(photos.photos, paired, strict=True)):
        place = placed.get(index)
        pieces += _pieces(index, pairs, on_walls, walls) if place is None else [place.piece]
        notes[photo.name] = _note(ctx, photo.name, (pairs, place), walls)
        radii_px.append(pairs.radius_px if place is None else place.radius_px)
    return pieces, notes, radii_px


def _placed(
    photos: Photos,
    walls: Walls,
    paired: Sequence[PhotoPairs],
    params: MatchSift.Params,
    ctx: StepContext,
) -> dict[int, Placed]:
    """Find the positions of photos without clear key point matches from structure, by index."""
    from orthoflow_plugins.match.placing import confirmed, places_of
    from orthoflow_plugins.match.structures import wall_structure

    unclear = [
        index
        for index, pairs in enumerate(paired)
        if not pairs.is_mirrored and pairs.n_recognised < CLEARLY
    ]
    if params.structure == "never" or not unclear or len(paired) < 2:
        return {}
    structures = [wall_structure(wall) for wall in walls.walls]
    places: dict[int, list[Placed]] = {}

    def look(index: int) -> list[Placed]:
        return places_of(index, photos.photos[index], structures, ctx.cores // len(unclear))

    for index, found in zip(unclear, one_by_one(look, unclear, ctx.cores), strict=True):
        ctx.progress(1.0 - 1.0 / (len(paired) + 1), f"{photos.photos[index].name}, by structure")
        places[index] = found
    recognised = {k: pairs for k, pairs in enumerate(paired) if pairs.n_recognised >= LEAST}
    return confirmed(photos, places, recognised, (walls.walls, structures), ctx.cores)


def _pieces(
    photo: int, pairs: PhotoPairs, on_walls: Sequence[Features | None], walls: Walls
) -> list[TiePiece]:
    shown: list[TiePiece] = []
    rest: list[TiePiece] = []
    for pair in pairs.pairs:
        features = on_walls[pair.wall]
        assert features is not None  # noqa: S101 - only walls with key points have matches
        piece = key_point_ties(
            (photo, pair.wall),
            walls.walls[pair.wall],
            (pairs.features.take(pair.matches.first), features.take(pair.matches.second)),
            scale=pairs.scale,
            role=TieRole.CONTROL if pair.is_shown else TieRole.REJECTED,
        )
        (shown if pair.is_shown else rest).append(piece)
    return sorted(without_twins(shown) + rest, key=lambda piece: piece.wall)


def _note(
    ctx: StepContext, name: str, found: tuple[PhotoPairs, Placed | None], walls: Walls
) -> JsonValue:
    pairs, placed = found
    if placed is not None:
        return {
            "picture": "structure",
            "walls": [walls.walls[placed.piece.wall].name],
            "n_matches": len(placed.piece),
            "n_agreeing": len(placed.piece),
            "agreeing_share": placed.share,
        }
    shown = [walls.walls[pair.wall].name for pair in pairs.pairs if pair.is_shown]
    if pairs.is_mirrored:
        ctx.report(MIRRORED, subject=name)
    elif not shown:
        ctx.report(NO_WALL, subject=name)
    return {
        "n_key_points": len(pairs.features),
        "picture": pairs.picture,
        "scale": pairs.scale,
        "walls": list(shown),
        "n_matches": sum(len(pair.matches) for pair in pairs.pairs),
        "n_agreeing": pairs.n_verified,
    }


def _report(ctx: StepContext, ties: Ties, on_walls: Sequence[Features | None]) -> None:
    kept = ties.role != TieRole.REJECTED
    per_photo = np.bincount(ties.photo[kept], minlength=len(ties.photo_names))
    ctx.metric("n_ties", int(kept.sum()), "1")
    ctx.metric("n_rejected", int((~kept).sum()), "1")
    ctx.metric("rejected_share", float((~kept).mean()) if len(kept) else 0.0, "1")
    ctx.metric("n_photos_matched", int((per_photo > 0).sum()), "1")
    ctx.metric("ties_per_photo_median", float(np.median(per_photo)), "1")
    ctx.metric("n_wall_key_points", sum(len(f) for f in on_walls if f is not None), "1")
