"""Photos whose grey is not what the laser sees are found in mixtures of their colours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match.key_points import mixed
from orthoflow_plugins.match.sift import MatchSift

from orthoflow.files.images import decode_image, encode_png
from orthoflow.products import Photo, TieRole, Ties, Walls
from orthoflow.testing import photographed as ms
from tests import matched_walls as mw

# The middle of its picture, which holds key points enough.
CAMERA = replace(
    ms.camera_before(ms.textured_wall(1)), width=630, height=448, cx=0.5 * 630, cy=0.5 * 448
)


def sifted(photo: Photo, walls: Walls, folder: Path) -> Ties:
    return mw.ties_of(MatchSift, folder, {"photos": ms.photos(photo), "walls": walls})


def grey_of(seed: int) -> NDArray[np.uint8]:
    """The wall of one texture as a camera sees it; all textures lie on the same relief."""
    return decode_image(ms.photo_of(ms.textured_wall(seed), CAMERA).encoded, "a.png")[:, :, 0]


def photo_with(rgb: NDArray[np.uint8]) -> Photo:
    return replace(ms.photo_of(ms.textured_wall(1), CAMERA), encoded=encode_png(rgb))


def wall_with(red: float, green: float) -> Walls:
    """The wall as a laser sees it that answers so to the textures 1 (red) and 2 (green)."""
    both = [mw.walls(seed) for seed in (1, 2)]
    first, second = (each.walls[0].intensity for each in both)
    assert first is not None
    assert second is not None
    intensity = (0.5 + red * (first - 0.45) + green * (second - 0.45)).astype(np.float32)
    return replace(both[0], walls=(replace(both[0].walls[0], intensity=intensity),))


def test_a_photo_is_found_in_the_mixture_that_the_laser_sees(tmp_path: Path) -> None:
    rgb = np.stack([grey_of(1), grey_of(2), grey_of(1)], axis=-1)
    ties = sifted(photo_with(rgb), wall_with(0.6, -0.6), tmp_path)
    assert right(ties) > 150
    assert right(ties) > 0.9 * (ties.role != TieRole.REJECTED).sum()
    assert picture_of(ties) == "red less green"


def test_a_negative_is_found_in_a_photo_without_colours(tmp_path: Path) -> None:
    photo = ms.photo_of(ms.textured_wall(1), CAMERA)
    ties = sifted(photo, wall_with(-1.0, 0.0), tmp_path)
    assert right(ties) > 500
    assert picture_of(ties) != "grey"


def test_a_photo_of_something_else_gets_no_ties_in_any_mixture(tmp_path: Path) -> None:
    rgb = np.stack([grey_of(seed) for seed in (3, 4, 5)], axis=-1)
    ties = sifted(photo_with(rgb), wall_with(1.0, 0.0), tmp_path)
    assert (ties.role != TieRole.REJECTED).sum() == 0


def right(ties: Ties) -> int:
    """Ties within two cells of where the true camera sees their points."""
    kept = ties.role != TieRole.REJECTED
    return int((np.linalg.norm(mw.off_px(ties, CAMERA)[kept], axis=1) < 4.0).sum())


def picture_of(ties: Ties) -> str:
    """Which picture of the photo was matched."""
    return ties.details["photos"]["a.png"]["picture"]  # type: ignore[call-overload,index,return-value]


# --- which mixtures are tried, and which one is taken ---


@pytest.mark.parametrize(("levels", "shows"), [(7, False), (9, True)])
def test_a_mixture_of_hardly_any_contrast_shows_nothing(levels: int, *, shows: bool) -> None:
    ramp = np.rint(np.linspace(100, 100 + levels, 400)).astype(np.uint8)
    rgb = np.stack([np.full((40, 400), 50), *[np.tile(ramp, (40, 1))] * 2], axis=-1)
    found = mixed(rgb.astype(np.uint8), "green less red")
    assert (found is not None) is shows
    if found is not None:
        assert (found.min(), found.max()) == (0, 255)
        assert (np.diff(found[0].astype(int)) >= 0).all()
