"""Pictures referenced by CAD files: PNG of the size of the raster, written band by band."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

import numpy as np

from orthoflow.errors import StoreError
from orthoflow.files.geotiff import RasterParts
from orthoflow.geometry.levels import eight_bits

if TYPE_CHECKING:
    from orthoflow.geometry.levels import Colours

_BAND_CELLS: Final = 1 << 23


def write_cad_picture(raster: Path, path: Path) -> tuple[int, int]:
    """Write an orthoimage as PNG, one pixel per cell, transparent where empty.

    Returns:
        Rows and columns.

    Raises:
        StoreError: the file cannot be written.
    """
    import rasterio
    from rasterio.shutil import copy
    from rasterio.windows import Window

    with RasterParts(raster) as source, tempfile.TemporaryDirectory() as folder:
        rows, columns = source.shape
        step = max(1, _BAND_CELLS // columns)
        # GDAL's PNG driver only copies, row by row.
        aside = Path(folder) / "picture.tif"
        profile = {"count": 4, "dtype": "uint8", "transform": rasterio.Affine(2, 0, 0, 0, -2, 0)}
        try:
            with rasterio.open(aside, "w", width=columns, height=rows, **profile) as target:
                for first in range(0, rows, step):
                    last = min(rows, first + step)
                    box = (0.0, float(first), float(columns), float(last))
                    values, shown = source.read(box, (last - first, columns))
                    # White behind transparency, for programs that do not support it.
                    pixels = np.full((last - first, columns, 4), 255, dtype=np.uint8)
                    pixels[..., :3][shown] = eight_bits(cast("Colours", values))[shown]
                    pixels[..., 3] = np.where(shown, 255, 0)
                    window = Window(0, first, columns, last - first)
                    target.write(pixels.transpose(2, 0, 1), window=window)
            with rasterio.Env(GDAL_PAM_ENABLED="NO"):
                copy(aside, path, driver="PNG", ZLEVEL="4")
        except (OSError, rasterio.errors.RasterioError) as error:
            raise StoreError(f"{path.name} cannot be written: {error}; free some space") from error
    return rows, columns
