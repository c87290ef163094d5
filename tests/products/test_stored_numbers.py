"""Numbers that stand for something in files keep their meaning."""

from __future__ import annotations

from enum import IntEnum

import pytest

from orthoflow.geometry.scenes import SurfaceRole, TextureKind
from orthoflow.products import LayerMask, OrthoMask, SurfaceMask, TieRole


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        (SurfaceMask, ["VOID", "MEASURED", "RECOVERED"]),
        (LayerMask, ["OUTSIDE", "PAINTED", "OCCLUDED", "NO_SURFACE"]),
        (OrthoMask, ["NONE", "PAINTED", "FILLED", "OCCLUDED", "NO_SURFACE", "CONTRADICTED"]),
        (TieRole, ["CONTROL", "CHECK", "REJECTED"]),
        (SurfaceRole, ["WALL", "RELIEF", "RECESS", "OBJECT"]),
        (TextureKind, ["PLAIN", "FRESCO", "TEXTILE", "TILES", "WOOD"]),
    ],
    ids=lambda value: value.__name__ if isinstance(value, type) else "",
)
def test_names_stand_for_the_numbers_from_zero_on(kind: type[IntEnum], names: list[str]) -> None:
    assert [(item.name, item.value) for item in kind] == [(name, k) for k, name in enumerate(names)]
