"""Selection of items or raster rows from dataclasses of arrays, and sums over groups of rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.frames import WallFrame

_GOLDEN: Final = 0.6180339887498949


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Base class of dataclasses whose arrays have one row per item."""

    def __len__(self) -> int:
        return len(next(iter(_arrays(self).values())))

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Self:
        """Return the selected items; a slice gives views."""
        return replace(self, **{name: array[chosen] for name, array in _arrays(self).items()})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Concatenate items; fields that are not arrays are copied from the first object."""
        columns = {name: [getattr(part, name) for part in parts] for name in _arrays(parts[0])}
        return replace(parts[0], **{name: np.concatenate(own) for name, own in columns.items()})


def group_sums(
    values: NDArray[np.float64], group: NDArray[np.integer], n_groups: int = 0
) -> NDArray[np.float64]:
    """Sum the rows of values (n, k) by their group (n,).

    Returns:
        (g, k) sums, where g is `n_groups`, or more if there are groups with larger numbers.
    """
    columns = [np.bincount(group, column, minlength=n_groups) for column in values.T]
    return np.stack(columns, axis=1)


def spread_index(n_items: int, count: int) -> NDArray[np.int64]:
    """Return the index (count,) of one item from each of `count` equal parts of a list.

    The position within each part is computed with the golden ratio, because a fixed stride could
    coincide with the columns of a scan, and random positions would need a seed.
    """
    stretch = n_items / max(count, 1)
    ordinal = np.arange(count)
    within = np.modf(ordinal * _GOLDEN)[0] if stretch > 1.0 else np.zeros(count)
    return np.minimum((ordinal + within) * stretch, n_items - 1).astype(np.int64)


class _Raster(Protocol):
    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def frame(self) -> WallFrame: ...


_AnyRaster = TypeVar("_AnyRaster", bound=_Raster)


def raster_rows(raster: _AnyRaster, rows: slice) -> _AnyRaster:
    """Return a band of rows of a raster, with views of its arrays and the frame of the band."""
    frame = raster.frame
    bands = {
        name: array[rows]
        for name, array in _arrays(raster).items()
        if array.shape[:2] == frame.shape
    }
    return replace(raster, frame=frame.of_rows(rows), **bands)


def _arrays(rows: object) -> dict[str, NDArray[Any]]:
    return {name: value for name, value in vars(rows).items() if isinstance(value, np.ndarray)}
