"""LZF compression, as used in binary PCD files."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled


@compiled
def decompress_lzf(packed: NDArray[np.uint8], plain: NDArray[np.uint8]) -> int:
    """Unpack LZF data.

    Args:
        packed: compressed bytes.
        plain: array to fill, with the size declared in the header.

    Returns:
        Number of bytes written, or -1 if the data are damaged or do not fit.
    """
    read = 0
    written = 0
    while read < packed.size:
        control = int(packed[read])
        read += 1
        if control < 32:
            count = control + 1
            if read + count > packed.size or written + count > plain.size:
                return -1
            for _ in range(count):
                plain[written] = packed[read]
                written += 1
                read += 1
            continue
        count = control >> 5
        if count == 7:
            if read >= packed.size:
                return -1
            count += int(packed[read])
            read += 1
        if read >= packed.size:
            return -1
        source = written - ((control & 31) << 8) - int(packed[read]) - 1
        read += 1
        count += 2
        if source < 0 or written + count > plain.size:
            return -1
        # Copy byte by byte, because source and target overlap if a pattern repeats.
        for _ in range(count):
            plain[written] = plain[source]
            written += 1
            source += 1
    return written
