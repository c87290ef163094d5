"""The textured wall of the conformance suite, under the name that tests know it by."""

from __future__ import annotations

from orthoflow.testing.photographed import (
    DISTORTION,
    GSD_M,
    RELIEF_M,
    SIZE_M,
    TexturedWall,
    camera_before,
    cameras,
    nudged,
    oriented,
    photo_of,
    photos,
    textured_wall,
    wall_error_m,
    walls_of,
)

__all__ = [
    "DISTORTION",
    "GSD_M",
    "RELIEF_M",
    "SIZE_M",
    "TexturedWall",
    "camera_before",
    "cameras",
    "nudged",
    "oriented",
    "photo_of",
    "photos",
    "textured_wall",
    "wall_error_m",
    "walls_of",
]
