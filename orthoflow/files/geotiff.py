"""GeoTIFF files in the plane of a wall: single-band rasters and cloud-optimised orthoimages.

The coordinates are local and in metres; pixels are areas. For walls, X runs along the wall from its
left edge and Y is the height; for floors and ceilings, X and Y are x and y of the world. Rasters of
horizontal planes can be in map coordinates (easting and northing) instead. `WallFrame.raster_axes`
defines which of these applies. Identical rasters give identical bytes.
"""

from __future__ import annotations

import base64
import math
import mmap
import re
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError, ProductError, StoreError
from orthoflow.geometry import WallFrame
from orthoflow.geometry.levels import Colours

if TYPE_CHECKING:
    from rasterio.crs import CRS
    from rasterio.io import DatasetReader
    from rasterio.transform import Affine
    from rasterio.windows import Window

# This is exactly the text that GDAL returns from a GeoTIFF, so that comparisons succeed.
_LOCAL_CRS_WKT: Final = (
    'LOCAL_CS["{},'
    ' metres",UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
)
SITE_CRS: Final = "site"
# Placeholder for the run id, which is not known before files are published.
_ANY_RUN: Final = "00000000-000000-000000"
SITE_CRS_WKT: Final = _LOCAL_CRS_WKT.format("coordinates of the scan")
_NAMED_SUFFIXES: Final = (".tif", ".json", ".geojson", ".html")
_NO_NAME: Final = re.compile(r"[^\w .,()-]", re.ASCII)
# The pixels are kept in memory, with copies.
#: pixels of an imported orthoimage
MOST_CELLS: Final = 1 << 28
#: bands of an imported orthoimage
MOST_BANDS: Final = 4
TILE_PX: Final = 512
_CACHE_BYTES: Final = 1 << 27
# Maximum compression ratio that a file may declare; deflate reaches at most 1032 to 1.
_LARGEST_RATIO: Final = 1100
_LONGEST_CRS: Final = 100
_SIDES_M: Final = (1e-6, 1e6)
_ALWAYS_ALLOWED_VALUES: Final = 64 << 20
# Data types of single bands, and their nodata values.
_NOTHING: Final = {"float32": math.nan, "int16": -1, "int32": -1, "uint8": None}


_COG_OPTIONS: Final[dict[str, object]] = {
    "compress": "DEFLATE",
    "predictor": "YES",
    "blocksize": TILE_PX,
    # The driver creates the overviews, because explicit odd factors with a mask crashed older
    # builds of GDAL.
    "overviews": "AUTO",
    "resampling": "AVERAGE",
}


@dataclass(frozen=True, kw_only=True)
class GridPlace:
    """The position of a raster in its coordinate system.

    Attributes:
        gsd_m: cell size in metres.
        corner_m: X and Y of the outer corner of the top-left cell.
        crs: an EPSG code, `site`, or the name of a local system.
        down: change of Y per metre from row to row, -1 or 1.
    """

    gsd_m: float
    corner_m: tuple[float, float] = (0.0, 0.0)
    crs: str = "plane"
    down: float = -1.0

    @classmethod
    def of(cls, frame: WallFrame) -> Self:
        """Return the position of a wall's raster."""
        return cls(
            gsd_m=frame.gsd_m,
            corner_m=frame.raster_corner_m,
            crs=frame.crs,
            down=frame.raster_down,
        )


@dataclass(frozen=True, kw_only=True)
class RasterFile:
    """The content of a GeoTIFF.

    Attributes:
        values: (rows, cols) for one band, (rows, cols, bands) for several; of the stored type.
        shown: (rows, cols) dataset mask, True where the file has content.
        place: position of the raster, without its coordinate system.
        tags: tags of the dataset.
        crs_wkt: coordinate system, as returned by GDAL.
    """

    values: NDArray[np.generic]
    shown: NDArray[np.bool_]
    place: GridPlace
    tags: Mapping[str, str]
    crs_wkt: str


def local_crs_name(name: str) -> str:
    """Return the name of a wall's coordinate system; `name_run` later inserts the run id."""
    return f"run {_ANY_RUN} {re.sub(_NO_NAME, '_', name)}"


def local_crs_wkt(name: str) -> str:
    """Return the WKT of a wall's coordinate system, from the name of the wall."""
    return _LOCAL_CRS_WKT.format(local_crs_name(name))


def name_run(path: Path, run_id: str) -> None:
    """Insert a run id into the names of the coordinate systems in a published file.

    Products publish the same bytes in every run; the id makes the names unique. An id whose length
    differs from orthoflow's is truncated or padded, so that no offset in the file changes.
    """
    if path.suffix not in _NAMED_SUFFIXES or path.stat().st_size == 0:
        return
    token = _ANY_RUN.encode()
    name = re.sub(_NO_NAME, "_", run_id)[: len(token)].ljust(len(token), "_").encode()
    with path.open("r+b") as stream, mmap.mmap(stream.fileno(), 0) as content:
        place = content.find(token)
        while place >= 0:
            content[place : place + len(token)] = name
            place = content.find(token, place + len(token))


def require_map_crs(crs: str) -> None:
    """Refuse coordinate systems that are not map projections in metres.

    Raises:
        InputError: the coordinate system is unknown, or not in metres.
    """
    found = _map_crs(crs)
    # For the local system `site`, GDAL reports a unit, but no projection.
    if crs != SITE_CRS and not (found.is_projected and found.linear_units_factor[1] == 1.0):
        raise InputError(
            f"{crs} is not a coordinate system in metres: expected a projected system, such as "
            f"EPSG:2100, or {SITE_CRS}"
        )


def epsg_of(map_crs: str | None) -> int | None:
    """Return the EPSG code of a map coordinate system; None for `site` and any other text.

    >>> epsg_of("EPSG:25832"), epsg_of("site"), epsg_of(None)
    (25832, None, None)
    """
    # GDAL also accepts paths and URLs as coordinate systems, and records may contain any text.
    found = re.fullmatch(r"EPSG:([0-9]{4,6})", map_crs or "", re.IGNORECASE)
    return int(found[1]) if found else None


def epsg_wkt(epsg: int) -> str:
    """Return the WKT of an EPSG code; empty if PROJ does not know it."""
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        with quiet():
            return str(CRS.from_epsg(epsg).to_wkt())
    except CRSError:
        return ""


def _map_crs(crs: str) -> CRS:
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    if crs == SITE_CRS:
        return CRS.from_wkt(SITE_CRS_WKT)
    epsg = epsg_of(crs)
    try:
        with quiet():
            if epsg is not None:
                return CRS.from_epsg(epsg)
    except CRSError:
        pass
    raise InputError(
        f"there is no coordinate system {crs[:_LONGEST_CRS]}: expected the EPSG code of a "
        f"projected system, such as EPSG:2100, or {SITE_CRS}"
    )


def write_raster(
    path: Path,
    values: NDArray[np.generic],
    *,
    place: GridPlace,
    tags: Mapping[str, str],
) -> None:
    """Write a single-band raster of values, labels or classes, a row of tiles at a time.

    No data is NaN for values and -1 for labels; classes have no nodata value.

    Args:
        path: output file in an existing folder.
        values: (rows, cols) float32 values, int16 or int32 labels, or uint8 classes.
        place: position of the raster.
        tags: strings stored in the file, by name.

    Raises:
        StoreError: the file cannot be written.
    """
    if values.ndim != 2 or str(values.dtype) not in _NOTHING:
        raise ProductError(
            f"{path.name} requires a two-dimensional raster of {', '.join(_NOTHING)}, got "
            f"{values.dtype} of shape {values.shape}"
        )
    profile: dict[str, object] = {
        "count": 1,
        "dtype": str(values.dtype),
        "compress": "DEFLATE",
        "predictor": 3 if values.dtype == np.float32 else 2,
        "nodata": _NOTHING[str(values.dtype)],
    }
    with writing(path):
        _write(path, values[:, :, None], None, profile | _placed(values.shape, place), tags)
        _require_written(path, values[:, :, None])


def write_orthoimage(
    path: Path,
    rgb: Colours,
    shown: NDArray[np.bool_],
    *,
    place: GridPlace,
    tags: Mapping[str, str],
    icc_profile: bytes | None = None,
) -> None:
    """Write a cloud-optimised RGB GeoTIFF with overviews and an internal dataset mask.

    The file is written a row of tiles at a time, so memory-mapped arrays may be larger than memory;
    meanwhile, an uncompressed copy exists next to the file.

    Args:
        path: output file in an existing folder.
        rgb: (rows, cols, 3) colours of 8 or 16 bits; the file has the same depth.
        shown: (rows, cols) True where the image has content (coloured from photos or filled).
        place: position of the raster.
        tags: strings stored in the file, by name.
        icc_profile: colour profile; None if it is sRGB or unknown.

    Raises:
        StoreError: the file cannot be written.
    """
    is_rgb = rgb.ndim == 3 and rgb.shape[2] == 3 and rgb.dtype in (np.uint8, np.uint16)
    if not is_rgb or rgb.shape[:2] != shown.shape:
        raise ProductError(
            f"{path.name} requires RGB with 8 or 16 bits and a mask of the same size, got "
            f"{rgb.dtype} of shape {rgb.shape} and a mask of {shown.shape}"
        )
    from rasterio.shutil import copy

    # GDAL's driver for cloud-optimised files can only copy another file.
    plain = path.with_name(f"{path.name}.plain")
    profile = {"count": 3, "dtype": rgb.dtype.name} | _placed(shown.shape, place)
    try:
        with writing(path):
            _write(plain, rgb, shown, profile, tags, icc_profile)
            copy(plain, path, driver="COG", BIGTIFF="IF_SAFER", **_COG_OPTIONS)
            _require_written(path, rgb)
    finally:
        plain.unlink(missing_ok=True)


def _bands(shape: tuple[int, ...]) -> Iterator[Window]:
    from rasterio.windows import Window

    for first in range(0, shape[0], TILE_PX):
        yield Window(0, first, shape[1], min(TILE_PX, shape[0] - first))


def _rows(window: Window) -> slice:
    return slice(window.row_off, window.row_off + window.height)


def _require_written(path: Path, values: NDArray[np.generic]) -> None:
    """Read the file back, because GDAL only logs an error if the disk is full on closing."""
    import rasterio

    with rasterio.open(path) as dataset:
        for window in _bands(values.shape):
            rows = _rows(window)
            written = np.moveaxis(dataset.read(window=window), 0, 2)
            if not np.array_equal(written, values[rows], equal_nan=True):
                raise OSError(f"rows {rows.start} to {rows.stop} cannot be read back")


def world_file_text(place: GridPlace, *, rows: float = 1.0, columns: float = 1.0) -> str:
    """Return the world file of a wall's raster, for programs that do not read GeoTIFF tags.

    Its six lines are the step along a row, two rotations, the step down a column, and the centre of
    the first pixel.

    Args:
        place: position of the raster.
        rows: number of raster rows per pixel of the image; more than 1 for a preview.
        columns: number of raster columns per pixel of the image.
    """
    across_m, down_m = columns * place.gsd_m, place.down * rows * place.gsd_m
    first = (place.corner_m[0] + 0.5 * across_m, place.corner_m[1] + 0.5 * down_m)
    numbers = (across_m, 0.0, 0.0, down_m, *first)
    return "".join(f"{number!r}\n" for number in numbers)


def read_raster(path: Path) -> RasterFile:
    """Read a GeoTIFF from orthoflow or another program.

    Raises:
        InputError: GDAL cannot read the file, it is too large, or its cells are not square or not
            aligned with the axes.
    """
    with RasterParts(path) as raster:
        rows, columns = raster.shape
        # Check the declared size before memory is allocated.
        if rows * columns > MOST_CELLS or raster.bands > MOST_BANDS:
            raise InputError(
                f"{path.name} is too large: {columns} x {rows} cells in {raster.bands} bands; "
                f"the limit is {MOST_CELLS} cells and {MOST_BANDS} bands; export it with larger "
                "cells or in parts"
            )
        values, shown = raster.read((0.0, 0.0, float(columns), float(rows)), raster.shape)
        header = raster.header()
    return RasterFile(
        values=values, shown=shown, place=raster.place, tags=header.tags, crs_wkt=header.wkt
    )


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Convert GDAL errors that occur while a file is read into errors that name the file.

    Raises:
        InputError: the file cannot be read.
    """
    import rasterio
    from rasterio.errors import RasterioError

    try:
        with quiet(), rasterio.Env(GDAL_CACHEMAX=_CACHE_BYTES):
            yield
    except (RasterioError, OSError, UnicodeDecodeError) as error:
        # UnicodeDecodeError is caught because GDAL's messages and tags can contain bytes of the
        # file.
        raise InputError(
            f"{path} cannot be read as a GeoTIFF: {error}; expected a complete TIFF file"
        ) from error


class RasterParts:
    """A GeoTIFF of any size, read in parts and at the requested resolution.

    Attributes:
        shape: rows and columns.
        place: position of the raster, without its coordinate system.
        bands: number of bands.
        dtype: numpy name of the stored type.
    """

    def __init__(self, path: Path) -> None:
        """Open a file.

        Raises:
            InputError: GDAL cannot read the file, its cells are not square or not aligned with the
                axes, or it declares more cells than its size allows.
        """
        import rasterio

        self._path = path
        with _reading(self._path):
            self._dataset: DatasetReader = rasterio.open(path, driver="GTiff")
            check_header(path, self._dataset)
        transform = self._dataset.transform
        self.shape: tuple[int, int] = (self._dataset.height, self._dataset.width)
        self.place = GridPlace(
            gsd_m=_gsd_m(path, transform),
            corner_m=(float(transform.c), float(transform.f)),
            down=math.copysign(1.0, transform.e),
        )
        self.bands: int = self._dataset.count
        self.dtype: str = self._dataset.dtypes[0]

    @property
    def gsd_m(self) -> float:
        """Return the cell size in metres."""
        return self.place.gsd_m

    @property
    def corner_m(self) -> tuple[float, float]:
        """Return X and Y of the outer corner of the top-left cell."""
        return self.place.corner_m

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._dataset.close()

    def read(
        self, cells: tuple[float, float, float, float], shape: tuple[int, int]
    ) -> tuple[NDArray[np.generic], NDArray[np.bool_]]:
        """Read a part, averaged to fewer pixels.

        Args:
            cells: left, top, right and bottom of the part in cells, possibly fractional.
            shape: requested rows and columns, at most the number of cells.

        Returns:
            (rows, cols[, bands]) values, and (rows, cols) True where the file has content.
        """
        from rasterio.enums import Resampling
        from rasterio.windows import Window

        left, top, right, bottom = cells
        window = Window(left, top, right - left, bottom - top)
        average = Resampling.average
        with _reading(self._path):
            read = self._dataset.read(
                window=window, out_shape=(self.bands, *shape), resampling=average
            )
            shown = self._dataset.dataset_mask(window=window, out_shape=shape)
        values = read[0] if self.bands == 1 else np.moveaxis(read, 0, 2)
        return values, shown > 0

    def header(self) -> RasterPlace:
        """Return the metadata of the file."""
        from rasterio.warp import transform

        dataset = self._dataset
        with _reading(self._path):
            epsg = dataset.crs.to_epsg() if dataset.crs else None
            left, first, right, last = dataset.bounds
            bottom, top = sorted((first, last))
            outline: tuple[tuple[float, float], ...] = ()
            if epsg is not None:
                x, y = (left, right, right, left, left), (bottom, bottom, top, top, bottom)
                lon, lat = transform(dataset.crs, "EPSG:4326", x, y)
                outline = tuple(zip(lon, lat, strict=True))
            return RasterPlace(
                shape=self.shape,
                transform=tuple(dataset.transform)[:6],
                epsg=epsg,
                wkt=dataset.crs.to_wkt() if dataset.crs else "",
                wkt2=dataset.crs.to_wkt(version="WKT2_2019") if dataset.crs else "",
                bounds=(left, bottom, right, top),
                outline_lonlat=outline,
                bands=tuple(dataset.dtypes),
                tags=dict(dataset.tags()),
            )


def check_header(path: Path, dataset: DatasetReader) -> None:
    """Refuse a file that references other files, or declares more data than its size allows.

    Raises:
        InputError: the file references other files or declares too much data.
    """
    # GDAL would read overviews from the referenced file, even over the network.
    if dataset.tags(ns="OVERVIEWS"):
        raise InputError(
            f"{path.name} stores its overviews in another file: expected a self-contained TIFF file"
        )
    declared = dataset.width * dataset.height * dataset.count
    stored = path.stat().st_size
    if declared > max(_ALWAYS_ALLOWED_VALUES, _LARGEST_RATIO * stored):
        raise InputError(
            f"{path.name} declares {dataset.width} x {dataset.height} cells in "
            f"{dataset.count} bands, but its {stored} bytes cannot contain them: export it again"
        )


def _gsd_m(path: Path, transform: Affine) -> float:
    """Return the cell size; cells must be square, with X along the rows and Y along the columns."""
    side = float(transform.a)
    limit = 1e-6 * abs(side)
    if (
        not side > 0.0
        or max(abs(transform.b), abs(transform.d)) > limit
        or abs(abs(transform.e) - side) > limit
    ):
        raise InputError(
            f"{path.name} has cells that are not square or not aligned with the axes (geotransform "
            f"{transform.to_gdal()}): export it again in metres in the plane of the wall, X to "
            "the right, Y upwards"
        )
    low, high = _SIDES_M
    if not low <= side <= high:
        raise InputError(f"{path.name} has cells of {side:g} m; expected {low:g} to {high:g} m")
    return side


def _placed(shape: tuple[int, ...], place: GridPlace) -> dict[str, object]:
    from rasterio.crs import CRS
    from rasterio.transform import Affine

    is_map = place.crs == SITE_CRS or epsg_of(place.crs) is not None
    left_m, top_m = place.corner_m
    return {
        "height": shape[0],
        "width": shape[1],
        "crs": _map_crs(place.crs) if is_map else CRS.from_wkt(local_crs_wkt(place.crs)),
        "transform": Affine(place.gsd_m, 0.0, left_m, 0.0, place.down * place.gsd_m, top_m),
    }


def _write(
    path: Path,
    values: NDArray[np.generic],
    shown: NDArray[np.bool_] | None,
    profile: Mapping[str, object],
    tags: Mapping[str, str],
    icc_profile: bytes | None = None,
) -> None:
    import rasterio
    from rasterio.enums import ColorInterp

    options = {"driver": "GTiff", "tiled": True, "blockxsize": TILE_PX, "blockysize": TILE_PX}
    with rasterio.open(path, "w", BIGTIFF="IF_SAFER", **options, **profile) as dataset:
        if dataset.count == 3:
            dataset.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
        dataset.update_tags(AREA_OR_POINT="Area", **tags)
        if icc_profile is not None:
            text = base64.b64encode(icc_profile).decode()
            dataset.update_tags(ns="COLOR_PROFILE", SOURCE_ICC_PROFILE=text)
        for window in _bands(values.shape):
            rows = _rows(window)
            dataset.write(np.moveaxis(values[rows], 2, 0), window=window)
            if shown is not None:
                dataset.write_mask(shown[rows], window=window)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert GDAL and disk errors that occur in the block into errors that name the file.

    Raises:
        StoreError: the file cannot be written.
    """
    import rasterio
    from rasterio.errors import RasterioError

    try:
        with quiet(), rasterio.Env(GDAL_CACHEMAX=_CACHE_BYTES):
            yield
    except (RasterioError, OSError) as error:
        raise StoreError(f"cannot write {path.name}: {error}; free some disk space") from error


@contextmanager
def quiet() -> Iterator[None]:
    """Prevent GDAL from using other files, and hide rasterio's warnings from the user.

    Masks are written into the file itself. Overviews, masks and metadata in separate files are
    ignored, because they are not part of the file's digest and may reference any other file, even
    on the network.
    """
    import rasterio

    let_go_of_untrusted_text()
    alone = rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True, GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR")
    with warnings.catch_warnings(), alone:
        warnings.simplefilter("ignore")
        yield


@cache
def let_go_of_untrusted_text() -> None:
    """Suppress tracebacks if rasterio cannot decode a file's bytes in a message from GDAL.

    The error occurs in a callback, which cannot raise it, so Python prints it through
    `sys.unraisablehook` or `sys.excepthook`. GDAL's own error about the file is raised afterwards.
    """
    log_unraisable, show_exception = sys.unraisablehook, sys.excepthook

    def log_others(unraisable: sys.UnraisableHookArgs) -> None:
        in_rasterio = "rasterio" in str(unraisable.object)
        if not (in_rasterio and isinstance(unraisable.exc_value, UnicodeDecodeError)):
            log_unraisable(unraisable)

    def show_others(
        kind: type[BaseException], error: BaseException, trace: TracebackType | None
    ) -> None:
        # Errors that end the program have a traceback and are not suppressed.
        if not (trace is None and isinstance(error, UnicodeDecodeError)):
            show_exception(kind, error, trace)

    sys.unraisablehook, sys.excepthook = log_others, show_others


@dataclass(frozen=True, kw_only=True)
class RasterPlace:
    """The metadata of a GeoTIFF.

    Attributes:
        shape: rows and columns.
        transform: X per column, X per row and X of the corner, and the same three numbers for Y.
        epsg: EPSG code of the coordinate system, or None.
        wkt: coordinate system, as returned by GDAL.
        wkt2: coordinate system as WKT 2.
        bounds: lowest X, lowest Y, highest X and highest Y in the coordinate system.
        outline_lonlat: closed ring of the corners, counter-clockwise, longitude and latitude in
            degrees; empty if the coordinate system has no position on Earth.
        bands: data type of each band.
        tags: tags of the dataset.
    """

    shape: tuple[int, int]
    transform: tuple[float, ...]
    epsg: int | None
    wkt: str = ""
    wkt2: str
    bounds: tuple[float, float, float, float]
    outline_lonlat: tuple[tuple[float, float], ...]
    bands: tuple[str, ...]
    tags: Mapping[str, str] = field(default_factory=dict)


def place_of(path: Path) -> RasterPlace:
    """Read the metadata of a GeoTIFF.

    Raises:
        InputError: GDAL cannot read the file, its cells are not square or not aligned with the
            axes, or it declares more data than its size allows.
    """
    with RasterParts(path) as raster:
        return raster.header()
