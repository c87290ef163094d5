"""Parts of pictures that are compared, and how far they lie off each other."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect import patches
from orthoflow_plugins.inspect.patches import PATCH_CELLS, GreyImage
from scipy.ndimage import gaussian_filter, shift

ROWS, COLUMNS = 9, 12


def picture() -> GreyImage:
    rng = np.random.default_rng(2)
    valid = rng.random((ROWS, COLUMNS)) < 0.7
    return GreyImage(grey=rng.uniform(1.0, 255.0, valid.shape), valid=valid, region=valid)


@pytest.mark.parametrize("corner", [(3, 2), (-2, -3), (9, 6), (-1, 7), (20, 20)], ids=str)
def test_a_square_is_cut_and_is_not_valid_beyond_the_border(corner: tuple[int, int]) -> None:
    whole, side = picture(), 5
    part = whole.square(np.array(corner), side)
    for row in range(side):
        for column in range(side):
            v, u = corner[1] + row, corner[0] + column
            inside = 0 <= v < ROWS and 0 <= u < COLUMNS
            assert part.grey[row, column] == (whole.grey[v, u] if inside else 0.0)
            assert part.valid[row, column] == (inside and whole.valid[v, u])
    np.testing.assert_array_equal(part.region, part.valid)


def texture(seed: int = 1, side: int = 130) -> NDArray[np.float64]:
    smooth = gaussian_filter(np.random.default_rng(seed).normal(size=(side, side)), 1.5)
    return np.asarray(128.0 + 30.0 * smooth / smooth.std())


def image(grey: NDArray[np.float64], valid: NDArray[np.bool_] | None = None) -> GreyImage:
    everywhere = np.ones(grey.shape, dtype=np.bool_)
    return GreyImage(grey=grey, valid=everywhere if valid is None else valid, region=everywhere)


def moved(grey: NDArray[np.float64], right: float, down: float) -> NDArray[np.float64]:
    return np.asarray(shift(grey, (down, right), order=3, mode="nearest"))


def test_the_fullest_tile_is_the_one_with_most_cells_that_count() -> None:
    valid = np.zeros((5, 7), dtype=np.bool_)
    valid[3:, 4:6] = True
    valid[0, :2] = True
    grey = np.arange(35.0).reshape(5, 7)
    part = image(grey, valid).fullest_part(3)
    np.testing.assert_array_equal(part.grey, grey[3:, 3:6])
    np.testing.assert_array_equal(part.valid, valid[3:, 3:6])
    assert image(grey, valid).fullest_part(7).grey.shape == (5, 7)


@pytest.mark.parametrize("apart", [(0.0, 0.0), (1.3, -2.6), (-3.0, 3.75), (5.0, -5.0), (-5.0, 5.0)])
def test_a_displacement_is_measured_in_every_whole_patch(apart: tuple[float, float]) -> None:
    true = texture()
    found = patches.measure_shifts(image(moved(true, *apart)), image(true), reach_cells=5)
    # Four by four patches of 32 cells in 130; two cells are left over.
    centres = [[32 * c + 16.0, 32 * r + 16.0] for r in range(4) for c in range(4)]
    assert found.centre.tolist() == centres
    np.testing.assert_allclose(found.shift, np.tile(apart, (16, 1)), atol=0.03)
    assert (np.abs(found.found - apart) <= 0.51).all()
    assert (found.sigma < 0.15).all()
    assert (found.correlation > 0.98).all()


def test_a_brighter_image_is_displaced_alike() -> None:
    true = texture()
    found = patches.measure_shifts(image(moved(true, 0.4, 0.0) + 12.0), image(true), reach_cells=2)
    np.testing.assert_allclose(found.shift.mean(axis=0), [0.4, 0.0], atol=0.02)


@pytest.mark.parametrize(("n_columns", "is_measured"), [(13, True), (6, False)])
def test_three_tenths_of_a_patch_must_count(n_columns: int, is_measured: bool) -> None:
    valid = np.zeros((130, 130), dtype=np.bool_)
    valid[:32, :n_columns] = True
    true = texture()
    found = patches.measure_shifts(image(true, valid), image(true), reach_cells=1)
    assert len(found.centre) == int(is_measured)


def test_patches_without_texture_in_both_directions_are_left_out() -> None:
    noises = 4.0 * np.random.default_rng(3).normal(size=(2, 64, 64))
    stripes = np.tile(128.0 + 40.0 * np.sin(np.arange(64) / 2.0), (64, 1))
    for grey in (np.full((64, 64), 128.0), stripes):
        one, other = (image(grey + noise) for noise in noises)
        assert len(patches.measure_shifts(one, other, reach_cells=2).centre) == 0


def test_what_strays_by_two_cells_from_its_start_is_left_out() -> None:
    true = texture()
    start = patches.unrefined(
        np.array([[40.0, 40.0], [80.0, 40.0]]), np.array([[1.0, 0.0], [6.0, 0.0]])
    )
    found = patches.refine_shifts(
        image(moved(true, 1.8, 0.0)), image(true), start, sigma_most_cells=0.5
    )
    assert found.centre.tolist() == [[40.0, 40.0]]
    np.testing.assert_allclose(found.shift, [[1.8, 0.0]], atol=0.03)
    np.testing.assert_array_equal(found.found, [[1.0, 0.0]])
    noisy = image(true + np.random.default_rng(6).normal(size=true.shape))
    none = patches.refine_shifts(noisy, image(true), start, sigma_most_cells=1e-4)
    assert len(none.centre) == 0
    empty = patches.unrefined(np.zeros((0, 2)), np.zeros((0, 2)))
    assert patches.refine_shifts(image(true), image(true), empty, sigma_most_cells=1.0) is empty


def test_cells_are_counted_in_whole_patches() -> None:
    mask = np.zeros((70, 100), dtype=np.bool_)
    mask[31:33, 63:65] = True
    mask[64:], mask[:, 96:] = True, True
    assert patches._patch_counts(mask).tolist() == [[0, 1, 1], [0, 1, 1]]


def test_windows_have_their_rim_around_them() -> None:
    values = np.arange(70 * 70).reshape(70, 70)
    row, column = np.array([0, 1]), np.array([1, 0])
    windows = patches._windows(values, row, column, 3)
    assert windows.shape == (2, 38, 38)
    np.testing.assert_array_equal(windows[0], values[:38, 32:70])
    np.testing.assert_array_equal(windows[1], values[32:70, :38])


@pytest.mark.parametrize("part", [0.0, 0.25, 0.8])
def test_spline_weights_keep_straight_lines_and_their_slopes(part: float) -> None:
    value, slope = patches._spline_weights(np.array([part]))[:, 0]
    at = np.array([-1.0, 0.0, 1.0, 2.0])
    assert value.sum() == pytest.approx(1.0)
    assert value @ at == pytest.approx(part)
    assert slope.sum() == pytest.approx(0.0, abs=1e-12)
    assert slope @ at == pytest.approx(1.0)
    # The slope is the derivative of the value.
    step = 1e-6
    after = patches._spline_weights(np.array([part + step]))[0, 0]
    np.testing.assert_allclose(slope, (after - value) / step, atol=1e-5)


def test_patches_correlate_by_their_weights() -> None:
    rng = np.random.default_rng(5)
    first, second = rng.normal(size=(2, 3, 50))
    weight = np.ones((3, 50))
    weight[1, 25:] = 0.0
    second[1, :25] = 5.0 - 2.0 * first[1, :25]
    second[2] = 3.0 * first[2] + 1.0
    found = patches._correlations(first, second, weight)
    assert found[0] == pytest.approx(np.corrcoef(first[0], second[0])[0, 1])
    np.testing.assert_allclose(found[1:], [-1.0, 1.0], atol=1e-9)


def test_smoothing_leaves_rims_out_and_holes_do_no_harm() -> None:
    grey = np.tile(np.arange(40.0), (40, 1))
    valid = np.ones((40, 40), dtype=np.bool_)
    valid[20, 20] = False
    region = np.ones((40, 40), dtype=np.bool_)
    region[:, 30:] = False
    smooth = patches._smoothed(GreyImage(grey=grey, valid=valid & region, region=region))
    # A ramp stays one inside; the cell beside the rim leans over it.
    np.testing.assert_allclose(smooth.grey[10, 5:25], grey[10, 5:25], atol=1e-6)
    assert smooth.grey[20, 21] == pytest.approx(21.0, abs=0.2)
    assert not smooth.valid[20, 20]
    assert smooth.valid[20, 19]
    assert smooth.valid[10, 28]
    assert not smooth.valid[10, 29:].any()


@pytest.mark.parametrize(
    ("steps", "moved_by"),
    [
        ([0.5, 0.0021, 0.0019, 0.1], 0.504),  # the first of at most 0.002 is the last
        ([0.8, 0.001], 0.501),  # half a cell at most is moved at once
        ([0.0099] * 12, 12 * 0.0099),  # hardly converged
        ([0.0101] * 12, None),  # not converged
        ([0.5] * 3 + [0.49, 0.0], 1.99),
        ([0.5] * 4 + [0.0], None),  # two cells from its start
    ],
    ids=str,
)
def test_least_squares_move_until_they_hardly_do(
    steps: list[float], moved_by: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = iter(steps)

    def step(_design: object, rest: NDArray[np.float64], _weight: object) -> object:
        n = len(rest)
        return np.tile([next(left), 0.0], (n, 1)), np.full((n, 2), 0.01)

    monkeypatch.setattr(patches, "_normal_step", step)
    start = patches.unrefined(np.array([[64.0, 64.0]]), np.array([[1.0, 2.0]]))
    found = patches.refine_shifts(image(texture()), image(texture()), start, sigma_most_cells=0.5)
    expected = [] if moved_by is None else [[1.0 + moved_by, 2.0]]
    np.testing.assert_allclose(found.shift, np.reshape(expected, (-1, 2)), atol=1e-12)


@pytest.mark.parametrize("corner", [(-1, 3), (0, 0), (7, 8), (8, 7), (40, -40)])
def test_a_cell_between_others_is_valid_where_all_four_are_there(corner: tuple[int, int]) -> None:
    shape = (PATCH_CELLS + 8, PATCH_CELLS + 8)
    valid = np.ones(shape, dtype=np.bool_)
    valid[20, 13] = False
    image = GreyImage(grey=np.zeros(shape), valid=valid, region=valid)
    _, found = patches._Sampler(image)._windows(np.array([corner]))
    padded = np.pad(valid, 100)
    places = 100 + np.array(corner)[:, None] + np.arange(PATCH_CELLS)
    expected = np.ones((PATCH_CELLS, PATCH_CELLS), dtype=np.bool_)
    for down in (0, 1):
        for right in (0, 1):
            expected &= padded[np.ix_(places[0] + down, places[1] + right)]
    np.testing.assert_array_equal(found[0], expected)


@pytest.mark.parametrize(("n_columns", "is_valid"), [(1, True), (0, False)])
def test_a_lone_line_of_cells_can_be_smoothed_and_a_lone_cell_cannot(
    n_columns: int, is_valid: bool
) -> None:
    """Of what a Gaussian of one cell looks at, a line holds 0.4 and a cell 0.16."""
    valid = np.zeros((30, 30), dtype=np.bool_)
    valid[15, 15] = True
    valid[:, 15 : 15 + n_columns] = True
    smooth = patches._smoothed(image(np.full((30, 30), 90.0), valid))
    assert smooth.valid[15, 15] == is_valid
    assert smooth.grey[15, 15] == pytest.approx(90.0)


@pytest.mark.parametrize("n_cells", [900, 40])
def test_steps_are_least_squares_and_as_exact_as_smoothed_noise_lets_them_be(n_cells: int) -> None:
    rng = np.random.default_rng(8)
    design, rest = rng.normal(size=(2, n_cells, 3)), rng.normal(size=(2, n_cells))
    weight = np.ones((2, n_cells))
    weight[1, ::2] = 0.0
    step, sigma = patches._normal_step(design, rest, weight)
    # Noise that was smoothed by a Gaussian of one cell: so many cells are one observation.
    kernel = gaussian_filter(np.pad([[1.0]], 12), 1.0, mode="constant")
    per_sample = kernel.sum() ** 2 / (kernel**2).sum()
    for k, used in enumerate((slice(None), slice(1, None, 2))):
        rows, values = design[k, used], rest[k, used]
        expected = np.linalg.lstsq(rows, values, rcond=None)[0]
        np.testing.assert_allclose(step[k], expected[:2], rtol=1e-6)
        squares = ((values - rows @ expected) ** 2).sum()
        n_free = max(len(rows) / per_sample - 3.0, 1.0)
        variances = squares / n_free * np.diag(np.linalg.inv(rows.T @ rows))
        np.testing.assert_allclose(sigma[k], np.sqrt(variances[:2]), rtol=1e-3)


@pytest.mark.parametrize(("sigma_cells", "n_found"), [(0.14, 16), (0.16, 0)])
def test_a_patch_must_be_measured_to_a_seventh_of_a_cell(
    sigma_cells: float, n_found: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def step(_design: object, rest: NDArray[np.float64], _weight: object) -> object:
        return np.zeros((len(rest), 2)), np.tile([0.01, sigma_cells], (len(rest), 1))

    monkeypatch.setattr(patches, "_normal_step", step)
    found = patches.measure_shifts(image(texture()), image(texture()), reach_cells=1)
    assert len(found.centre) == n_found


def test_cells_about_the_middle_count_most_where_a_width_is_asked_for() -> None:
    centre = np.array([[40.0, 50.0]])
    cut = patches._cut_patches(image(texture()), centre, focus_cells=5.0)
    assert (cut.rows.min(), cut.rows.max()) == (34.0, 65.0)
    assert (cut.columns.min(), cut.columns.max()) == (24.0, 55.0)
    # The middles of cells about the corner of four.
    away = np.hypot(cut.rows + 0.5 - 50.0, cut.columns + 0.5 - 40.0)
    np.testing.assert_allclose(cut.weight, np.exp(-(away**2) / 50.0))
    assert (patches._cut_patches(image(texture()), centre).weight == 1.0).all()


def test_an_intensity_is_grey_by_itself_or_by_its_roots() -> None:
    intensity = np.array([[0.0, 0.25, 1.0, np.nan]], dtype=np.float32)
    for of_roots, expected in ((False, [0.0, 63.75, 255.0, 0.0]), (True, [0.0, 127.5, 255.0, 0.0])):
        grey = patches.IntensityGrey(intensity=intensity, of_roots=of_roots).whole()
        np.testing.assert_allclose(grey.grey[0], expected)
        assert grey.valid[0].tolist() == grey.region[0].tolist() == [True, True, True, False]
    assert not patches.IntensityGrey(intensity=intensity).of_roots


def test_patches_of_some_rows_are_counted_from_the_first_of_these() -> None:
    rows = np.array([2.9, 3.0, 6.9, 7.0])
    all_of = patches.unrefined(np.column_stack([np.arange(4.0), rows]), np.ones((4, 2)))
    some = all_of.within(slice(3, 7))
    np.testing.assert_allclose(some.centre, [[1.0, 0.0], [2.0, 3.9]])
    np.testing.assert_allclose(all_of.within(slice(3, None)).centre[:, 1], [0.0, 3.9, 4.0])
    np.testing.assert_array_equal(all_of.within(slice(None)).centre, all_of.centre)
