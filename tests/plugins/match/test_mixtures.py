"""Photos whose grey is not what the laser sees are found in mixtures of their colours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import mixtures
from orthoflow_plugins.match.features import Features
from orthoflow_plugins.match.mixtures import pair_in_colours
from orthoflow_plugins.match.pairing import USUAL_RULE, PairingRule, PhotoPairs
from orthoflow_plugins.match.sift import MatchSift

from orthoflow.files.images import decode_image, encode_png
from orthoflow.products import Photo, TieRole, Ties, Walls
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms

# The middle of its picture, which holds key points enough.
CAMERA = replace(
    ms.camera_before(ms.textured_wall(1)), width=630, height=448, cx=0.5 * 630, cy=0.5 * 448
)


def sifted(photo: Photo, walls: Walls, tmp_path: Path, **params: object) -> Ties:
    ctx = StepContext(rng=np.random.default_rng(1), cores=2, scratch=tmp_path)
    inputs = MatchSift.In(photos=ms.photos(photo), walls=walls)
    return MatchSift().run(inputs, MatchSift.Params(**params), ctx).ties


def grey_of(seed: int) -> NDArray[np.uint8]:
    """The wall of one texture as a camera sees it; all textures lie on the same relief."""
    return decode_image(ms.photo_of(ms.textured_wall(seed), CAMERA).encoded, "a.png")[:, :, 0]


def photo_with(rgb: NDArray[np.uint8]) -> Photo:
    return replace(ms.photo_of(ms.textured_wall(1), CAMERA), encoded=encode_png(rgb))


def wall_with(red: float, green: float) -> Walls:
    """The wall as a laser sees it that answers so to the textures 1 (red) and 2 (green)."""
    both = [ms.walls_of(ms.textured_wall(seed)) for seed in (1, 2)]
    first, second = (each.walls[0].intensity for each in both)
    assert first is not None
    assert second is not None
    intensity = (0.5 + red * (first - 0.45) + green * (second - 0.45)).astype(np.float32)
    return replace(both[0], walls=(replace(both[0].walls[0], intensity=intensity),))


@pytest.mark.parametrize(
    ("red", "green", "picture"),
    [(-0.6, 0.6, "green less red"), (0.6, -0.6, "red less green")],
    ids=["green against red", "red against green"],
)
def test_a_photo_is_found_in_the_mixture_that_the_laser_sees(
    tmp_path: Path, red: float, green: float, picture: str
) -> None:
    rgb = np.stack([grey_of(1), grey_of(2), grey_of(1)], axis=-1)
    photo, walls = photo_with(rgb), wall_with(red, green)
    in_grey = sifted(photo, walls, tmp_path, tries_colours=False)
    ties = sifted(photo, walls, tmp_path)
    assert right(in_grey) < 30
    assert right(ties) > 150
    assert right(ties) > 0.9 * (ties.role != TieRole.REJECTED).sum()
    assert note(ties)["picture"] == picture


def test_a_negative_is_found_in_a_photo_without_colours(tmp_path: Path) -> None:
    photo = ms.photo_of(ms.textured_wall(1), CAMERA)
    ties = sifted(photo, wall_with(-1.0, 0.0), tmp_path)
    assert right(ties) > 500
    assert note(ties)["picture"] != "grey"


def test_a_photo_that_grey_shows_on_a_wall_costs_no_mixture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(_: object) -> None:
        pytest.fail("a mixture was made")

    monkeypatch.setattr(mixtures, "photo_rgb", refused)
    ties = sifted(ms.photo_of(ms.textured_wall(1), CAMERA), wall_with(1.0, 0.0), tmp_path)
    assert right(ties) > 1000
    assert note(ties)["picture"] == "grey"


def test_a_photo_of_something_else_gets_no_ties_in_any_mixture(tmp_path: Path) -> None:
    rgb = np.stack([grey_of(seed) for seed in (3, 4, 5)], axis=-1)
    ties = sifted(photo_with(rgb), wall_with(1.0, 0.0), tmp_path)
    assert (ties.role != TieRole.REJECTED).sum() == 0


def right(ties: Ties) -> int:
    """Ties within two cells of where the true camera sees their points."""
    kept = ties.role != TieRole.REJECTED
    error = ties.pixels_photo[kept] - CAMERA.project(ties.points_world[kept])[:, :2]
    return int((np.linalg.norm(error, axis=1) < 4.0).sum())


def note(ties: Ties) -> dict[str, object]:
    photos = ties.details["photos"]
    assert isinstance(photos, dict)
    found = photos["a.png"]
    assert isinstance(found, dict)
    return dict(found)


# --- which mixtures are tried, and which one is taken ---


NO_FEATURES = Features(
    pixels=np.zeros((0, 2)),
    sizes_px=np.zeros(0),
    angles_deg=np.zeros(0),
    descriptors=np.zeros((0, 128), dtype=np.float32),
)


class Pairing:
    """Stands for the pairing of key points: tells how many each picture shows, and who asked."""

    def __init__(self, grey: int, *, mirrored: tuple[str, ...] = (), **counts: int) -> None:
        self.grey = grey
        self.counts = {name.replace("_", " "): count for name, count in counts.items()}
        self.mirrored = mirrored
        self.asked: list[tuple[str, int]] = []

    def __call__(self, picture: str, _walls: object, rule: PairingRule) -> PhotoPairs:
        self.asked.append((picture, rule.longest_side_px))
        return PhotoPairs(
            features=NO_FEATURES,
            scale=1.0,
            pairs=(),
            radius_px=1.0,
            is_mirrored=picture in self.mirrored,
            n_recognised=self.grey if picture == "grey" else self.counts.get(picture, 0),
        )


def taken(monkeypatch: pytest.MonkeyPatch, pairing: Pairing) -> str:
    monkeypatch.setattr(mixtures, "pair_photo", pairing)
    monkeypatch.setattr(mixtures, "photo_grey", lambda _: "grey")
    monkeypatch.setattr(mixtures, "photo_rgb", lambda _: None)
    monkeypatch.setattr(mixtures, "mixed", lambda _, name: None if name == "negative" else name)
    photo: Any = None
    return pair_in_colours(photo, [], USUAL_RULE).picture


@pytest.mark.parametrize(
    ("pairing", "picture", "n_asked"),
    [
        (Pairing(24), "grey", 1),
        (Pairing(23), "grey", 5),
        # As many as agree on a wrong place are too few, and a mixture must show more than grey.
        (Pairing(0, red_as_dark=15), "grey", 5),
        (Pairing(0, red_as_dark=16), "red as dark", 5),
        (Pairing(17, red_as_dark=17), "grey", 5),
        (Pairing(17, red_as_dark=18), "red as dark", 5),
        (Pairing(0, red_as_dark=20, blue_less_red=19), "red as dark", 5),
        (Pairing(0, red_as_dark=20, blue_less_red=21), "blue less red", 5),
        # Clear enough, so that no other is tried.
        (Pairing(0, red_as_dark=24, blue_less_red=99), "red as dark", 3),
        (Pairing(0, red_as_dark=99, mirrored=("red as dark",)), "grey", 5),
        # Of a photo that shows nothing in it, nobody is asked.
        (Pairing(0, negative=99), "grey", 5),
    ],
)
def test_the_mixture_is_taken_in_which_clearly_more_agree(
    monkeypatch: pytest.MonkeyPatch, pairing: Pairing, picture: str, n_asked: int
) -> None:
    assert taken(monkeypatch, pairing) == picture
    assert len(pairing.asked) == n_asked
    # Mixtures find the place, and smaller pictures do for that.
    sides = [side for _, side in pairing.asked]
    assert sides[0] == USUAL_RULE.longest_side_px
    assert all(side == sides[0] / 2 for side in sides[1:])


@pytest.mark.parametrize(("levels", "shows"), [(7, False), (9, True)])
def test_a_mixture_of_hardly_any_contrast_shows_nothing(levels: int, *, shows: bool) -> None:
    ramp = np.rint(np.linspace(100, 100 + levels, 400)).astype(np.uint8)
    rgb = np.stack([np.full((40, 400), 50), *[np.tile(ramp, (40, 1))] * 2], axis=-1)
    found = mixtures.mixed(rgb.astype(np.uint8), "green less red")
    assert (found is not None) is shows
    if found is not None:
        assert (found.min(), found.max()) == (0, 255)
        assert (np.diff(found[0].astype(int)) >= 0).all()
