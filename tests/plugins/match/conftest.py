"""What the tests of matching share: key points and matches of the few pictures they look at."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import key_points as matching

from orthoflow.geometry import key_points
from orthoflow.geometry.key_points import Matches

# Each holds some megabytes.
_PICTURES_MOST: Final = 32


@dataclass
class _Remembered:
    """Key points and their descriptors by what they were asked of."""

    tiles: dict[tuple[object, ...], Any] = field(default_factory=dict)
    described: dict[tuple[object, ...], NDArray[np.float32]] = field(default_factory=dict)
    matched: dict[tuple[object, ...], Matches] = field(default_factory=dict)
    find: Any = key_points._in_tile
    describe: Any = key_points._described
    match: Any = key_points.mutual_matches

    def in_tile(
        self, sift: Any, picture: NDArray[np.uint8], corner: tuple[int, int], shift_px: float
    ) -> Any:
        """Give what OpenCV finds in a tile of a picture."""
        digest = hashlib.sha256(np.ascontiguousarray(picture)).digest()
        rule = (sift.getContrastThreshold(), sift.getEdgeThreshold(), shift_px)
        key = (digest, picture.shape, corner, *rule)
        if key not in self.tiles:
            tile = self.find(sift, picture, corner, shift_px)
            if len(self.tiles) >= _PICTURES_MOST:
                # Both, since descriptors are known by the tiles that they are of.
                self.described.clear()
                self.tiles.clear()
            self.tiles[key] = tile
        return self.tiles[key]

    def of_chosen(
        self, sift: Any, picture: NDArray[np.uint8], tiles: list[Any], chosen: NDArray[np.intp]
    ) -> NDArray[np.float32]:
        """Give descriptors of chosen key points."""
        if not all(any(tile is known for known in self.tiles.values()) for tile in tiles):
            return self.describe(sift, picture, tiles, chosen)
        key = (*map(id, tiles), chosen.tobytes())
        if key not in self.described:
            self.described[key] = self.describe(sift, picture, tiles, chosen)
        return self.described[key].copy()

    def matches(
        self, first: NDArray[np.float32], second: NDArray[np.float32], **rule: Any
    ) -> Matches:
        """Give which of two sets of descriptors belong together."""
        digests = [hashlib.sha256(np.ascontiguousarray(one)).digest() for one in (first, second)]
        key = (*digests, *sorted(rule.items()))
        if key not in self.matched:
            self.matched[key] = self.match(first, second, **rule)
        found = self.matched[key]
        return replace(found, **{name: array.copy() for name, array in vars(found).items()})


_remembered = _Remembered()


@pytest.fixture(autouse=True)
def _key_points_found_once(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Look at each picture, and match two of them, once: tests look at the same few."""
    if request.path.stem != "test_features":
        monkeypatch.setattr(key_points, "_in_tile", _remembered.in_tile)
        monkeypatch.setattr(key_points, "_described", _remembered.of_chosen)
        monkeypatch.setattr(matching, "mutual_matches", _remembered.matches)
