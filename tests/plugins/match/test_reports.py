"""What `match.sift` and `match.guided` tell of ties, and which photos are placed by structure."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.match import guided, sift
from orthoflow_plugins.match.descriptors import Matches
from orthoflow_plugins.match.features import Features
from orthoflow_plugins.match.guided import MatchGuided
from orthoflow_plugins.match.pairing import Pair, PhotoPairs
from orthoflow_plugins.match.sift import MatchSift
from orthoflow_plugins.match.tie_pieces import TiePiece
from orthoflow_plugins.match.traced_photos import TracedPhoto
from orthoflow_plugins.match.tracing import CONTENTS

from orthoflow.errors import MethodError
from orthoflow.products import Camera, TieRole, Ties
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms
from tests import samples


def context(folder: Path) -> StepContext:
    return StepContext(rng=np.random.default_rng(1), cores=1, scratch=folder)


def told(ctx: StepContext) -> dict[str, float]:
    return {metric.name: metric.value for metric in ctx.metrics}


def ties(photo: list[int], role: list[TieRole], names: tuple[str, ...]) -> Ties:
    n = len(photo)
    return samples.ties(
        np.zeros((n, 2)),
        photo_names=names,
        photo=np.array(photo, dtype=np.int32),
        points_world=np.zeros((n, 3)),
        sigma_px=0.1 * (1.0 + np.arange(n)),
        sigma_m=np.zeros(n),
        role=np.array(role, dtype=np.uint8),
    )


GOOD, BAD = TieRole.CONTROL, TieRole.REJECTED
NAMES = ("a", "b", "c", "d")
WALLS: Any = SimpleNamespace(walls=[SimpleNamespace(name="west"), SimpleNamespace(name="east")])


def key_points(n: int) -> Features:
    return Features(
        pixels=np.zeros((n, 2)),
        sizes_px=np.ones(n),
        angles_deg=np.zeros(n),
        descriptors=np.zeros((n, 128), dtype=np.float32),
    )


def test_ties_of_key_points_are_counted(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    found = ties([0, 0, 0, 1, 1, 3, 3, 3], [GOOD, GOOD, GOOD, GOOD, BAD, BAD, BAD, GOOD], NAMES)
    sift._report(ctx, found, [key_points(30), None, key_points(12)])
    assert told(ctx) == {
        "n_ties": 5,
        "n_rejected": 3,
        "rejected_share": 0.375,
        "n_photos_matched": 3,
        # 3, 1, 0 and 1 of the four photos.
        "ties_per_photo_median": 1.0,
        "n_wall_key_points": 42,
    }
    nothing = context(tmp_path)
    sift._report(nothing, ties([], [], NAMES), [None])
    assert told(nothing)["rejected_share"] == told(nothing)["n_photos_matched"] == 0.0


def traced(n_measured: int, n_outliers: int, *held_out_px: float) -> TracedPhoto:
    camera = ms.camera_before(ms.textured_wall(0))
    return TracedPhoto(
        photo=0,
        pieces=(),
        n_measured=n_measured,
        n_outliers=n_outliers,
        held_out_px=held_out_px,
        content="grey",
        camera=camera,
        settled=camera,
    )


def test_ties_of_patches_are_told_with_how_they_fit(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    found = ties([0, 0, 0, 1, 3], [GOOD] * 5, NAMES)
    traces = {
        "a": traced(40, 10, 0.8, 0.5, 0.6),
        "b": traced(50, 5, 0.9),
        "c": traced(10, 10),
        "d": traced(100, 25, 0.7),
    }
    guided._report(ctx, found, traces)
    assert told(ctx) == {
        "n_ties": 5,
        "n_photos_matched": 3,
        "ties_per_photo_median": 1.0,
        "rejected_share": 0.25,
        # The best round of each that has any: 0.5, 0.9 and 0.7.
        "held_out_rmse_px_median": 0.7,
        "held_out_rmse_px_worst": 0.9,
        "sigma_px_median": pytest.approx(0.3),
    }
    nothing = context(tmp_path)
    guided._report(nothing, ties([], [], NAMES), {})
    assert told(nothing) == {
        "n_ties": 0,
        "n_photos_matched": 0,
        "ties_per_photo_median": 0.0,
        "rejected_share": 0.0,
    }
    assert guided._note(traces["a"]) == {
        "n_ties": 0,
        "n_measured": 40,
        "n_outliers": 10,
        "channels": "grey",
        "held_out_px": [0.8, 0.5, 0.6],
    }


def test_what_is_asked_of_guided_matching_becomes_its_rule() -> None:
    params = MatchGuided.Params(
        search_radius_cells=9,
        half_patch_cells=7,
        score_min_share=0.4,
        distinct_min_share=0.1,
        n_ties_max=333,
        n_rounds_max=3,
    )
    rule = guided._rule(params, 5)
    assert (rule.radius_cells, rule.half_patch_cells, rule.threads) == (9, 7, 5)
    assert (rule.score_least, rule.distinct_least) == (0.4, 0.1)
    assert (rule.n_ties_most, rule.n_rounds_most, rule.contents) == (333, 3, CONTENTS)
    alone = guided._rule(params.model_copy(update={"channels": "grey"}), 1)
    assert alone.contents == ("grey",)


def test_of_photos_without_a_pose_three_reasons_are_given() -> None:
    refused = [Camera(photo=f"{k}.png", status=f"reason {k}") for k in range(4)]
    with pytest.raises(MethodError) as caught:
        guided._oriented(ms.cameras(*refused))
    assert str(caught.value) == (
        "no photo is oriented, so none can be matched by its pose (0.png: reason 0; 1.png: "
        "reason 1; 2.png: reason 2)"
    )
    with pytest.raises(MethodError, match=r"by its pose$"):
        guided._oriented(ms.cameras())


def pair(wall: int, n: int, n_agreeing: int, *, is_shown: bool) -> Pair:
    at = np.arange(n)
    return Pair(
        wall=wall,
        matches=Matches(first=at, second=at, ratio=np.ones(n)),
        agreeing=at < n_agreeing,
        is_shown=is_shown,
    )


def pairs(*of: Pair, n_recognised: int = 0, is_mirrored: bool = False) -> PhotoPairs:
    return PhotoPairs(
        features=key_points(70),
        scale=0.5,
        pairs=of,
        radius_px=9.0,
        is_mirrored=is_mirrored,
        n_recognised=n_recognised,
        picture="negative",
    )


@pytest.mark.parametrize(
    ("shown", "is_mirrored", "said"),
    [
        (True, False, []),
        (False, False, ["photo a: no wall is recognised in it, so it gets no ties"]),
        (
            False,
            True,
            [
                (
                    "photo a: its mirror image agrees with the walls no worse than it does, so it "
                    "gets no ties: it shows a pattern that repeats, another wall, or is mirrored"
                )
            ],
        ),
    ],
)
def test_a_photo_is_noted_with_the_walls_that_it_shows(
    tmp_path: Path, shown: bool, is_mirrored: bool, said: list[str]
) -> None:
    ctx = context(tmp_path)
    of = pairs(
        pair(0, 30, 9, is_shown=False), pair(1, 40, 25, is_shown=shown), is_mirrored=is_mirrored
    )
    assert sift._note(ctx, "a", (of, None), WALLS) == {
        "n_key_points": 70,
        "picture": "negative",
        "scale": 0.5,
        "walls": ["east"] if shown else [],
        "n_matches": 70,
        "n_agreeing": 25 if shown else 0,
    }
    assert ctx.warnings == said
    piece = TiePiece(
        photo=0,
        wall=1,
        pixels_photo=np.zeros((33, 2)),
        points_world=np.zeros((33, 3)),
        sigma_px=np.ones(33),
        sigma_m=np.ones(33),
    )
    placed: Any = SimpleNamespace(piece=piece, share=0.2)
    assert sift._note(ctx, "a", (of, placed), WALLS) == {
        "picture": "structure",
        "walls": ["east"],
        "n_matches": 33,
        "n_agreeing": 33,
        "agreeing_share": 0.2,
    }


@pytest.mark.parametrize(
    ("structure", "n_recognised", "looked_at"),
    [
        ("never", (3, 3), []),
        # Some that agree by chance must not keep a photo from its place.
        ("confirmed", (3, 23), [0, 1]),
        ("confirmed", (3, 24), [0]),
        ("confirmed", (16, 40), [0]),
        ("confirmed", (24, 40), []),
        # One photo alone has nobody to confirm it, but may be placed all the same.
        ("confirmed", (3,), []),
        ("alone", (3,), [0]),
    ],
)
def test_photos_that_key_points_hardly_recognise_are_looked_for_by_structure(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    structure: str,
    n_recognised: tuple[int, ...],
    looked_at: list[int],
) -> None:
    asked: list[int] = []
    clear: list[list[int]] = []

    def places(index: int, *_: object) -> list[Any]:
        asked.append(index)
        return []

    def confirmed(photos: Any, found: Any, recognised: dict[int, Any], *_: object) -> Any:
        clear.append(sorted(recognised))
        return {}

    monkeypatch.setattr("orthoflow_plugins.match.placing.places_of", places)
    monkeypatch.setattr("orthoflow_plugins.match.confirming.confirmed", confirmed)
    photos: Any = SimpleNamespace(photos=[SimpleNamespace(name=name) for name in NAMES])
    paired = [pairs(n_recognised=n) for n in n_recognised]
    params = MatchSift.Params(structure=structure)  # type: ignore[arg-type]
    assert sift._placed(photos, WALLS, paired, params, context(tmp_path)) == {}
    assert asked == looked_at
    # Those that key points recognise confirm.
    expected = [k for k, n in enumerate(n_recognised) if n >= 16]
    assert clear == ([expected] if looked_at else [])
    mirrored = [pairs(n_recognised=0, is_mirrored=True)] * 2
    asked.clear()
    sift._placed(photos, WALLS, mirrored, params, context(tmp_path))
    assert asked == []


@pytest.mark.parametrize(("n_recognised", "is_placed"), [(15, True), (16, False)])
def test_a_place_that_nobody_confirms_does_not_stand_against_key_points(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, n_recognised: int, is_placed: bool
) -> None:
    place: Any = SimpleNamespace(is_clear=True)
    monkeypatch.setattr("orthoflow_plugins.match.placing.places_of", lambda *_: [place])
    monkeypatch.setattr("orthoflow_plugins.match.confirming.confirmed", lambda *_: {})
    photos: Any = SimpleNamespace(photos=[SimpleNamespace(name="a")])
    ctx = context(tmp_path)
    paired = [pairs(n_recognised=n_recognised)]
    placed = sift._placed(photos, WALLS, paired, MatchSift.Params(structure="alone"), ctx)
    assert placed == ({0: place} if is_placed else {})
    assert len(ctx.warnings) == is_placed


def test_what_stands_free_is_told_from_the_cloud_between_all_photos_and_walls(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []

    def occluders(cloud: Any, slabs: Any, cameras: Any, **more: Any) -> str:
        asked.append((cloud, slabs, cameras, more))
        return "found"

    monkeypatch.setattr("orthoflow.geometry.occluders.occluders_before", occluders)
    slabs = [SimpleNamespace(front_m=0.1), SimpleNamespace(front_m=0.3)]
    walls = SimpleNamespace(
        walls=["west", "east"], slab=lambda index: slabs[index], points_apart_m=lambda: 0.004
    )
    cloud = SimpleNamespace(stations="stations")
    cameras: Any = [SimpleNamespace(viewing=lambda: "viewer")] * 3
    inputs: Any = SimpleNamespace(cloud=cloud, walls=walls)
    before = guided._before(inputs, cameras)
    assert before is not None
    assert before.occluders == "found"
    assert before.front_m == (0.1, 0.3)
    ((given, of, viewers, more),) = asked
    assert given is cloud
    assert (of, viewers) == (slabs, ["viewer"] * 3)
    # A point with fewer than six about it, itself included, is an outlier.
    assert more == {"spacing_m": 0.004, "stations_world": "stations", "n_least": 6, "threads": 1}
    for nothing in (
        SimpleNamespace(cloud=None, walls=walls),
        SimpleNamespace(cloud=cloud, walls=SimpleNamespace(walls=[])),
    ):
        assert guided._before(nothing, cameras) is None  # type: ignore[arg-type]
