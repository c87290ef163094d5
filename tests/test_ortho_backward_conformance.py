"""`ortho.dsm-backward` keeps the rules for methods, on a wall with photos that fit it."""

from __future__ import annotations

import pytest

from orthoflow.testing import ConformanceCase, conformance_cases
from tests import ortho_scenes as scenes


def cases() -> list[ConformanceCase]:
    where = scenes.frame()
    return conformance_cases(
        "ortho.dsm-backward",
        inputs={
            "walls": scenes.walls(where),
            "cloud": scenes.cloud(where, spacing_cells=2.0),
            "photos": scenes.photos(scenes.rendered(width=300)),
            "cameras": scenes.cameras(scenes.camera(where, width=300)),
        },
    )


@pytest.mark.parametrize("case", cases(), ids=str)
def test_laying_photos_onto_walls_conforms(case: ConformanceCase) -> None:
    case.run()
