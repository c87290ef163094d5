"""JSON sidecars of rasters: position of a wall's raster in the world, and meaning of its values."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError, InputError, StoreError
from orthoflow.files.geotiff import GridPlace, RasterParts, local_crs_name
from orthoflow.files.wall_descriptions import ORTHO_FILE, WallDescription, described
from orthoflow.geometry import Bend, ConeBend, CylinderBend, SphereBend, WallFrame
from orthoflow.geometry.frames import FARTHEST_M, RasterAxes
from orthoflow.geometry.levels import eight_bits
from orthoflow.products import JsonValue, LayerMask, OrthoMask, SurfaceMask
from orthoflow.untrusted_text import json_bytes, parse_json, text_of_file

#: bytes of the JSON sidecar of a raster
MOST_SIDECAR_BYTES: Final = 1 << 20
# Wall numbers are stored in 16 bits.
#: largest wall number
MOST_WALLS: Final = 32_000
_LONGEST_SHOWN: Final = 100
_UNIT: Final = 1e-6

SURFACE_MASK_MEANINGS: Final[dict[SurfaceMask, str]] = {
    SurfaceMask.VOID: "void: no point of the scan is in this cell",
    SurfaceMask.MEASURED: "measured: points of the scan are in this cell",
    SurfaceMask.RECOVERED: "recovered: interpolated from neighbouring cells",
}
LAYER_MASK_MEANINGS: Final[dict[LayerMask, str]] = {
    LayerMask.OUTSIDE: "outside: the source does not show this cell",
    LayerMask.PAINTED: "covered: the source shows this cell",
    LayerMask.OCCLUDED: "occluded: an object is in front of it",
    LayerMask.NO_SURFACE: "no surface: the scan has no surface here",
}
ORTHO_MASK_MEANINGS: Final[dict[OrthoMask, str]] = {
    OrthoMask.NONE: "none: no source shows this cell",
    OrthoMask.PAINTED: "covered: a photo or the scan gives its colour",
    OrthoMask.FILLED: "filled: inpainted from neighbouring cells",
    OrthoMask.OCCLUDED: "occluded: hidden in every source",
    OrthoMask.NO_SURFACE: "no surface: the scan has no surface here",
    OrthoMask.CONTRADICTED: "contradicted: covered by a single photo, whose colour differs from "
    "that of the scan",
}


_GEOTIFF: Final[dict[RasterAxes, str]] = {
    "map": "X = x_of_left_m + gsd_m * column (east), Y = y_of_top_m - gsd_m * row (north)",
    "wall": "X = x_of_left_m + gsd_m * column (metres along the wall from its left edge), Y = "
    "height_of_top_m - gsd_m * row (height along up_world)",
    "level": "X = x_of_left_m + gsd_m * column, Y = y_of_top_m - gsd_m * row: the world's "
    "horizontal axes",
    "plane": "X = gsd_m * column, Y = - gsd_m * row: metres in the plane from the top-left corner",
}


_FROM_PLANE: Final = (
    "origin_world + gsd_m * (column * u_world + row * v_world) + depth_m * normal_world"
)
# In this formula, the angle has the sign of the radius, which is negative if `concave` is false.
_FROM_CYLINDER: Final = (
    "origin_world + gsd_m * {straight} * {axis} + (r - depth_m) * sin(angle) * {tangent} + (r - "
    "(r - depth_m) * cos(angle)) * normal_world with r = {sign}radius_m and angle = gsd_m * {bent} "
    "/ r"
)
_FROM_CONE: Final = (
    "apex + (s * sin(h) + d * cos(h)) * (cos(t) * zero_direction + sin(t) * quarter_direction) + "
    "(s * cos(h) - d * sin(h)) * axis with (x, y) = gsd_m * (column, row) - apex_in_raster_m, "
    "s = sqrt(x^2 + y^2), t = (atan2(y, x) - zero_in_raster) / sin(h), with the difference between "
    "-180 and 180 deg, h = half_angle and d = {sign}depth_m"
)
_FROM_SPHERE: Final = (
    "centre + (radius_m + d) * (sin(t) * (x * zero_direction + y * quarter_direction) / s + cos(t) "
    "* pole_direction) with (x, y) = gsd_m * (column, row) - pole_in_raster_m, s = sqrt(x^2 + y^2),"
    " t = s / radius_m in radians and d = {sign}depth_m"
)
_DISTORTION: Final = (
    "a sphere cannot be unrolled: lengths along the meridians through the pole are to scale; "
    "lengths across them, and areas, are t / sin(t) times those on the sphere, with the angle t "
    "from the pole; largest_stretch is the value at the edge"
)


def frame_json(frame: WallFrame) -> dict[str, JsonValue]:
    """Return a wall's raster frame: world = origin + gsd * (column * u + row * v) + depth * n."""
    plane = frame.plane
    placed: dict[str, JsonValue] = {} if frame.map_crs is None else {"map_crs": frame.map_crs}
    if frame.up is not None:
        placed["up_world"] = list(frame.up)
    left_m, top_m = frame.raster_corner_m
    geotiff = _GEOTIFF[frame.raster_axes]
    if frame.raster_down > 0.0:
        geotiff = geotiff.replace(" - gsd_m", " + gsd_m")
    if frame.bend is not None:
        geotiff = geotiff.replace("in the plane", "on the unrolled surface")
    if isinstance(frame.bend, ConeBend):
        geotiff = "X and Y: metres on the unrolled cone from its apex, to the right and up"
    if isinstance(frame.bend, SphereBend):
        geotiff = "X and Y: metres on the developed sphere from its pole, to the right and up"
    return placed | {
        "origin_world": numbers(frame.origin_world),
        "u_world": numbers(frame.u_world),
        "v_world": numbers(frame.v_world),
        "normal_world": numbers(frame.normal_world),
        "gsd_m": frame.gsd_m,
        "width": frame.width,
        "height": frame.height,
        "plane": {"normal": numbers(plane.normal), "offset_m": plane.offset_m},
        "corners_world": numbers(frame.corners_world()),
        # X and Y of the top-left corner; for a wall, distance along it and height, in metres.
        "x_of_left_m": left_m,
        "height_of_top_m" if frame.raster_axes == "wall" else "y_of_top_m": top_m,
        "crs": frame.map_crs or local_crs_name(frame.crs),
        "raster": {
            "world_from_raster": f"{_world_from_raster(frame.bend)}; v_world points down, cell "
            "centres are at .5",
            "geotiff": f"{geotiff}; pixel is area",
        },
        **chart_json(frame),
    }


def chart_json(frame: WallFrame) -> dict[str, JsonValue]:
    """Return the shape of a raster's surface; if it is curved, also its axis and dimensions.

    The zero direction points from the axis to the edge of the raster, left or top, where the arc
    begins, on a cone to the middle of the arc, and on a sphere to the right of the pole. The
    frame's vectors u, v and normal are those at its top-left corner.
    """
    if (bend := frame.bend) is None:
        return {"chart": "plane"}
    return {**_curved_json(frame, bend), "middle_world": numbers(frame.middle_world)}


def _curved_json(
    frame: WallFrame, bend: CylinderBend | ConeBend | SphereBend
) -> dict[str, JsonValue]:
    if isinstance(bend, ConeBend):
        own, local = bend.revolution, frame.axes_world
        zero, quarter, axis = own.axes @ local
        return {
            "chart": "cone",
            "axis": numbers(axis),
            "apex": numbers(frame.origin_world + own.start @ local),
            "half_angle_deg": math.degrees(bend.half_angle_rad),
            "zero_direction": numbers(zero),
            "quarter_direction": numbers(quarter),
            "concave": bend.is_inside,
            "apex_in_raster_m": list(bend.apex_m),
            "zero_in_raster_deg": math.degrees(bend.toward_rad),
            "slants_m": list(bend.slants_m),
            "sector_deg": math.degrees(2.0 * bend.half_sector_rad),
        }
    if isinstance(bend, SphereBend):
        own, local = bend.revolution, frame.axes_world
        zero, quarter, inwards = own.axes @ local
        return {
            "chart": "sphere",
            "centre": numbers(frame.origin_world + own.start @ local),
            "radius_m": bend.radius_m,
            "pole_direction": numbers(-inwards),
            "zero_direction": numbers(zero),
            "quarter_direction": numbers(quarter),
            "concave": bend.is_inside,
            "pole_in_raster_m": list(bend.pole_m),
            "extent_m": bend.most_m,
            "projection": "azimuthal equidistant",
            "largest_stretch": bend.largest_stretch,
            "distortion": _DISTORTION,
        }
    along_u, zero = bend.along == "u", frame.normal_world * math.copysign(1.0, -bend.radius_m)
    return {
        "chart": "cylinder",
        "axis": numbers(-frame.v_world if along_u else frame.u_world),
        "point": numbers(frame.origin_world + bend.radius_m * frame.normal_world),
        "radius_m": abs(bend.radius_m),
        "zero_direction": numbers(zero),
        "concave": bend.radius_m > 0.0,
        "arc_along": bend.along,
    }


def _world_from_raster(bend: Bend | None) -> str:
    if bend is None:
        return _FROM_PLANE
    if not isinstance(bend, CylinderBend):
        formula = _FROM_SPHERE if bend.revolution.is_sphere else _FROM_CONE
        return formula.format(sign="-" if bend.is_concave else "")
    bent, straight = ("column", "row") if bend.along == "u" else ("row", "column")
    tangent, axis = ("u_world", "v_world") if bend.along == "u" else ("v_world", "u_world")
    return _FROM_CYLINDER.format(
        straight=straight,
        axis=axis,
        tangent=tangent,
        bent=bent,
        sign="" if bend.radius_m > 0.0 else "-",
    )


def _bend_of(
    content: Mapping[str, object], name: str
) -> CylinderBend | ConeBend | SphereBend | None:
    """Return the curvature given in a sidecar; None for a plane.

    Raises:
        InputError: the shape of the surface is unknown or incomplete.
        GeometryError: the dimensions of a cone or sphere are impossible.
    """
    chart = content.get("chart", "plane")
    if chart == "plane":
        return None
    if chart == "cone":
        apex_m, slants_m = (_vector(content.get(key)) for key in ("apex_in_raster_m", "slants_m"))
        if apex_m.shape != (2,) or slants_m.shape != (2,):
            raise InputError(f"{name}: a cone needs apex_in_raster_m and slants_m, 2 numbers each")
        half_rad, toward_rad, sector_rad = (
            math.radians(_number(content.get(f"{key}_deg")))
            for key in ("half_angle", "zero_in_raster", "sector")
        )
        return ConeBend(
            apex_m=(float(apex_m[0]), float(apex_m[1])),
            toward_rad=toward_rad,
            half_angle_rad=half_rad,
            is_inside=content.get("concave") is True,
            slants_m=(float(slants_m[0]), float(slants_m[1])),
            half_sector_rad=0.5 * sector_rad,
        )
    if chart == "sphere":
        pole_m = _vector(content.get("pole_in_raster_m"))
        if pole_m.shape != (2,):
            raise InputError(f"{name}: a sphere needs pole_in_raster_m, 2 numbers")
        return SphereBend(
            pole_m=(float(pole_m[0]), float(pole_m[1])),
            radius_m=_number(content.get("radius_m")),
            is_inside=content.get("concave") is True,
            most_m=_number(content.get("extent_m")),
        )
    if chart != "cylinder":
        raise InputError(
            f"{name}: chart must be plane, cylinder, cone or sphere, got {shown_value(chart)}"
        )
    along, radius_m = content.get("arc_along"), _number(content.get("radius_m"))
    if along not in ("u", "v") or not radius_m > 0.0:
        raise InputError(
            f"{name}: a cylinder needs arc_along (u or v) and a positive radius_m, got "
            f"{shown_value(along)} and {shown_value(content.get('radius_m'))}"
        )
    return CylinderBend(
        along="u" if along == "u" else "v",
        radius_m=radius_m if content.get("concave") is True else -radius_m,
    )


def read_sidecar(path: Path) -> dict[str, object]:
    """Read the JSON object next to a raster.

    Raises:
        InputError: the file cannot be read, is too large, or does not contain an object.
    """
    what = "a JSON object with origin_world, u_world ..."
    return sidecar_of(text_of_file(path, MOST_SIDECAR_BYTES, what), path.name)


def sidecar_of(text: str, name: str) -> dict[str, object]:
    """Parse the text of a sidecar.

    Raises:
        InputError: the text is not a JSON object, is nested too deeply, or has too long numbers.
    """
    try:
        content = parse_json(text)
    except ValueError as error:
        raise InputError(f"{name}: not valid JSON, {error}") from error
    if not isinstance(content, dict):
        raise InputError(f"{name}: expected a JSON object with origin_world, u_world ...")
    return content


def shown_value(value: object) -> str:
    """Return a sidecar's value as text for a message, truncated if it is long."""
    text = repr(value)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]} ..."


def frame_of_raster(
    content: Mapping[str, object],
    *,
    raster: GridPlace,
    shape: tuple[int, int],
    name: str,
) -> WallFrame:
    """Return the frame of a GeoTIFF whose X and Y are metres in the plane of a wall.

    Args:
        content: sidecar with `origin_world`, `u_world`, `v_world` (down) and `normal_world` of
            the plane, as written by orthoflow. X increases along u and Y against v, starting from
            the values at the origin: `x_of_left_m` and `height_of_top_m` (or `y_of_top_m`), 0 if
                they are missing, or the map coordinates of the origin if `map_crs` is given.
        raster: position of the GeoTIFF.
        shape: rows and columns of the GeoTIFF.
        name: name of the file in error messages.

    Raises:
        InputError: a vector is missing, or the vectors do not form a frame.
    """
    vectors = {}
    for key in ("origin_world", "u_world", "v_world", "normal_world"):
        vectors[key] = _vector(content.get(key))
        if vectors[key].shape != (3,) or not (np.abs(vectors[key]) < FARTHEST_M).all():
            raise InputError(
                f"{name}: {key} must be three numbers below {FARTHEST_M:g}, got "
                f"{shown_value(content.get(key))}"
            )
    u, v, origin = vectors["u_world"], vectors["v_world"], vectors["origin_world"]
    map_crs, up = content.get("map_crs"), _vector(content.get("up_world"))
    left_m, top_m = (
        _number(content.get("x_of_left_m")),
        _number(content.get("height_of_top_m", content.get("y_of_top_m"))),
    )
    if map_crs is not None:
        left_m, top_m = float(origin[0]), float(origin[1])
    try:
        placed = WallFrame(
            origin_world=origin,
            u_world=u,
            v_world=v,
            normal_world=vectors["normal_world"],
            gsd_m=raster.gsd_m,
            width=shape[1],
            height=shape[0],
            map_crs=None if map_crs is None else str(map_crs),
            up=tuple(up.tolist()) if up.shape == (3,) and abs(up @ up - 1.0) < _UNIT else None,
            name=str(content.get("name", "")),
            bend=_bend_of(content, name),
        )
        if placed.raster_down != raster.down:
            raise InputError(
                f"{name}: its rows run {'up' if raster.down > 0.0 else 'down'} along Y, but the "
                "wall description in the file next to it requires the opposite order: export it "
                "with the row order of orthoflow's GeoTIFF"
            )
        right_m = raster.corner_m[0] - left_m
        below_m = (raster.corner_m[1] - top_m) * raster.down
        if placed.bend is not None:
            corner = (right_m / raster.gsd_m, below_m / raster.gsd_m)
            placed = placed.part(corner, width=shape[1], height=shape[0])
        else:
            placed = replace(placed, origin_world=origin + right_m * u + below_m * v)
        return replace(
            placed,
            left_m=raster.corner_m[0] if placed.raster_axes == "wall" else 0.0,
        )
    except GeometryError as error:
        raise InputError(f"{name}: {error}") from error


def placed_raster(path: Path) -> tuple[WallFrame, dict[str, object]]:
    """Return the frame of a published GeoTIFF, and the content of its sidecar.

    Raises:
        InputError: one of the files cannot be read.
    """
    content = read_sidecar(path.with_suffix(".json"))
    with RasterParts(path) as raster:
        frame = frame_of_raster(
            content,
            raster=raster.place,
            shape=raster.shape,
            name=path.name,
        )
    return frame, content


def _number(value: object) -> float:
    """Return a sidecar's value if it is a number and plausible as a position, else 0."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return 0.0
    return float(value) if abs(value) < FARTHEST_M else 0.0


def _vector(value: object) -> NDArray[np.float64]:
    """Return a list of numbers as an array; an empty array for any other value."""
    if not isinstance(value, list) or any(isinstance(item, bool) for item in value):
        return np.zeros(0)
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0)


def raster_tags(
    frame: WallFrame, *, digest: str, name: str, content: str, extra: Mapping[str, str]
) -> dict[str, str]:
    """Return the tags of a GeoTIFF, which define its world position even without the sidecar."""
    plane = frame.plane
    of_frame = ("map_crs", "up_world", "origin_world", "u_world", "v_world", "normal_world")
    of_raster = ("x_of_left_m", "height_of_top_m", "y_of_top_m")
    of_chart = () if frame.bend is None else tuple(chart_json(frame))
    placed = frame_json(frame)
    return {
        "content": content,
        "frame": json.dumps(
            {key: placed[key] for key in (*of_frame, *of_raster, *of_chart) if key in placed},
            sort_keys=True,
        ),
        "gsd_m": repr(float(frame.gsd_m)),
        "name": name,
        "plane": json.dumps(
            {"normal": numbers(plane.normal), "offset_m": plane.offset_m}, sort_keys=True
        ),
        "product_digest": digest,
        "software": "orthoflow",
        **extra,
    }


def mask_meanings(
    meanings: Mapping[SurfaceMask, str] | Mapping[OrthoMask, str] | Mapping[LayerMask, str],
) -> JsonValue:
    """Return the meanings of mask values by the value as a string, since JSON keys are strings."""
    return {str(int(value)): text for value, text in meanings.items()}


def numbers(values: NDArray[np.generic]) -> JsonValue:
    """Return an array as nested lists for JSON; values that are not finite become None."""
    return _finite(values.tolist())


def number(value: float | None) -> JsonValue:
    """Return a number, or None if it is missing or not finite."""
    return None if value is None or not math.isfinite(value) else float(value)


def write_json(path: Path, content: Mapping[str, JsonValue]) -> None:
    """Write an indented JSON file.

    Raises:
        StoreError: the file cannot be written.
    """
    write_bytes(path, json_bytes(content, indent=2) + b"\n")


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file.

    Raises:
        StoreError: the file cannot be written.
    """
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file.

    Raises:
        StoreError: the file cannot be written.
    """
    try:
        path.write_bytes(content)
    except OSError as error:
        raise StoreError(f"cannot write {path.name}: {error}; free some disk space") from error


def _finite(value: object) -> JsonValue:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_finite(item) for item in value]
    if isinstance(value, bool | int):
        return value
    return number(float(str(value)))


_COLOURS: Final = 3


@dataclass(frozen=True, kw_only=True)
class OrthoFile:
    """A published orthoimage.

    Attributes:
        path: path of the GeoTIFF.
        about: description of the wall, with size and accuracy.
        frame: frame of the raster.
        digest: digest of the product; empty if the sidecar does not contain it.
    """

    path: Path
    about: WallDescription
    frame: WallFrame
    digest: str

    @property
    def wall(self) -> int:
        """Number of the wall."""
        return self.about.number

    @property
    def name(self) -> str:
        """Name of the wall in the run."""
        return self.about.name

    def shrunk(self, longest_px: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return colours (r, c, 3) and content (r, c), averaged to at most `longest_px` per side.

        Raises:
            InputError: the file cannot be read.
        """
        rows, columns = self.frame.shape
        factor = max(1.0, max(rows, columns) / longest_px)
        shape = (max(1, round(rows / factor)), max(1, round(columns / factor)))
        return self.part((0, 0, columns, rows), shape)

    def part(
        self, cells: tuple[int, int, int, int], shape: tuple[int, int]
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return colours (r, c, 3) and their mask (r, c) of a part, averaged to fewer pixels.

        Args:
            cells: left, top, right and bottom of the part in cells.
            shape: requested rows and columns, at most the number of cells.

        Raises:
            InputError: the file cannot be read.
        """
        left, top, right, bottom = map(float, cells)
        with RasterParts(self.path) as raster:
            if raster.bands < _COLOURS or raster.dtype not in ("uint8", "uint16"):
                raise InputError(
                    f"{self.path} has {raster.bands} bands of {raster.dtype}; expected "
                    f"{_COLOURS} bands with 8 or 16 bits"
                )
            bands, shown = raster.read((left, top, right, bottom), shape)
        return eight_bits(np.ascontiguousarray(bands[:, :, :_COLOURS])), shown


def ortho_files(paths: Iterable[Path]) -> tuple[OrthoFile, ...]:
    """Open the orthoimages among the given files, ordered by wall.

    Raises:
        InputError: an orthoimage or its sidecar cannot be read.
    """
    named = [path for path in paths if path.name.startswith("wall_")]
    found = [_opened(path) for path in named if ORTHO_FILE.fullmatch(path.name)]
    return tuple(sorted(found, key=lambda ortho: ortho.wall))


def _opened(path: Path) -> OrthoFile:
    frame, content = placed_raster(path)
    digest = content.get("product_digest")
    return OrthoFile(
        path=path,
        about=described(path, content),
        frame=frame,
        digest=digest if isinstance(digest, str) else "",
    )
