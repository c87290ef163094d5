"""Photos in every kind of trouble: right and honest about it, or refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.orient.pnp import OrientPnp

from orthoflow.products import Camera
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms
from tests.adverse_cases import GSD_M, KINDS, AdverseCase, adverse_case, every_case


def oriented(case: AdverseCase, folder: Path) -> Camera:
    ctx = StepContext(rng=np.random.default_rng(1), cores=1, scratch=folder)
    inputs = OrientPnp.In(ties=case.ties, photos=ms.photos(case.photo))
    return OrientPnp().run(inputs, OrientPnp.Params(), ctx).cameras.cameras[0]


def check_honesty(case: AdverseCase, found: Camera) -> None:
    """A photo is ok with a stated error of at most a cell, and a true one within five of these."""
    if found.status != "ok":
        return
    assert found.sigma_wall_m is not None
    assert found.sigma_wall_m <= GSD_M, case.kind
    assert case.wall_error_m(found.viewing()) <= 5.0 * found.sigma_wall_m, case.kind


@pytest.mark.parametrize("kind", KINDS)
def test_a_photo_in_trouble_is_right_or_refused(tmp_path: Path, kind: str) -> None:
    case = adverse_case(kind, 0)
    found = oriented(case, tmp_path)
    check_honesty(case, found)
    assert found.status == "ok" or not case.is_solvable, found.status


@pytest.mark.long
def test_of_two_hundred_photos_in_trouble_the_solvable_ones_are_ok(tmp_path: Path) -> None:
    n_solvable = n_ok = 0
    for case in every_case(10):
        found = oriented(case, tmp_path)
        check_honesty(case, found)
        n_solvable += case.is_solvable
        n_ok += case.is_solvable and found.status == "ok"
    assert n_solvable == 110
    # Measured: all of them.
    assert n_ok >= 0.95 * n_solvable


def test_the_calibration_of_another_lens_is_told_from_the_ties(tmp_path: Path) -> None:
    status = oriented(adverse_case("calibration of another lens", 1), tmp_path).status
    assert "the calibration belongs to another lens, zoom or image size" in status
