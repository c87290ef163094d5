"""Where a GeoTIFF lies, from its header: shape, transform, coordinate system, outline on Earth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from orthoflow.errors import InputError
from orthoflow.files.geotiff import check_header, quiet


@dataclass(frozen=True, kw_only=True)
class RasterPlace:
    """What the header of a GeoTIFF says.

    Attributes:
        shape: rows and columns.
        transform: six numbers, X of the column, X of the row, X of the corner, and so for Y.
        epsg: code of the coordinate system, None for one without a code.
        wkt2: coordinate system.
        bounds: smallest X and Y, largest X and Y, in the coordinate system.
        outline_lonlat: corners on Earth, counter-clockwise and closed, longitude and latitude in
            degrees; empty where the coordinate system is no place on Earth.
        bands: type of each band.
    """

    shape: tuple[int, int]
    transform: tuple[float, ...]
    epsg: int | None
    wkt2: str
    bounds: tuple[float, float, float, float]
    outline_lonlat: tuple[tuple[float, float], ...]
    bands: tuple[str, ...]


def place_of(path: Path) -> RasterPlace:
    """Read the header of a GeoTIFF.

    Raises:
        InputError: the file is no GeoTIFF that GDAL can read, or says what no file of its size can
            hold.
    """
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.warp import transform

    try:
        with quiet(), rasterio.open(path, driver="GTiff") as dataset:
            check_header(path, dataset)
            epsg = dataset.crs.to_epsg() if dataset.crs else None
            left, first, right, last = dataset.bounds
            bottom, top = sorted((first, last))
            outline: tuple[tuple[float, float], ...] = ()
            if epsg is not None:
                x, y = (left, right, right, left, left), (bottom, bottom, top, top, bottom)
                lon, lat = transform(dataset.crs, "EPSG:4326", x, y)
                outline = tuple(zip(lon, lat, strict=True))
            return RasterPlace(
                shape=(dataset.height, dataset.width),
                transform=tuple(dataset.transform)[:6],
                epsg=epsg,
                wkt2=dataset.crs.to_wkt(version="WKT2_2019") if dataset.crs else "",
                bounds=(left, bottom, right, top),
                outline_lonlat=outline,
                bands=tuple(dataset.dtypes),
            )
    except (RasterioError, OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} cannot be read as a GeoTIFF: {error}; expected a whole TIFF file"
        ) from error
