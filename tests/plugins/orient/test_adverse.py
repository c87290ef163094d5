"""Photos in every kind of trouble: right and honest about it, or refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from orthoflow_plugins.orient.pnp import OrientPnp

from orthoflow.testing import photographed as ms
from tests import tied_photos as tp
from tests.adverse_cases import KINDS, adverse_case


def oriented(kind: str, seed: int, folder: Path) -> str:
    """Status of a photo, which is ok with a true error within five of the stated ones only."""
    case, is_solvable = adverse_case(kind, seed)
    (found,) = tp.oriented(OrientPnp, case.ties, ms.photos(case.photo), tp.context(folder)).cameras
    if found.status == "ok":
        assert found.sigma_wall_m is not None
        assert found.sigma_wall_m <= ms.GSD_M
        assert case.wall_error_m(found.viewing()) <= 5.0 * found.sigma_wall_m
    else:
        assert not is_solvable, found.status
    return found.status


@pytest.mark.parametrize("kind", KINDS)
def test_a_photo_in_trouble_is_right_or_refused(tmp_path: Path, kind: str) -> None:
    status = oriented(kind, 0, tmp_path)
    if kind == "calibration of another lens":
        assert "the calibration belongs to another lens, zoom setting or image size" in status


@pytest.mark.long
@pytest.mark.parametrize("seed", range(1, 10))
@pytest.mark.parametrize("kind", KINDS)
def test_of_more_photos_in_trouble_so_is_each(tmp_path: Path, kind: str, seed: int) -> None:
    oriented(kind, seed, tmp_path)
