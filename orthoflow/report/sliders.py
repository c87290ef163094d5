"""Pictures of one wall that can be laid over each other and drawn apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoflow.geometry import WallFrame
from orthoflow.report.pictures import Picture

# Rasters of one wall by two methods: their planes are some centimetres and a degree apart at most.
_SAME_NORMAL_COSINE: Final = float(np.cos(np.radians(5.0)))
_SAME_PLACE_SHARE: Final = 0.1  # of the longer side, between centres


@dataclass(frozen=True, kw_only=True)
class Laid:
    """A picture laid into the rectangle of another, in percent of that one's sides."""

    picture: int
    title: str
    left: float
    top: float
    width: float
    height: float


@dataclass(frozen=True, kw_only=True)
class Slider:
    """Pictures of one wall.

    Attributes:
        name: the wall.
        ratio: width over height of the rectangle.
        pictures: at least two, orthoimages first.
    """

    name: str
    ratio: float
    pictures: tuple[Laid, ...]


def sliders(pictures: Sequence[Picture], n_orthoimages: int) -> tuple[Slider, ...]:
    """Group pictures by the place that they show.

    Args:
        pictures: orthoimages first, then rasters of walls.
        n_orthoimages: how many of them are orthoimages; each of the groups has at least one.
    """
    groups: list[list[int]] = []
    for index, picture in enumerate(pictures):
        if picture.frame is None:
            continue
        for group in groups:
            first = pictures[group[0]].frame
            if first is not None and _is_same_place(first, picture.frame):
                group.append(index)
                break
        else:
            if index < n_orthoimages:
                groups.append([index])
    return tuple(_slider(pictures, group) for group in groups if len(group) > 1)


def _slider(pictures: Sequence[Picture], group: Sequence[int]) -> Slider:
    first = pictures[group[0]]
    reference = _frame(first)
    return Slider(
        name=first.title.partition(" (")[0],
        ratio=reference.width / reference.height,
        pictures=tuple(_laid(index, pictures[index], reference) for index in group),
    )


def _laid(index: int, picture: Picture, reference: WallFrame) -> Laid:
    frame = _frame(picture)
    offset = frame.origin_world - reference.origin_world
    across_m, down_m = reference.width * reference.gsd_m, reference.height * reference.gsd_m
    return Laid(
        picture=index,
        title=picture.title,
        left=100 * float(offset @ reference.u_world) / across_m,
        top=100 * float(offset @ reference.v_world) / down_m,
        width=100 * frame.width * frame.gsd_m / across_m,
        height=100 * frame.height * frame.gsd_m / down_m,
    )


def _frame(picture: Picture) -> WallFrame:
    if picture.frame is None:
        raise ValueError("only rasters of walls are grouped")
    return picture.frame


def _is_same_place(one: WallFrame, other: WallFrame) -> bool:
    longest_m = max(one.width, one.height) * one.gsd_m
    distance_m = float(np.linalg.norm(_centre(one) - _centre(other)))
    return (
        float(one.normal_world @ other.normal_world) > _SAME_NORMAL_COSINE
        and float(one.u_world @ other.u_world) > _SAME_NORMAL_COSINE
        and distance_m < _SAME_PLACE_SHARE * longest_m
    )


def _centre(frame: WallFrame) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    middle = np.array([[0.5 * frame.width, 0.5 * frame.height]])
    return np.asarray(frame.world_from_wall(middle)[0], dtype=np.float64)
