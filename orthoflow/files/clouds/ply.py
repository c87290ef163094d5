"""A cloud as binary PLY with double coordinates.

A writer of our own: libraries for PLY need all points at once, or do not support custom fields.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.clouds.dressing import DressedCloud, Points

_TYPES: Final = {"f8": "double", "f4": "float", "u1": "uchar", "u2": "ushort", "i2": "short"}
# As many digits as any number of points has; overwritten when the number is known.
_DIGITS: Final = 12


def write_ply(path: Path, dressed: DressedCloud) -> int:
    """Write the selected points, piece by piece; return their number.

    Raises:
        OSError: the disk cannot be written.
    """
    n_written = 0
    count_at = 0
    with path.open("wb") as stream:
        for points in dressed.blocks():
            records = _records(points)
            if n_written == 0:
                count_at = stream.write(_head(dressed))
                stream.write(_rest_of_head(records))
            stream.write(records.tobytes())
            n_written += len(points)
        if n_written:
            stream.seek(count_at - _DIGITS - 1)
            stream.write(f"{n_written:0{_DIGITS}d}".encode())
    return n_written


def _head(dressed: DressedCloud) -> bytes:
    crs = " ".join(dressed.crs_wkt.split()) or "not known"
    lines = (
        *("ply", "format binary_little_endian 1.0", "comment orthoflow, metres"),
        f"comment coordinate system {crs}",
        f"element vertex {0:0{_DIGITS}d}",
    )
    return "".join(f"{line}\n" for line in lines).encode()


def _rest_of_head(records: NDArray[np.void]) -> bytes:
    names = records.dtype.names or ()
    lines = [f"property {_TYPES[records.dtype[name].str[1:]]} {name}\n" for name in names]
    return "".join([*lines, "end_header\n"]).encode()


def _records(points: Points) -> NDArray[np.void]:
    columns: dict[str, NDArray[Any]] = {
        **dict(zip("xyz", points.world.T, strict=True)),
        **dict(zip(("nx", "ny", "nz"), points.normal.T, strict=True)),
        **dict(zip(("red", "green", "blue"), points.rgb.T, strict=True)),
        **points.fields(),
    }
    kinds = [(name, values.dtype.newbyteorder("<")) for name, values in columns.items()]
    records = np.empty(len(points), dtype=kinds)
    for name, values in columns.items():
        records[name] = values
    return records
