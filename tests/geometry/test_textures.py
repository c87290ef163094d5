"""Paint of simulated surfaces: noise, stains, cracks and ornaments are as they are described."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.geometry import scene_rays
from orthoflow.geometry.scenes import TextureKind
from tests.long_loops import seeds

SEED = 7
# splitmix64 of seed 0: the first numbers of its reference implementation (Vigna 2015).
REFERENCE = (0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F)


def callable_from_python(name: str) -> Callable[..., Any]:
    """Parts of kernels have no way in from Python: give one that has."""
    part = getattr(scene_rays, name)

    @numba.njit
    def call(*arguments: Any) -> Any:
        return part(*arguments)

    return call  # type: ignore[no-any-return]


PARTS = (
    *("mixed_bits", "uniform", "cell_state", "_column_state", "_lattice_value", "_value_noise"),
    *("_stains", "_wear", "_motif", "_rosette", "_grain", "colour_at"),
)
tk = SimpleNamespace(**{name: callable_from_python(name) for name in PARTS})


@pytest.mark.parametrize("draw", seeds(3))
def test_numbers_are_those_of_splitmix64(draw: int) -> None:
    state = (draw + 1) * 0x9E3779B97F4A7C15 % 2**64
    assert int(tk.mixed_bits(np.uint64(state))) == REFERENCE[draw]
    assert tk.uniform(np.uint64(0), draw) == (REFERENCE[draw] >> 11) / 2**53


def test_cells_of_a_lattice_have_states_of_their_own() -> None:
    states = [
        int(tk.cell_state(i, j, s)) for i in range(-3, 4) for j in range(-3, 4) for s in (1, 2)
    ]
    assert len(set(states)) == len(states)
    for i, j in ((0, 0), (-2, 5), (3, -1)):
        value = tk._lattice_value(np.uint64(tk._column_state(i, SEED)), j)
        assert (value * 2**53) == int(tk.cell_state(i, j, SEED)) >> 11
        assert 0.0 <= value < 1.0


def lattice(i: int, j: int) -> float:
    """Number -1..1 of a lattice point."""
    return 2.0 * float(tk._lattice_value(np.uint64(tk._column_state(i, SEED)), j)) - 1.0


def noise(a: float, b: float, seed: int = SEED) -> float:
    return float(tk._value_noise(a, b, seed))


@pytest.mark.parametrize("i", [-2, 0, 3])
@pytest.mark.parametrize("j", [-1, 4])
def test_noise_is_smooth_between_the_numbers_of_its_lattice(i: int, j: int) -> None:
    corners = [[lattice(i + k, j + m) for m in (0, 1)] for k in (0, 1)]
    assert noise(i, j) == pytest.approx(corners[0][0])
    assert noise(i + 0.5, j + 0.5) == pytest.approx(np.mean(corners))
    # The quintic smoothstep 6 s^5 - 15 s^4 + 10 s^3 is 106 / 1024 at a quarter.
    s = 106.0 / 1024.0
    assert noise(i + 0.25, j) == pytest.approx((1 - s) * corners[0][0] + s * corners[1][0])
    assert noise(i, j + 0.25) == pytest.approx((1 - s) * corners[0][0] + s * corners[0][1])
    assert noise(i + 1, j + 0.75) == pytest.approx(s * corners[1][0] + (1 - s) * corners[1][1])
    # Neither slope nor bend at the lattice, from either side.
    for step in (-1e-3, 1e-3):
        assert noise(i + step, j) == pytest.approx(noise(i, j), abs=1e-7)
        assert noise(i, j + step) == pytest.approx(noise(i, j), abs=1e-7)


def test_stains_are_three_octaves_that_scale_with_their_period() -> None:
    octaves = (
        0.5 * noise(1.25, 0.5, SEED)
        + 0.3 * noise(2.7 * 1.25 + 7.3, 2.7 * 0.5 + 1.9, SEED + 1)
        + 0.2 * noise(6.1 * 1.25 + 3.1, 6.1 * 0.5 + 5.7, SEED + 2)
    )
    for period in (0.2, 1.0, 3.0):
        found = tk._stains(1.25 * period, 0.5 * period, period, SEED)
        assert found == pytest.approx(octaves)


def runs_of(mask: NDArray[np.bool_]) -> NDArray[np.intp]:
    """How long each run of true values is that neither end of a line cuts."""
    edges = np.flatnonzero(np.diff(mask.astype(np.int8)))
    first = 0 if not mask[0] else 1
    edges = edges[first:]
    return np.diff(edges)[::2]


def test_cracks_are_two_to_four_millimetres_wide_and_the_rest_is_grain_of_eleven() -> None:
    step = 1e-4
    along = np.arange(0.0, 12.0, step)
    wear = np.array([tk._wear(a, 0.41, SEED) for a in along])
    grain = 0.3 * np.array([noise(a / 0.011, 0.41 / 0.011) for a in along])
    darkened = grain - wear
    assert darkened.min() == pytest.approx(0.0, abs=1e-12)
    assert darkened.max() == pytest.approx(0.8, abs=0.02)
    # As wide as the dark half of their profile, where a line crosses them steeply.
    widths = step * runs_of(darkened > 0.4)
    assert len(widths) > 20
    assert 0.002 < 2.0 * np.quantile(widths, 0.25) < 0.004
    # They run where the noise of a lattice of 13 cm passes zero.
    cracks = np.array([noise(a / 0.13, 0.41 / 0.13, SEED + 1) for a in along[::40]])
    profile = 0.8 * np.maximum(0.0, 1.0 - abs(cracks) / 0.03)
    np.testing.assert_allclose(darkened[::40], profile, atol=1e-9)


def test_a_damask_repeats_to_the_bit_every_other_column_half_a_step_down() -> None:
    rng = np.random.default_rng(SEED)
    period = 0.5
    for a, b in rng.uniform(0.0, 4.0, (200, 2)):
        here = tk._motif(a, b, period)
        assert here in (0.0, 0.35, 0.6, 1.0)
        assert tk._motif(a + 2 * period, b, period) == here
        assert tk._motif(a, b + period, period) == here
        assert tk._motif(a + period, b + 0.5 * period, period) == here

    # A leaf about the middle with a vein, stripes where columns meet; the same left and right.
    def at(x: float, y: float) -> float:
        return float(tk._motif(0.5 * (x + 1.0), 0.5 * (y + 1.0), 1.0))

    assert [at(x, 0.0) for x in (0.0, 0.15, 0.17, 0.61, 0.63, 0.93, 0.95)] == [
        *(0.35, 0.35, 1.0, 1.0, 0.0, 0.0, 0.6),
    ]
    assert at(0.0, 0.4) == 0.35
    assert at(0.0, 0.5) == 1.0
    grid = np.linspace(-0.99, 0.99, 100)
    picture = np.array([[at(x, y) for x in grid] for y in grid])
    np.testing.assert_array_equal(picture, picture[:, ::-1])
    # At three quarters of the way up the waist of the leaf is a cosine of its own.
    for y in (1.0 / 3.0, -2.0 / 3.0):
        half = 0.62 * (1.0 - abs(y)) * (0.75 + 0.25 * np.cos(3.0 * np.pi * y))
        assert (at(half - 0.005, y) > 0.0, at(half + 0.005, y)) == (True, 0.0)


def test_rosettes_stand_in_a_lattice_of_lines_and_differ_from_cell_to_cell() -> None:
    period, n = 0.4, 200
    steps = (np.arange(n) + 0.5) / n
    hues = set()
    for i in range(-2, 3):
        cell = np.array(
            [
                [tk._rosette((i + x) * period, (1 + y) * period, period, SEED) for x in steps]
                for y in steps
            ]
        )
        paint, hue = cell[..., 0], cell[..., 1]
        assert set(np.unique(paint)) == {0.0, 1.0}
        assert ((hue >= 0.0) & (hue < 1.0)).all()
        # Lines of a fortieth of the period between cells: half of each in this one.
        from_edge = 0.5 - np.maximum(abs(steps[None] - 0.5), abs(steps[:, None] - 0.5))
        assert (paint[from_edge < 0.012] == 1.0).all()
        # A heart of the opposite hue within its flower, which is 22 to 36 hundredths in radius.
        state = np.uint64(tk.cell_state(i, 1, SEED))
        x = steps[None] - 0.5 - 0.12 * (tk.uniform(state, 0) - 0.5)
        y = steps[:, None] - 0.5 - 0.12 * (tk.uniform(state, 1) - 0.5)
        radius = np.hypot(x, y)
        outline = 0.22 + 0.14 * tk.uniform(state, 3)
        flower = tk.uniform(state, 5)
        heart = radius < 0.3 * outline
        np.testing.assert_allclose(hue[heart], (flower + 0.5) % 1.0)
        petals = ~heart & (radius < 0.40)
        assert set(hue[petals & (paint == 1.0)]) == {flower}
        assert (paint[(radius > outline) & (radius < 0.40)] == 0.0).all()
        assert (paint[~heart & (radius < 0.44 * outline)] == 1.0).all()
        # Three to seven petals, round its middle.
        turn = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
        ring = [
            tk._rosette(
                (i + 0.5 + 0.12 * (tk.uniform(state, 0) - 0.5) + 0.72 * outline * np.cos(t))
                * period,
                (1.5 + 0.12 * (tk.uniform(state, 1) - 0.5) + 0.72 * outline * np.sin(t)) * period,
                period,
                SEED,
            )[0]
            for t in turn
        ]
        n_petals = int((np.diff([*ring, ring[0]]) == 1.0).sum())
        assert n_petals == 3 + int(5.0 * tk.uniform(state, 2))
        # A ring about it in six of ten.
        is_ringed = tk.uniform(state, 6) > 0.4
        on_ring = abs(radius - 0.42) < 0.012
        off_ring = abs(radius - 0.42) > 0.013
        assert (hue[(from_edge < 0.012) & off_ring] == 0.08).all()
        inside = from_edge > 0.013
        assert (paint[on_ring & inside] == 1.0).all() == is_ringed
        beyond = off_ring & (radius > 0.37) & inside
        assert (paint[beyond] == 0.0).all()
        hues.add(flower)
    assert len(hues) == 5


def test_wood_has_four_waves_a_period_that_bend_slowly() -> None:
    period = 0.3
    along = np.linspace(0.0, 30 * period, 30 * 400)
    grain = np.array([tk._grain(a, 0.1, period, SEED) for a in along])
    assert 0.9 < abs(grain).max() <= 1.0
    rising = (grain[:-1] < 0.0) & (grain[1:] >= 0.0)
    assert rising.sum() == pytest.approx(4 * 30, abs=4)
    down = np.array([tk._grain(0.1, b, period, SEED) for b in along[:400]])
    assert abs(np.diff(down)).max() < 0.25 * abs(np.diff(grain)).max()
    # The wave itself, where its strength is one: sin of four turns and what bends it.
    for a, b in ((0.013, 0.2), (0.2, 0.7), (1.1, 0.05)):
        bend = 0.35 * noise(a / period, 0.25 * b / period)
        strength = 0.7 + 0.3 * noise(3.0 * a / period, 0.5 * b / period, SEED + 1)
        wave = np.sin(2.0 * np.pi * (4.0 * a / period + 2.0 * bend))
        assert tk._grain(a, b, period, SEED) == pytest.approx(wave * strength, abs=1e-9)


@pytest.mark.parametrize("kind", list(TextureKind))
def test_colours_stay_within_what_a_photo_and_a_laser_tell(kind: TextureKind) -> None:
    params = np.array([250.0, 5.0, 120.0, 0.9, 1.0, 0.2, 3.0, 0.5])
    places = np.random.default_rng(SEED).uniform(0.0, 2.0, (400, 2))
    shades = np.array([tk.colour_at(int(kind), params, a, b) for a, b in places])
    assert (shades[:, :3] >= 0.0).all()
    assert (shades[:, :3] <= 255.0).all()
    assert shades[:, 0].max() == 255.0
    assert (shades[:, 3] >= 0.01).all()
    assert (shades[:, 3] <= 1.0).all()
    # Without contrast nothing but the ground is left.
    plain = params * [1, 1, 1, 1, 0, 1, 1, 1]
    ground = np.array([tk.colour_at(int(kind), plain, a, b) for a, b in places])
    np.testing.assert_allclose(ground, np.tile([250.0, 5.0, 120.0, 0.9], (400, 1)))


@pytest.mark.parametrize("gap", [0.0, 1.0])
def test_light_is_seen_by_eye_and_laser_alike_unless_there_is_a_gap(gap: float) -> None:
    params = np.array([120.0, 120.0, 120.0, 0.5, 0.3, 0.2, 3.0, gap])
    places = np.random.default_rng(SEED).uniform(0.0, 20.0, (2000, 2))
    shades = np.array([tk.colour_at(0, params, a, b) for a, b in places])
    # Warmth takes from blue what it gives to red: their mean is the light alone.
    light = (shades[:, 0] + shades[:, 2]) / 2.0 / 120.0 - 1.0
    laser = shades[:, 3] / 0.5 - 1.0
    if gap == 0.0:
        np.testing.assert_allclose(laser, 0.9 * light, atol=1e-9)
    else:
        assert abs(np.corrcoef(light, laser)[0, 1]) < 0.5
    warm = (shades[:, 0] - shades[:, 2]) / 2.0
    np.testing.assert_allclose(shades[:, 1] / 120.0 - 1.0 - light, 0.3 * warm / 120.0, atol=1e-9)


def test_tiles_are_light_and_dark_in_turn_between_dark_joints() -> None:
    params = np.array([128.0, 128.0, 128.0, 0.5, 0.2, 0.5, 3.0, 0.0])

    def light(a: float, b: float) -> float:
        shade = tk.colour_at(3, params, a, b)
        return float((shade[0] + shade[2]) / 2.0 / 128.0 - 1.0) / 0.2

    middles = np.array(
        [[light(0.5 * (i + 0.5), 0.5 * (j + 0.5)) for j in range(6)] for i in range(6)]
    )
    is_light = (np.add.outer(np.arange(6), np.arange(6)) % 2) == 0
    assert middles[is_light].min() > middles[~is_light].max() + 0.3
    np.testing.assert_allclose(middles[is_light].mean(), 0.75, atol=0.15)
    np.testing.assert_allclose(middles[~is_light].mean(), -0.75, atol=0.35)
    wear = [tk._wear(0.5 * i + 0.004, 0.2, 3 + 50) for i in range(6)]
    joints = [light(0.5 * i + 0.004, 0.2) for i in range(6)]
    np.testing.assert_allclose(joints, -0.95 + np.array(wear), atol=1e-9)
    beside = [light(0.5 * i + 0.0065, 0.2) for i in range(6)]
    assert min(abs(np.array(beside) + 0.95)) > 0.01


def patterns(kind: int, a: float, b: float, period: float) -> tuple[float, float, float, float]:
    """Light and what the laser sees of it without wear, how much paint, and its hue."""
    light = float(tk._stains(a, b, period, SEED))
    warmth = 0.7 * noise((a + 11.0) / period, (b - 7.0) / period, SEED + 10)
    if kind == TextureKind.FRESCO:
        paint, hue = tk._rosette(a, b, 0.9 * period, SEED + 20)
        # Each hue is another paint to the laser.
        laser = 0.6 * warmth + paint * (1.6 * (3.7 * hue % 1.0) - 0.8)
        return 0.6 * light - paint * (0.35 + 0.5 * hue), laser, paint, hue
    if kind == TextureKind.TEXTILE:
        motif = tk._motif(a, b, period)
        # Light threads are dark to the laser.
        return 0.15 * light + 0.9 * motif - 0.4, 0.2 * warmth + 0.7 - 1.4 * motif, motif / 2, 0.13
    if kind == TextureKind.TILES:
        i, j = int(a // period), int(b // period)
        shade = float(tk.uniform(np.uint64(tk.cell_state(i, j, SEED + 30)), 0)) - 0.5
        tone = 0.75 * (-1) ** (i + j)
        middle = abs(np.array([a, b]) / period - [i + 0.5, j + 0.5]).max() < 0.488
        laser = 0.4 * warmth + 0.8 * shade
        return (0.25 * light + tone + 0.3 * shade if middle else -0.95), laser, 0.0, 0.0
    if kind == TextureKind.WOOD:
        grain = float(tk._grain(a, b, period, SEED + 40))
        return grain, 0.5 * grain + 0.5 * warmth, 0.0, 0.0
    return light, warmth, 0.0, 0.0


@pytest.mark.parametrize("kind", list(TextureKind))
def test_colours_are_those_of_the_ground_its_stains_and_its_ornaments(kind: TextureKind) -> None:
    period, contrast, gap = 0.21, 0.3, 0.4
    params = np.array([130.0, 120.0, 110.0, 0.5, contrast, period, SEED, gap])
    places = np.random.default_rng(SEED).uniform(-2.0, 2.0, (150, 2))
    painted = 0
    for a, b in places:
        light, laser, paint, hue = patterns(kind, a, b, period)
        wear = float(tk._wear(a, b, SEED + 50))
        warmth = 0.7 * noise((a + 11.0) / period, (b - 7.0) / period, SEED + 10)
        gain, shift = 1.0 + contrast * (light + wear), 22.0 * contrast * warmth
        ground = params[:3] * gain + shift * np.array([1.0, 0.3, -1.0])
        # Red, green and blue of a hue are a third of a turn apart.
        turns = 2.0 * np.pi * (hue + np.array([0.0, -1.0, 1.0]) / 3.0)
        ornament = np.array([120.0, 95.0, 90.0]) + [90.0, 80.0, 85.0] * np.cos(turns)
        share = 0.75 * paint * contrast
        seen = (1.0 - gap) * (light + wear) + gap * (laser + 0.5 * wear)
        expected = [*(ground + share * (ornament - ground)), 0.5 * (1.0 + 0.9 * contrast * seen)]
        np.testing.assert_allclose(tk.colour_at(int(kind), params, a, b), expected, atol=1e-6)
        painted += paint > 0.0
    assert (painted > 20) is (kind in (TextureKind.FRESCO, TextureKind.TEXTILE))
