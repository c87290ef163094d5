"""How tracing judges what it measured: neighbours, misfits, contents, and when it goes on."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import tracing
from orthoflow_plugins.match.displacements import Displacements
from orthoflow_plugins.match.tie_pieces import TiePiece
from orthoflow_plugins.match.tracing import Trace, TracingRule
from orthoflow_plugins.match.warping import Projection, View

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.lenses import unmeasured
from orthoflow.products import Intrinsics, Photo
from orthoflow.testing import photographed as ms
from tests import samples

RULE = TracingRule(
    radius_cells=16,
    half_patch_cells=8,
    score_least=0.5,
    distinct_least=0.1,
    n_ties_most=100,
    n_rounds_most=4,
    contents=tracing.CONTENTS,
)


def camera() -> ViewingCamera:
    return ms.camera_before(ms.photographed_scene())


def piece(
    n: int,
    *,
    seed: int = 0,
    wall: int = 0,
    noise_px: float = 0.3,
    wrong: tuple[int, ...] = (),
) -> TiePiece:
    """Ties of a camera with a wall with relief, some of them wrong by 40 px."""
    rng = np.random.default_rng(seed)
    places = rng.uniform([0.3, 0.3], [2.4, 1.7], (n, 2))
    scene = ms.photographed_scene()
    points = scene.frame.world_from_wall(
        places / scene.frame.gsd_m, scene.depth_m(places[:, 0], places[:, 1])
    )
    pixels = camera().project(points)[:, :2] + noise_px * rng.normal(size=(n, 2))
    pixels[list(wrong)] += 40.0
    return TiePiece(
        photo=0,
        wall=wall,
        pixels_photo=pixels,
        points_world=points,
        sigma_px=np.full(n, 0.3),
        sigma_m=np.full(n, 1e-4),
    )


def trace(
    *pieces: TiePiece,
    held_out_px: tuple[float, ...] = (1.0,),
    content: str = "grey",
    view: Any = None,
) -> Trace:
    return Trace(
        pieces=pieces,
        n_measured=100,
        n_outliers=0,
        held_out_px=held_out_px,
        content=content,
        view=view,
    )


def test_ties_of_all_walls_are_counted() -> None:
    assert trace(piece(5), piece(7)).n_ties == 12
    assert trace().n_ties == 0


@pytest.mark.parametrize(
    ("content", "n_ties", "is_doubtful"),
    [("grey", 25, False), ("grey", 24, True), ("gradients", 90, True)],
)
def test_edges_that_say_more_than_grey_or_few_ties_leave_doubts(
    content: str, n_ties: int, is_doubtful: bool
) -> None:
    assert tracing._is_doubtful(trace(piece(n_ties), content=content), RULE) is is_doubtful


def spread(n: int, sigma_px: float) -> TiePiece:
    """Ties on a square lattice of a known spread in both directions."""
    side = round(math.sqrt(n))
    rows, columns = np.divmod(np.arange(side * side), side)
    pixels = np.column_stack([columns, rows]).astype(np.float64)
    pixels *= sigma_px / pixels[:, 0].std(ddof=1)
    nothing = np.zeros((len(pixels), 3))
    return TiePiece(
        photo=0,
        wall=0,
        pixels_photo=pixels,
        points_world=nothing,
        sigma_px=nothing[:, 0],
        sigma_m=nothing[:, 0],
    )


def test_a_pose_is_promised_by_small_errors_many_ties_and_a_wide_spread() -> None:
    found = trace(spread(100, 50.0), held_out_px=(0.8, 0.5, 0.7))
    # The best round counts; the fourth root of the determinant is the spread of one coordinate.
    assert tracing._promised(found) == pytest.approx(0.5 / (10.0 * 50.0))
    assert tracing._promised(trace(spread(9, 50.0))) == math.inf
    assert tracing._promised(trace(spread(16, 50.0))) < math.inf
    # All in one place: a spread of one pixel at least.
    assert tracing._promised(trace(spread(16, 1e-9))) == pytest.approx(1.0 / 4.0)


def test_of_two_contents_the_more_promising_one_is_better() -> None:
    many, few = trace(spread(100, 50.0)), trace(spread(25, 50.0))
    assert tracing._is_better(many, few)
    assert not tracing._is_better(few, many)
    assert not tracing._is_better(many, many)
    # Without a refitted pose the number of ties decides.
    blind = trace(spread(25, 50.0), held_out_px=())
    assert tracing._is_better(many, blind)
    assert not tracing._is_better(blind, many)
    assert not tracing._is_better(blind, trace(spread(25, 50.0)))


def displacements(shifts: NDArray[np.float64]) -> Displacements:
    rows, columns = np.divmod(np.arange(len(shifts)), 5)
    return Displacements(
        places=np.column_stack([8 * columns, 8 * rows]).astype(np.intp),
        shift_cells=np.asarray(shifts, dtype=np.float64),
        score=np.ones(len(shifts)),
        sigma_cells=np.full(len(shifts), 0.1),
    )


def test_a_displacement_agrees_with_the_median_of_its_neighbours() -> None:
    shifts = np.tile([2.0, -1.0], (25, 1))
    shifts[12] += [0.5, 0.0]
    assert tracing.agrees_around(displacements(shifts)).all()
    shifts[12] += [0.2, 0.0]
    assert np.flatnonzero(~tracing.agrees_around(displacements(shifts))).tolist() == [12]
    shifts[12] = [2.0, -1.7]
    assert np.flatnonzero(~tracing.agrees_around(displacements(shifts))).tolist() == [12]


def test_where_neighbours_do_not_agree_nothing_is_believed() -> None:
    rng = np.random.default_rng(2)
    assert not tracing.agrees_around(displacements(rng.uniform(-20, 20, (25, 2)))).any()
    # A spread of half a cell lets more than a cell pass.
    loose = np.random.default_rng(3).uniform(-0.9, 0.9, (25, 2))
    assert tracing.agrees_around(displacements(loose)).sum() >= 24


def test_three_displacements_are_too_few_to_agree() -> None:
    assert not tracing.agrees_around(displacements(np.zeros((3, 2)))).any()
    assert tracing.agrees_around(displacements(np.zeros((4, 2)))).all()
    assert tracing.agrees_around(displacements(np.zeros((0, 2)))).shape == (0,)


def projection(
    *, pixels_per_cell: float = 2.0, rows: int = 20, columns: int = 30, first: int = 0
) -> Projection:
    """A wall whose cells lie side by side in the photo."""
    v, u = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    return Projection(
        part=(slice(first, first + rows), slice(0, columns)),
        u=(pixels_per_cell * u).astype(np.float32),
        v=(pixels_per_cell * v).astype(np.float32),
        distance=np.ones((rows, columns), dtype=np.float32),
        pixels_per_cell=pixels_per_cell,
    )


def test_a_part_of_the_photo_belongs_to_the_first_wall_that_takes_it() -> None:
    occupied: set[tuple[int, int]] = set()
    first = np.array([[1, 1], [11, 1]])
    np.testing.assert_array_equal(tracing._unoccupied(first, projection(), occupied), first)
    # Parts are five cells wide: ten pixels.
    assert occupied == {(0, 0), (2, 0)}
    later = np.array([[4, 4], [5, 4], [4, 5], [14, 0], [15, 0]])
    np.testing.assert_array_equal(
        tracing._unoccupied(later, projection(), occupied), later[[1, 2, 4]]
    )


def test_a_wall_is_as_large_as_the_pixels_that_show_it() -> None:
    shown = projection()
    shown.u[:5] = np.nan
    assert tracing._footprint(shown) == 15 * 30 * 4
    assert tracing._footprint(None) == 0


def test_values_between_cells_are_bilinear_and_unknown_beyond_them() -> None:
    raster = np.array([[0.0, 1.0, 2.0], [10.0, 11.0, 12.0], [20.0, 21.0, np.nan]], np.float32)
    at = np.array([[0.25, 0.5], [1.0, 0.0], [0.0, 0.75], [1.5, 0.5]])
    np.testing.assert_allclose(tracing.between(raster, at), [5.25, 1.0, 7.5, 6.5])
    beside = np.array([[-0.1, 0.5], [0.5, -0.1], [2.0, 0.5], [0.5, 2.0], [1.5, 1.5]])
    assert np.isnan(tracing.between(raster, beside)).all()
    product = np.array([[0.0, 0.0], [0.0, 8.0]], np.float32)
    np.testing.assert_allclose(tracing.between(product, np.array([[0.5, 0.25]])), [1.0])


def test_pieces_are_joined_in_their_order() -> None:
    one, other = piece(3, seed=1), piece(2, seed=2)
    seen = tracing._joined([one, other])
    np.testing.assert_array_equal(seen.pixels_photo[3:], other.pixels_photo)
    np.testing.assert_array_equal(seen.points_world[:3], one.points_world)
    assert (seen.sigma_px.tolist(), len(seen)) == ([0.3] * 5, 5)
    assert len(tracing._joined([])) == 0


def test_what_lies_three_and_a_half_deviations_off_is_no_longer_believed() -> None:
    # Lengths of normal residuals in a plane have a median of 1.1774 deviations.
    assert tracing._limit(np.array([1.0, 1.1774, 9.0])) == pytest.approx(3.5)


def test_ties_that_fit_no_common_pose_are_left_out_of_their_pieces() -> None:
    pieces = [piece(40, seed=1, wrong=(3, 17)), piece(30, seed=2, wall=1, wrong=(29,))]
    cleaned = tracing._without_misfits(pieces, camera())
    assert [len(each) for each in cleaned] == [38, 29]
    assert [each.wall for each in cleaned] == [0, 1]
    np.testing.assert_array_equal(cleaned[1].pixels_photo, pieces[1].pixels_photo[:29])


def test_too_few_ties_are_left_as_they_are() -> None:
    pieces = [piece(11, wrong=(3,))]
    assert tracing._without_misfits(pieces, camera()) is pieces
    assert [len(each) for each in tracing._without_misfits([piece(12)], camera())] == [12]


@pytest.mark.parametrize("noise_px", [0.2, 1.0])
def test_the_ties_held_out_tell_the_error_of_a_coordinate(noise_px: float) -> None:
    found = tracing._refitted(
        tracing._joined([piece(400, noise_px=noise_px, wrong=(7, 100))]), camera()
    )
    assert found is not None
    # Those beyond three medians are left out; they are less than a thousandth of the others.
    assert found.held_out_px == pytest.approx(noise_px, rel=0.15)
    assert ms.wall_error_m(ms.photographed_scene(), found.camera, camera()) < 0.002


def test_of_eleven_ties_no_pose_is_refitted() -> None:
    assert tracing._refitted(tracing._joined([piece(11)]), camera()) is None
    assert tracing._refitted(tracing._joined([piece(40)]), camera()) is not None


def test_a_lens_that_was_only_estimated_is_refitted_where_ties_ask_for_it() -> None:
    """Held, it makes ties that contradict it look wrong, and what is left agrees with it."""
    pieces, freedom = [piece(200, seed=4, noise_px=0.1)], unmeasured(900, has_exif=False)
    seen, rough = tracing._joined(pieces), replace(camera(), distortion=np.zeros(5))
    held = tracing._refitted(seen, rough)
    found = tracing._refitted(seen, rough, (freedom, rough))
    assert held is not None
    assert held.free is None
    assert found is not None
    assert found.free == (freedom, rough)
    assert held.held_out_px > 3.0 * found.held_out_px
    assert found.camera.distortion[0] == pytest.approx(camera().distortion[0], abs=0.01)
    kept = [
        sum(map(len, tracing._without_misfits(pieces, rough, free))) for free in (None, found.free)
    ]
    assert kept[0] < kept[1] == 200
    right = tracing._refitted(seen, camera(), (freedom, camera()))
    assert right is not None
    assert right.free is None


@pytest.mark.parametrize(
    ("source", "exif_px", "is_calibrated", "focal_sigma"),
    [
        ("estimated", None, False, 0.35),
        ("estimated", 840.0, False, 0.05),
        ("estimated", None, True, None),
        ("calibration", None, False, None),
    ],
)
def test_only_a_lens_that_was_estimated_may_be_off(
    source: str, exif_px: float | None, is_calibrated: bool, focal_sigma: float | None
) -> None:
    own = Intrinsics.of(camera(), source=source)
    photo = Photo(
        name="a.png",
        encoded=b"",
        width=900,
        height=640,
        exif_focal_px=exif_px,
        intrinsics=own if is_calibrated else None,
    )
    found = tracing.estimated_lens(photo, own)
    assert (None if found is None else found.focal_sigma) == focal_sigma
    assert tracing.estimated_lens(photo, None) is None


def rounds(*found: TiePiece) -> Any:
    """What is measured in each round, and how often and how it was asked for."""
    asked: list[int] = []

    def measured(view: object, targets: object, how: tuple[TracingRule, int, str]) -> object:
        asked.append(how[1])
        each = found[len(asked) - 1]
        return tracing._Round(pieces=[each], n_measured=len(each) + 5, n_outliers=5)

    measured.asked = asked  # type: ignore[attr-defined]
    return measured


class Turned(View):
    """A view that is never projected anew."""

    def posed(self, camera: ViewingCamera, walls: object) -> View:
        return Turned(
            index=0,
            grey=self.grey,
            colours=self.colours,
            camera=camera,
            projections=self.projections,
        )


def view() -> View:
    grey = np.zeros((2, 2), dtype=np.uint8)
    nudged = ms.nudged(camera(), (0.0, 0.0, 0.0, 0.05, 0.0, 0.0))
    return Turned(
        index=0,
        grey=grey,
        colours=lambda: np.dstack([grey] * 3),
        camera=nudged,
        projections=[projection(pixels_per_cell=1.0)],
    )


def test_rounds_halve_their_radius_until_held_out_ties_stop_improving(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    measured = rounds(
        *(piece(100, seed=3, noise_px=noise_px) for noise_px in (2.0, 1.0, 0.99, 0.5))
    )
    monkeypatch.setattr(tracing, "_measured", measured)
    # Poses keep moving, so that the error alone decides.
    monkeypatch.setattr(tracing, "_moved_cells", lambda *_: 5.0)
    found = tracing._traced((view(), 16), [], RULE, "grey")
    assert measured.asked == [16, 8, 4]
    assert len(found.held_out_px) == 3
    assert found.held_out_px[1] < 0.6 * found.held_out_px[0]
    # The third was better by less than a thirtieth: it is kept, but nothing follows it.
    assert found.n_measured == 105
    assert found.n_outliers == 105 - found.n_ties
    np.testing.assert_array_equal(
        found.pieces[0].pixels_photo[0], piece(100, seed=3, noise_px=0.99).pixels_photo[0]
    )


def test_no_radius_is_below_two_and_no_round_beyond_the_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    measured = rounds(*(piece(100, seed=3, noise_px=8.0 / 2**k) for k in range(5)))
    monkeypatch.setattr(tracing, "_measured", measured)
    monkeypatch.setattr(tracing, "_moved_cells", lambda *_: 5.0)
    tracing._traced((view(), 6), [], RULE, "grey")
    assert measured.asked == [6, 3, 2, 2]


def test_a_pose_that_settled_is_not_measured_again(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = rounds(*(piece(100, seed=3, noise_px=8.0 / 2**k) for k in range(5)))
    monkeypatch.setattr(tracing, "_measured", measured)
    moved = iter([0.31, 0.29])
    monkeypatch.setattr(tracing, "_moved_cells", lambda *_: next(moved))
    assert len(tracing._traced((view(), 16), [], RULE, "grey").held_out_px) == 2


def test_a_round_that_finds_too_little_does_not_spoil_the_one_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tracing, "_measured", rounds(piece(100, seed=3), piece(5)))
    monkeypatch.setattr(tracing, "_moved_cells", lambda *_: 5.0)
    found = tracing._traced((view(), 16), [], RULE, "grey")
    assert (found.n_measured, len(found.held_out_px)) == (105, 1)
    monkeypatch.setattr(tracing, "_measured", rounds(piece(5)))
    alone = tracing._traced((view(), 16), [], RULE, "grey")
    assert (alone.n_ties, alone.n_outliers, alone.held_out_px) == (5, 5, ())


def test_a_photo_moves_on_a_wall_by_pixels_over_pixels_per_cell() -> None:
    found = tracing._Round(pieces=[piece(50)], n_measured=50, n_outliers=0)
    for pixels_per_cell in (1.0, 4.0):
        laid = SimpleNamespace(
            camera=camera(), projections=[projection(pixels_per_cell=pixels_per_cell)]
        )
        shifted = ms.nudged(camera(), (0.0, 0.0, 0.0, 0.01, 0.0, 0.0))
        pixels = [each.project(found.pieces[0].points_world)[:, :2] for each in (camera(), shifted)]
        rms_px = math.sqrt(((pixels[1] - pixels[0]) ** 2).sum(axis=1).mean())
        moved = tracing._moved_cells(found, laid, shifted)  # type: ignore[arg-type]
        assert moved == pytest.approx(rms_px / pixels_per_cell)
        assert rms_px > 1.0


@pytest.mark.parametrize(
    ("n_grey", "tried"),
    [(60, ["gradients", "grey"]), (20, ["gradients", "grey", "colours"])],
)
def test_colours_are_compared_only_where_grey_leaves_doubts(
    monkeypatch: pytest.MonkeyPatch, n_grey: int, tried: list[str]
) -> None:
    asked = []

    def traced(start: tuple[Any, int], *how: Any) -> Trace:
        content = how[2]
        asked.append((content, start))
        each = spread(9 if content == "gradients" else n_grey, 50.0)
        return trace(each, content=content, view=content)

    monkeypatch.setattr(tracing, "_traced", traced)
    monkeypatch.setattr(tracing, "view_of", lambda *_: "first")
    found = tracing.trace_photo(0, None, None, [], RULE)  # type: ignore[arg-type]
    assert [content for content, _ in asked] == tried
    # The first starts from the pose given, later ones from the best so far, near it.
    assert [start for _, start in asked] == [("first", 16), ("gradients", 2), ("grey", 2)][
        : len(tried)
    ]
    assert found.content == "grey"


def test_ties_that_determine_no_pose_are_left_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise GeometryError("nothing is determined")

    monkeypatch.setattr(tracing, "fitted_pose", fail)
    pieces = [piece(40, wrong=(3,))]
    assert tracing._without_misfits(pieces, camera()) is pieces
    assert tracing._refitted(tracing._joined(pieces), camera()) is None


def test_ties_lie_where_patches_went_and_are_as_exact_as_the_measured_cells_of_their_grain() -> (
    None
):
    frame = samples.facing_south(0.01, 30, 25)
    wall = samples.wall(frame, sigma_m=np.full((25, 30), 0.001, dtype=np.float32))
    # Where there is no depth, and where it is known to three cells only.
    wall.depth_m[5 + 9, 9] = np.nan
    wall.sigma_m[5 + 12, 12], wall.count[5 + 12, 12] = 0.06, 4
    places = np.array([[3, 4], [20, 10], [9, 9], [12, 12], [28, 3]])
    moved = Displacements(
        places=places.astype(np.intp),
        shift_cells=np.array([[0.25, -0.5], [1.5, 2.0], [0, 0], [0, 0], [1.5, 0.0]]),
        score=np.ones(5),
        sigma_cells=np.full(5, 0.3),
    )
    grain = np.ones((20, 30), dtype=np.float32)
    grain[10, 20] = 9.0
    found = tracing._piece(4, 7, wall, (moved, projection(first=5)), grain)
    assert (found.photo, found.wall) == (4, 7)
    # Beyond the last column nothing is shown.
    np.testing.assert_allclose(found.pixels_photo, [[6.5, 7.0], [43.0, 24.0]])
    cells = np.array([[3.5, 9.5], [20.5, 15.5]])
    np.testing.assert_allclose(found.points_world, frame.world_from_wall(cells), atol=1e-9)
    # Residuals agree over six cells, and over eight more where nine share one.
    sigma_cells = [math.hypot(0.3, 0.1), math.hypot(0.3 * math.sqrt(14.0 / 6.0), 0.1)]
    np.testing.assert_allclose(found.sigma_px, 2.0 * np.array(sigma_cells))


def test_walls_share_the_ties_of_a_photo_by_their_size_in_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(5)
    known = (rng.random((60, 60)) < 0.8).astype(np.float32)

    def target(grey: object = 1) -> Any:
        channels = SimpleNamespace(part=lambda part: SimpleNamespace(known=known[part]))
        return SimpleNamespace(
            grey=grey,
            wall=None,
            prepare=lambda content, half: asked.append((content, half)),
            channels={"grey": channels},
            textures={"grey": known},
            grains={RULE.half_patch_cells: known},
        )

    asked: list[Any] = []
    # 400, 2400, none, 2400 without a picture, 20 pixels of a photo.
    projections = [
        projection(rows=10, columns=10), projection(), None, projection(first=20),
        projection(rows=1, columns=5),
    ]  # fmt: skip
    projections[1].u[3, 4] = np.nan  # type: ignore[union-attr]
    targets = [target(), target(), target(), target(None), target()]
    wanted: list[int] = []
    n_measured: list[int] = []

    def textured(_strength: object, usable: NDArray[np.bool_], n_most: int) -> NDArray[np.intp]:
        wanted.append(n_most)
        return np.argwhere(usable)[:n_most:7, ::-1].astype(np.intp)

    def measure(_one: object, _other: object, places: Any, rule: TracingRule) -> Displacements:
        assert rule.radius_cells == 3
        n = len(places)
        n_measured.append(n)
        moved = Displacements(
            places=places, shift_cells=np.zeros((n, 2)), score=np.ones(n), sigma_cells=np.ones(n)
        )
        # One of them agrees with nobody.
        moved.shift_cells[:1] = 9.0
        return moved

    monkeypatch.setattr(tracing, "textured_places", textured)
    monkeypatch.setattr(tracing, "measure", measure)
    monkeypatch.setattr(tracing, "_seen", lambda *_: None)
    made: list[Any] = []

    def piece_of(photo: int, index: int, _wall: object, found: Any, _grain: object) -> Any:
        made.append((photo, index, found[0]))
        return piece(max(1, len(found[0].places)), wall=index)

    monkeypatch.setattr(tracing, "_piece", piece_of)
    view: Any = SimpleNamespace(index=6, projections=projections)
    found = tracing._measured(view, targets, (RULE, 3, "colours"))
    # The largest first; whichever is small is asked for fifty.
    assert [(photo, index) for photo, index, _ in made] == [(6, 1), (6, 0), (6, 4)]
    n_pixels = 400 + (2400 - 4) + 2400 + 20
    assert wanted == [max(50, round(100 * (2400 - 4) / n_pixels)), 50, 50]
    assert asked == [("grey", RULE.half_patch_cells)] * 3
    assert [each.wall for each in found.pieces] == [0, 1, 4]
    for (_, _, moved), shown in zip(made, (projections[1], projections[0]), strict=False):
        at = tuple(moved.places.T[::-1])
        assert known[shown.part][at].all()  # type: ignore[union-attr]
        assert np.isfinite(shown.u[at]).all()  # type: ignore[union-attr]
        assert not (moved.shift_cells == 9.0).any()
    assert found.n_measured == sum(n_measured)
    assert found.n_outliers == found.n_measured - sum(len(each) for each in found.pieces)
