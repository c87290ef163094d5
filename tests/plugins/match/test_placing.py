"""Photos are placed by where edges run, whichever side of them the laser sees brighter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import placing
from orthoflow_plugins.match.channels import Channels
from orthoflow_plugins.match.displacements import Displacements
from orthoflow_plugins.match.placing import Placed, PlacedWalls, places_of
from orthoflow_plugins.match.structures import Place
from orthoflow_plugins.match.tie_pieces import TiePiece

from orthoflow.files.images import decode_image, encode_png
from orthoflow.products import Photo, Wall
from orthoflow.testing import photographed as ms

CAMERA = ms.camera_before(ms.textured_wall(1))


@cache
def usual_photo() -> Photo:
    return ms.photo_of(ms.textured_wall(1), CAMERA)


def patchy_wall() -> Wall:
    """The wall as a laser sees it that inverts contrast in every second of many fields."""
    wall = ms.walls_of(ms.textured_wall(1)).walls[0]
    assert wall.intensity is not None
    rows, columns = np.indices(wall.frame.shape) * 5 // min(wall.frame.shape)
    sign = np.where((rows + columns) % 2 == 0, -1.0, 1.0)
    return replace(wall, intensity=(0.5 + sign * (wall.intensity - 0.5)).astype(np.float32))


@cache
def patchy_walls() -> PlacedWalls:
    return PlacedWalls(walls=[patchy_wall()])


def placed(photo: Photo) -> Placed | None:
    places = places_of(0, photo, patchy_walls())
    assert not any(place.is_clear for place in places[1:])
    return next((place for place in places if place.is_clear), None)


def off_cells(found: Placed, seen_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far ties are from the truth, in the coarse cells that they were found in."""
    off_px = seen_px - found.piece.pixels_photo
    return np.linalg.norm(off_px, axis=1) / (2.0 * found.piece.sigma_px)


def test_a_photo_is_placed_where_contrast_is_inverted_here_and_there() -> None:
    found = placed(usual_photo())
    assert found is not None
    off = off_cells(found, CAMERA.project(found.piece.points_world)[:, :2])
    assert np.median(off) < 1.0
    assert (off < 3.0).mean() > 0.9


def test_neither_a_lens_nor_how_the_camera_was_held_needs_to_be_known() -> None:
    scene = ms.textured_wall(1)
    camera = ms.camera_before(scene, centre=(3.4, -1.9, 1.2), towards=(1.6, 0.0, 1.0))
    upright = decode_image(ms.photo_of(scene, camera).encoded, "a.png")
    turned = np.ascontiguousarray(np.rot90(upright))
    photo = replace(
        usual_photo(), encoded=encode_png(turned), width=640, height=900, intrinsics=None
    )
    assert photo.exif_focal_px is None
    found = placed(photo)
    assert found is not None
    u, v = camera.project(found.piece.points_world)[:, :2].T
    # 44 degrees from square, a quarter turned, a focal length of 0.93 instead of 0.8 of its width.
    assert np.median(off_cells(found, np.column_stack([v, 900.0 - u]))) < 1.0
    assert abs(found.camera.fx / camera.fx - 1.0) < 0.05


def test_a_photo_held_at_an_odd_angle_is_placed(monkeypatch: pytest.MonkeyPatch) -> None:
    # Right between two turns that are tried; of the others only one is, to be quick.
    assert 30.0 in placing._OTHERS_DEG
    monkeypatch.setattr(placing, "_QUARTERS_DEG", (0.0,))
    monkeypatch.setattr(placing, "_OTHERS_DEG", (30.0,))
    scene = ms.textured_wall(1)
    camera = ms.camera_before(scene, roll=np.radians(22.5))
    found = placed(replace(ms.photo_of(scene, camera), intrinsics=None))
    assert found is not None
    off = off_cells(found, camera.project(found.piece.points_world)[:, :2])
    assert np.median(off) < 1.0
    assert (off < 3.0).mean() > 0.9


def test_turns_go_all_around_near_each_other_where_nobody_says_how_a_photo_was_held() -> None:
    bare = replace(usual_photo(), intrinsics=None)
    first, then = placing._turns_deg(bare)
    turns = np.sort(np.mod([*first, *then], 360.0))
    np.testing.assert_array_equal(np.diff([*turns, turns[0] + 360.0]), 15.0)
    # As cameras are held, before all other ways.
    assert first == (0.0, 90.0, -90.0, 180.0)
    assert placing._turns_deg(usual_photo()) == placing._turns_deg(bare)
    assert placing._turns_deg(replace(bare, exif_focal_px=840.0)) == ((0.0,),)
    assert placing._turns_deg(replace(bare, exif_orientation=6)) == ((0.0,),)
    # A face of a panorama.
    intrinsics = usual_photo().intrinsics
    assert intrinsics is not None
    face = replace(usual_photo(), intrinsics=replace(intrinsics, source="given"))
    assert placing._turns_deg(face) == (first,)


@pytest.mark.parametrize("degrees", [0.0, 90.0, 180.0, 270.0, 15.0, -105.0, 45.0, 210.0])
@pytest.mark.parametrize(("shape", "scale"), [((300, 400), 1.0), ((1300, 850), 0.5)])
def test_a_turned_photo_says_where_its_places_are(
    degrees: float, shape: tuple[int, int], scale: float
) -> None:
    rows, columns = np.indices(shape, dtype=np.float64) + 0.5
    rgb = np.dstack([255 * columns / shape[1], 255 * rows / shape[0], 0 * rows]).astype(np.uint8)
    made = placing.turned(rgb, degrees, scale)
    height, width = made.rgb.shape[:2]
    across, down = np.meshgrid([0.1, 0.4, 0.5, 0.9], [0.1, 0.5, 0.8])
    shares = np.column_stack([across.ravel(), down.ravel()])
    at = (shares * [width, height]).astype(int)
    shown = made.rgb[at[:, 1], at[:, 0], :2] / 255.0 * shape[::-1]
    centres = (at + 0.5) / [width, height]
    # Of 255 levels, rounded down and smoothed.
    assert np.abs(shown - scale * made.pixels_photo(centres)).max() < 1.5 * max(shape) / 255
    # All of it is photo: nothing black from beside it.
    assert made.rgb[..., 1].min() > 0 or degrees % 90 == 0
    assert made.size_px[0] / made.size_px[1] == pytest.approx(width / height, rel=0.01)
    # What has to be turned by parts of a quarter is shrunk before.
    assert max(height, width) <= 1200 or degrees % 90 == 0


def test_exif_says_how_a_photo_was_held() -> None:
    turned = np.ascontiguousarray(np.rot90(decode_image(usual_photo().encoded, "a.png")))
    shot = replace(
        usual_photo(), encoded=encode_png(turned), width=640, height=900, intrinsics=None
    )
    # Told how it was held, no other way is tried; told wrong, it shows no wall.
    assert placed(replace(shot, exif_orientation=6)) is not None
    assert placed(replace(shot, exif_orientation=1, exif_focal_px=840.0)) is None


def test_a_mirrored_photo_is_placed_nowhere() -> None:
    mirrored = np.ascontiguousarray(decode_image(usual_photo().encoded, "a.png")[:, ::-1])
    assert placed(replace(usual_photo(), encoded=encode_png(mirrored), exif_focal_px=840.0)) is None


def test_a_photo_of_another_wall_is_placed_nowhere() -> None:
    other = ms.photo_of(ms.textured_wall(2), CAMERA)
    assert placed(replace(other, exif_focal_px=840.0)) is None


def test_a_wall_that_shows_nothing_places_no_photo() -> None:
    blind = replace(patchy_wall(), intensity=None)
    assert places_of(0, usual_photo(), PlacedWalls(walls=[blind])) == []


# --- how places are judged ---


@cache
def bare_photo() -> Photo:
    return replace(usual_photo(), intrinsics=None)


def placed_at(
    off_px: float = 0.0, *, n: int = 90, share: float = 0.3, lead: float = 9.0, wall: int = 0
) -> Placed:
    """A place by ties of the whole photo whose camera shows all so much further right."""
    camera = replace(CAMERA, cx=CAMERA.cx + off_px)
    along = np.linspace(0.1, 0.9, n)
    seen = np.column_stack(
        [along * CAMERA.width, 0.5 * CAMERA.height + 200.0 * np.sin(9.0 * along)]
    )
    points = CAMERA.centre_world + 3.0 * CAMERA.rays_world(seen)
    piece = TiePiece(
        photo=0,
        wall=wall,
        pixels_photo=camera.project(points)[:, :2],
        points_world=points,
        sigma_px=np.ones(n),
        sigma_m=np.ones(n),
    )
    return Placed(piece=piece, camera=camera, lead=lead, share=share, radius_px=1.0)


@pytest.mark.parametrize(
    ("other", "is_same"),
    [
        (placed_at(89.0, n=31), True),
        (placed_at(-89.0, n=31), True),
        (placed_at(91.0, n=31), False),
        (placed_at(-91.0, n=31), False),
        (placed_at(n=31, wall=1), False),
    ],
)
def test_places_a_tenth_of_the_photo_apart_are_two(other: Placed, is_same: bool) -> None:
    assert CAMERA.width == 900
    assert placing._is_same(placed_at(n=21), other) == is_same
    assert placing._is_same(other, placed_at(n=21)) == is_same


def test_poses_are_one_place_where_most_of_a_photo_lies_in_one() -> None:
    first = placed_at(n=21)
    for n_off, is_same in ((10, True), (11, False)):
        pixels = first.piece.pixels_photo.copy()
        pixels[:n_off] += 500.0
        strays = replace(first, piece=replace(first.piece, pixels_photo=pixels))
        assert placing._is_same(strays, first) == is_same


def test_a_lens_is_what_is_known_of_it_beforehand() -> None:
    shot = replace(usual_photo(), intrinsics=None, width=3000, height=4000)
    for exif_px, focal_px, sigma in ((None, 3200.0, 0.3), (2500.0, 2500.0, 0.05)):
        lens, freedom = placing._lens_before(replace(shot, exif_focal_px=exif_px))
        assert (lens.width, lens.height, lens.cx, lens.cy) == (3000, 4000, 1500.0, 2000.0)
        assert (lens.fx, lens.fy, lens.skew) == (focal_px, focal_px, 0.0)
        assert not lens.distortion.any()
        assert freedom.focal_sigma == sigma
    lens, freedom = placing._lens_before(usual_photo())
    assert lens.fx == CAMERA.fx
    np.testing.assert_array_equal(lens.distortion, CAMERA.distortion)
    assert not freedom.sigmas.size


def likely(*leads: float) -> list[Place]:
    nine = np.zeros((9, 2))
    return [
        Place(centre_m=np.zeros(2), width_m=1.0, lead=lead, parts_photo=nine, parts_m=nine)
        for lead in leads
    ]


def walls_seen(
    monkeypatch: pytest.MonkeyPatch,
    leads: Sequence[Sequence[float] | None],
    found: Mapping[float, Placed | None],
) -> Any:
    """Walls, each with the leads of a photo's places there; at each lead that is found."""
    structures = [None if each is None else SimpleNamespace(leads=each) for each in leads]

    def likely_places(_: Any, wall: Any, *, n_most: int, roughly: bool) -> list[Place]:
        assert not roughly
        return likely(*wall.leads)[:n_most]

    monkeypatch.setattr(placing, "likely_places", likely_places)
    monkeypatch.setattr(placing, "_camera_at", lambda place, *_: place if place.lead else None)

    def tied(at: tuple[int, int], small: Any, start: Any, structure: Any) -> Placed | None:
        assert structures[at[1]] is structure
        some = found[start[0].lead]
        return None if some is None else replace(some, piece=replace(some.piece, wall=at[1]))

    monkeypatch.setattr(placing, "_tied", tied)
    return SimpleNamespace(structures=lambda: structures)


def test_the_four_places_that_stand_out_most_are_tried_and_sorted_by_what_agrees(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    upright = replace(usual_photo(), exif_focal_px=840.0)
    found = {
        7.0: placed_at(n=50, share=0.2),
        6.0: placed_at(200.0, n=50, share=0.3),
        5.5: None,
        5.0: placed_at(20.0, n=50, share=0.4),
    }
    walls = walls_seen(monkeypatch, ((6.0, 4.0), None, (5.0, 5.5, 7.0, 3.0)), found)
    places = places_of(0, upright, walls)
    # That of 0.2 lies where that of 0.4 does, on the same wall, and stood out more.
    assert [(place.share, place.lead, place.piece.wall) for place in places] == [
        (0.4, 7.0, 2),
        (0.3, 6.0, 0),
    ]
    assert not any(place.is_clear for place in places)
    # Of a fifth place on one wall nobody asks.
    found[1.0] = None
    walls = walls_seen(monkeypatch, ((1.0, 1.0, 1.0, 1.0, 7.0),), found)
    assert places_of(0, upright, walls) == []
    assert places_of(0, upright, walls_seen(monkeypatch, (None, None), {})) == []
    walls = walls_seen(monkeypatch, ((0.0, 6.0),), {6.0: None})
    assert places_of(0, upright, walls) == []


@pytest.mark.parametrize(
    ("n_ties", "share", "n_places"), [(20, 0.05, 1), (19, 0.05, 0), (20, 0.049, 0)]
)
def test_a_place_has_twenty_ties_and_a_twentieth_of_its_patches(
    n_ties: int, share: float, n_places: int
) -> None:
    places = placing._judged([placed_at(n=n_ties, share=share)])
    assert len(places) == n_places
    assert not any(place.is_clear for place in places)


@pytest.mark.parametrize(
    ("lead", "n_ties", "share", "other", "is_clear"),
    [
        (6.5, 40, 0.08, None, True),
        (6.4, 40, 0.08, None, False),
        (6.5, 39, 0.08, None, False),
        (6.5, 40, 0.079, None, False),
        # It need not stand out so much where a quarter of all patches agrees.
        (5.5, 40, 0.25, None, True),
        (5.4, 40, 0.25, None, False),
        (6.4, 40, 0.249, None, False),
        # Half as much again as the next one.
        (9.0, 90, 0.3, 0.199, True),
        (9.0, 90, 0.3, 0.201, False),
    ],
)
def test_a_clear_place_stands_out_by_itself_and_from_the_next(
    lead: float, n_ties: int, share: float, other: float | None, is_clear: bool
) -> None:
    found = [placed_at(n=n_ties, share=share, lead=lead)]
    if other is not None:
        found.insert(0, placed_at(300.0, share=other))
    places = placing._judged(found)
    assert [place.is_clear for place in places] == [is_clear, False][: len(found)]


def test_what_was_clear_among_some_turns_is_not_beside_as_good_a_place() -> None:
    once = placing._judged([placed_at()])
    assert once[0].is_clear
    both = placing._judged([*once, placed_at(300.0, share=0.4)])
    assert [(place.share, place.is_clear) for place in both] == [(0.4, False), (0.3, False)]


@dataclass(kw_only=True)
class Looks:
    """What is asked of turns of a photo.

    Attributes:
        leads: of the places in each turn (degrees).
        found: what is found at places of such leads.
        turns: in which the photo was laid on the wall, and whether roughly.
        closer: leads of the places that were then seen closer.
        patches: leads of the places that were looked at patch by patch.
        shapes: of the photo as it was laid on the wall, and as its patches were brought together.
    """

    leads: dict[float, tuple[float, ...]]
    found: dict[float, Placed]
    turns: list[tuple[float, bool]] = field(default_factory=list)
    closer: list[float] = field(default_factory=list)
    patches: list[float] = field(default_factory=list)
    shapes: list[tuple[int, ...]] = field(default_factory=list)

    def of(self, photo: Photo, monkeypatch: pytest.MonkeyPatch) -> list[Placed]:
        """Places of a photo on one wall."""

        def turned(rgb: NDArray[np.uint8], degrees: float, scale: float) -> Any:
            self.shapes.append(rgb.shape)
            assert scale == pytest.approx(max(rgb.shape) / max(photo.width, photo.height))
            return SimpleNamespace(rgb=degrees)

        def likely_places(degrees: Any, _: Any, *, n_most: int, roughly: bool) -> list[Place]:
            self.turns.append((degrees, roughly))
            return likely(*self.leads.get(degrees, ()))[:n_most]

        def seen_closer(_: Any, __: Any, place: Place) -> Place:
            self.closer.append(place.lead)
            return replace(place, lead=place.lead + 100.0)

        def looked_at(shot: Any, _: Any, each: Any) -> Placed | None:
            self.shapes.append(shot[2].shape)
            self.patches.append(each.place.lead)
            some = self.found.get(each.place.lead)
            return None if some is None else replace(some, lead=each.place.lead)

        monkeypatch.setattr(placing, "turned", turned)
        monkeypatch.setattr(placing, "likely_places", likely_places)
        monkeypatch.setattr(placing, "closer", seen_closer)
        monkeypatch.setattr(placing, "_looked_at", looked_at)
        walls: Any = SimpleNamespace(structures=lambda: [SimpleNamespace()])
        return places_of(0, photo, walls)


def test_turns_are_tried_until_a_place_is_clear(monkeypatch: pytest.MonkeyPatch) -> None:
    looks = Looks(leads={-90.0: (7.0,), 15.0: (9.0,)}, found={7.0: placed_at()})
    places = looks.of(bare_photo(), monkeypatch)
    assert [(place.lead, place.is_clear) for place in places] == [(7.0, True)]
    assert looks.turns == [(degrees, False) for degrees in placing._QUARTERS_DEG]
    assert (looks.closer, looks.patches) == ([], [7.0])


def test_of_places_in_all_other_turns_the_best_are_seen_closer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    turns = placing._OTHERS_DEG
    # Four in each of eight turns; unclear is what a quarter turn gives.
    leads = {turns[n]: tuple(5.0 + 0.01 * (4 * n + k) for k in range(4)) for n in range(8)}
    rough = sorted((lead for each in leads.values() for lead in each), reverse=True)
    looks = Looks(
        leads={0.0: (4.0,), **leads},
        found={4.0: placed_at(300.0, share=0.1), rough[11] + 100.0: placed_at()},
    )
    places = looks.of(bare_photo(), monkeypatch)
    assert looks.turns == [
        *((degrees, False) for degrees in placing._QUARTERS_DEG),
        *((degrees, True) for degrees in turns),
    ]
    assert looks.closer == rough[:24]
    assert looks.patches == [4.0, *(lead + 100.0 for lead in rough[:12])]
    # Those of before count, too.
    assert [(place.share, place.is_clear) for place in places] == [(0.3, True), (0.1, False)]


def test_exif_turns_a_photo_as_a_camera_held_so_turns_the_picture(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for orientation, degrees in enumerate((0.0, 0.0, 180.0, 180.0, 270.0, 270.0, 90.0, 90.0), 1):
        looks = Looks(leads={}, found={})
        shot = replace(bare_photo(), exif_orientation=orientation, exif_focal_px=840.0)
        assert looks.of(shot, monkeypatch) == []
        assert looks.turns == [(degrees, False)]


@pytest.mark.parametrize(
    ("shape", "laid", "tied"),
    [
        ((1200, 2400), (250, 500), (600, 1200)),
        ((1800, 900), (500, 250), (1200, 600)),
        ((300, 400), (300, 400), (300, 400)),
    ],
)
def test_a_photo_is_shrunk_to_what_is_needed_and_never_enlarged(
    monkeypatch: pytest.MonkeyPatch,
    shape: tuple[int, int],
    laid: tuple[int, int],
    tied: tuple[int, int],
) -> None:
    looks = Looks(leads={0.0: (7.0,)}, found={})
    encoded = encode_png(np.zeros((*shape, 3), dtype=np.uint8))
    photo = replace(
        bare_photo(), encoded=encoded, height=shape[0], width=shape[1], exif_focal_px=840.0
    )
    looks.of(photo, monkeypatch)
    assert looks.shapes == [(*laid, 3), (*tied, 3)]


def test_from_where_nine_parts_of_a_photo_lie_its_pose_follows() -> None:
    wall = ms.walls_of(ms.textured_wall(1)).walls[0]
    structure: Any = SimpleNamespace(wall=wall, usual_spread_m=0.001)
    middle = placing.turned(decode_image(usual_photo().encoded, "a.png"), 0.0)
    shares = np.array([[a, b] for b in (0.25, 0.5, 0.75) for a in (0.25, 0.5, 0.75)])
    rays = CAMERA.rays_world(middle.pixels_photo(shares))
    # Where the rays of the parts meet the wall's surface, by steps of Newton.
    frame = wall.frame
    reach = -(CAMERA.centre_world - frame.origin_world) @ frame.normal_world
    points = CAMERA.centre_world + (reach / (rays @ frame.normal_world))[:, None] * rays
    for _ in range(20):
        at = frame.wall_from_world(points)[:, :2] * frame.gsd_m
        depth = ms.textured_wall(1).depth_m(at[:, 0], at[:, 1])
        along = (reach + depth) / (rays @ frame.normal_world)
        points = CAMERA.centre_world + along[:, None] * rays
    place = Place(
        centre_m=at.mean(axis=0),
        width_m=float(2.0 * np.ptp(at[:, 0])),
        lead=9.0,
        parts_photo=shares,
        parts_m=at,
    )
    lens, _ = placing._lens_before(usual_photo())
    found = placing._camera_at(place, structure, lens, middle)
    assert found is not None
    assert np.linalg.norm(found.centre_world - CAMERA.centre_world) < 0.02
    np.testing.assert_allclose(found.rotation, CAMERA.rotation, atol=0.01)
    # Nine parts in one place determine nothing.
    nowhere = replace(
        place, parts_m=np.tile(at[:1], (9, 1)), parts_photo=np.tile([0.5, 0.5], (9, 1))
    )
    assert placing._camera_at(nowhere, structure, lens, middle) is None


@pytest.mark.parametrize("shift", [(0, 0), (2, -1), (-3, 3)], ids=str)
def test_patches_every_five_cells_are_found_where_they_went(shift: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(size=(60, 83, 5)).astype(np.float32)
    values = sum(np.roll(values, (i, j), (0, 1)) for i in (0, 1, 2) for j in (0, 1, 2))  # type: ignore[assignment]
    known = np.ones((60, 83), dtype=np.float32)
    moved = np.roll(values, shift[::-1], axis=(0, 1))
    found = placing._measured(
        Channels(values=values, known=known), Channels(values=moved, known=known), 4
    )
    # Up to the border of what is shown, but for what wraps around there.
    assert set(found.places[:, 0].tolist()) <= set(range(2, 83, 5))
    assert set(found.places[:, 1].tolist()) <= set(range(2, 60, 5))
    assert len(found.places) > 0.9 * 17 * 12
    inner = ((found.places > 12) & (found.places < np.array([70, 47]))).all(axis=1)
    assert inner.sum() > 60
    np.testing.assert_allclose(
        found.shift_cells[inner], np.tile(shift, (inner.sum(), 1)), atol=0.05
    )


def tied(
    monkeypatch: pytest.MonkeyPatch, counts: list[int], shift: float = 0.0
) -> tuple[Placed | None, list[int], Any]:
    """Tie a photo whose patches are found where its true camera shows them; so many each round."""
    wall = ms.walls_of(ms.textured_wall(1)).walls[0]
    rows, columns = wall.frame.shape
    structure: Any = SimpleNamespace(
        wall=wall,
        usual_spread_m=0.001,
        channels=Channels(
            values=np.zeros((rows, columns, 1), np.float32),
            known=np.ones((rows, columns), np.float32),
        ),
    )
    radii: list[int] = []

    def measured(own: Channels, other: Channels, radius: int) -> Displacements:
        radii.append(radius)
        at = np.argwhere(other.known > 0.0)[:, ::-1]
        places = at[:: max(1, len(at) // 400)][: counts[len(radii) - 1]]
        n = len(places)
        moved = np.full((n, 2), [shift, 0.0])
        return Displacements(
            places=places.astype(np.intp),
            shift_cells=moved,
            score=np.ones(n),
            sigma_cells=np.full(n, 0.1),
        )

    monkeypatch.setattr(placing, "_measured", measured)
    small = np.zeros((640, 900, 3), dtype=np.uint8)
    _, freedom = placing._lens_before(usual_photo())
    found = placing._tied((4, 7), small, (CAMERA, freedom), structure)
    return found, radii, structure


def test_a_pose_is_improved_in_four_rounds_of_smaller_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found, radii, structure = tied(monkeypatch, [300, 300, 300, 200])
    assert found is not None
    assert radii == [6, 4, 3, 3]
    assert (found.piece.photo, found.piece.wall) == (4, 7)
    # Nothing moved: the pose stays.
    assert np.linalg.norm(found.camera.centre_world - CAMERA.centre_world) < 1e-3
    (projection,) = placing.project_walls(CAMERA, [structure.wall])
    assert projection is not None
    in_photo = CAMERA.project(found.piece.points_world)[:, :2]
    np.testing.assert_allclose(found.piece.pixels_photo, in_photo, atol=0.2)
    np.testing.assert_allclose(found.piece.sigma_px, 0.5 * projection.pixels_per_cell, rtol=0.01)
    assert found.radius_px == pytest.approx(6.0 * projection.pixels_per_cell, rel=0.01)
    # Every fifth cell in both directions bears a patch.
    n_shown = np.isfinite(projection.u).sum()
    assert found.share == pytest.approx(len(found.piece) * 25 / n_shown, rel=0.05)
    assert not found.is_clear


@pytest.mark.parametrize(
    ("counts", "n_rounds"), [([7], 1), ([300, 7], 2), ([40, 40, 40, 7], 4), ([40, 40, 40, 8], 4)]
)
def test_eight_ties_are_needed_in_every_round(
    monkeypatch: pytest.MonkeyPatch, counts: list[int], n_rounds: int
) -> None:
    found, radii, _ = tied(monkeypatch, counts)
    assert (found is None) == (counts[-1] < 8)
    assert len(radii) == n_rounds
