"""Preparation of points for writing in blocks: selection, colours, planes and normals.

`cloud.json`, next to the point file, describes the points, their colours and their fields.
"""

from __future__ import annotations

import colorsys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.clouds.neighbourhoods import Neighbourhoods, offsets_of
from orthoflow.files.clouds.photo_colours import PointColours
from orthoflow.files.sidecars import numbers, write_json
from orthoflow.geometry.slabs import Slab
from orthoflow.products import JsonValue, Planes, PointCloud, PointLabels

Colouring: TypeAlias = Literal["photos", "rgb", "intensity", "plane", "deviation"]
# Points per block; ten copies of a block need a few hundred megabytes.
BLOCK: Final = 1 << 20
_SCALE_PERCENT: Final = 99.0
_NOTHING: Final = np.zeros(0, dtype=np.float32)


# Columns of a point, in the order in which files store them.
_COLUMNS: Final = {
    **dict.fromkeys("xyz", "<f8"),
    **dict.fromkeys(("nx", "ny", "nz"), "<f4"),
    **dict.fromkeys(("red", "green", "blue"), "|u1"),
    "intensity": "<f4",
    "scan": "<u2",
    "plane": "<i2",
    "deviation": "<f4",
    "photo": "<i2",
}


@dataclass(frozen=True, kw_only=True)
class AttributedCloud:
    """A cloud and the attributes added to its points.

    Attributes:
        cloud: the points.
        colouring: meaning of the colours.
        neighbourhoods: neighbourhoods of the cloud.
        planes: planes of the run; None if there are no planes, and thus no deviations.
        labels: planes or surfaces of the points.
        photo_colours: colours for the colouring `photos`.
        photo_names: names of the photos in `photo_colours`, by number.
        wall: wall to whose raster and buffer the points are restricted, and from whose plane
            deviations are measured; None for all points.
        wall_plane: number of the plane of `wall`.
        box_world: (2, 3) lowest and highest corner of a box; points outside are omitted. None for
            all points.
        is_cleaned: whether isolated points are omitted.
        crs_wkt: coordinate system of the world, as WKT; empty if unknown.
        name: name of the cloud in files.
    """

    cloud: PointCloud
    colouring: Colouring
    neighbourhoods: Neighbourhoods
    planes: Planes | None = None
    labels: PointLabels | None = None
    photo_colours: PointColours | None = None
    photo_names: tuple[str, ...] = ()
    wall: Slab | None = None
    wall_plane: int = -1
    box_world: NDArray[np.float64] | None = None
    is_cleaned: bool = False
    crs_wkt: str = ""
    name: str = "cloud"

    @cached_property
    def scale_m(self) -> float:
        """Return the deviation shown in full colour: the 99th percentile, rounded up to 1-2-5.

        The value is in metres, and is estimated from points in short sections spread over the
        cloud.
        """
        found = [
            deviations[self._chosen(piece, None)]
            for piece in sampled_pieces(len(self.cloud))
            if (deviations := self._deviations(piece)) is not None
        ]
        values = np.abs(np.concatenate(found or [_NOTHING]))
        known = values[np.isfinite(values)]
        return round_scale_m(float(np.percentile(known, _SCALE_PERCENT)) if len(known) else 0.0)

    @property
    def is_empty(self) -> bool:
        """Return whether no point is selected."""
        return not any(self._chosen(part, None).any() for part in self._parts())

    @cached_property
    def scans(self) -> tuple[int, ...]:
        """Return the numbers of the scans that have points before cropping."""
        found: set[int] = set()
        if self.cloud.scan is None:
            return (0,)
        for part in self._parts():
            found.update(np.unique(self.cloud.scan[part]).tolist())
        return tuple(sorted(found))

    def station(self, scan: int) -> NDArray[np.float64] | None:
        """Return the station of a scan (3,); None unless the files contain one for every scan."""
        cloud = self.cloud
        if cloud.stations is None or cloud.stations_source != "file":
            return None
        highest = 0 if cloud.scan is None else self.scans[-1]
        if len(cloud.stations) <= highest:
            return None
        return np.asarray(cloud.stations[scan], dtype=np.float64)

    def bounds_world(self, scan: int | None = None) -> NDArray[np.float64] | None:
        """Return the bounding box (2, 3) of the selected points; None if there are none."""
        found = [
            (world.min(axis=0), world.max(axis=0))
            for part in self._parts()
            if (chosen := self._chosen(part, scan)).any()
            for world in (self.cloud.points_world(part)[chosen],)
        ]
        if not found:
            return None
        return np.array(
            [np.min([low for low, _ in found], axis=0), np.max([high for _, high in found], axis=0)]
        )

    @cached_property
    def columns(self) -> np.dtype[np.void]:
        """Return the columns that are available for this cloud.

        These are world coordinates in metres; unit normals towards the viewer, 0 0 0 where there is
        no surface; colours; intensity, 0 to 1; scan number; plane number, or -1; deviation from the
        plane in metres, positive towards the viewer, or NaN; and number of the photo that provides
        the colour, or -1.
        """
        photos, is_labelled = self.photo_colours, self.labels is not None
        is_known = {
            "intensity": self.cloud.intensity is not None,
            "scan": self.cloud.scan is not None,
            "plane": is_labelled,
            "deviation": self.wall is not None or (is_labelled and self.planes is not None),
            "photo": photos is not None and photos.photo is not None,
        }
        return np.dtype([item for item in _COLUMNS.items() if is_known.get(item[0], True)])

    def blocks(self, scan: int | None = None) -> Iterator[NDArray[np.void]]:
        """Yield the selected points of one or all scans, in order, as (n,) arrays of `columns`."""
        for part in self._parts():
            chosen = self._chosen(part, scan)
            if chosen.any():
                yield self._attributed(part, chosen)

    def _parts(self) -> Iterator[slice]:
        for first in range(0, len(self.cloud), BLOCK):
            yield slice(first, min(first + BLOCK, len(self.cloud)))

    def _chosen(self, part: slice, scan: int | None) -> NDArray[np.bool_]:
        chosen = np.ones(part.stop - part.start, dtype=np.bool_)
        if scan is not None and self.cloud.scan is not None:
            chosen &= np.asarray(self.cloud.scan[part]) == scan
            if not chosen.any():
                return chosen
        if self.wall is not None or self.box_world is not None:
            world = self.cloud.points_world(part)
            if self.box_world is not None:
                low, high = self.box_world
                chosen &= np.all((world >= low) & (world <= high), axis=1)
            if self.wall is not None:
                frame = self.wall.frame
                column, row, depth = frame.wall_from_world(world).T
                chosen &= (column >= 0) & (column <= frame.width)
                chosen &= (row >= 0) & (row <= frame.height)
                chosen &= (depth <= self.wall.front_m) & (depth >= -self.wall.behind_m)
        if self.is_cleaned:
            near = self.neighbourhoods
            chosen &= ~near.alone[near.places(offsets_of(self.cloud, part))]
        return chosen

    def _attributed(self, part: slice, chosen: NDArray[np.bool_]) -> NDArray[np.void]:
        cloud, photos = self.cloud, self.photo_colours
        found = np.empty(np.count_nonzero(chosen), dtype=self.columns)

        def fill(names: Sequence[str], values: NDArray[Any] | None) -> None:
            if values is not None:
                for name, column in zip(names, values.reshape(len(values), -1).T, strict=True):
                    found[name] = column

        world = cloud.points_world(part)[chosen]
        fill(("x", "y", "z"), world)
        fill(("red", "green", "blue"), self._colours(part)[chosen])
        if cloud.intensity is not None:
            intensity = np.asarray(cloud.intensity[part])[chosen]
            found["intensity"] = np.clip(np.nan_to_num(intensity), 0.0, 1.0)
        scan = None if cloud.scan is None else np.asarray(cloud.scan[part])[chosen]
        plane = None if self.labels is None else np.asarray(self.labels.plane_index[part])[chosen]
        deviation_m = self._deviations(part)
        fill(("scan",), scan)
        fill(("plane",), plane)
        fill(("deviation",), None if deviation_m is None else deviation_m[chosen])
        if photos is not None and photos.photo is not None:
            found["photo"] = np.asarray(photos.photo[part])[chosen]
        places = self.neighbourhoods.places(offsets_of(cloud, part)[chosen])
        normal = self.neighbourhoods.normals[places]
        signs = self._signs(world, normal, scan, plane)
        fill(("nx", "ny", "nz"), normal * signs[:, None])
        return found

    def _deviations(self, part: slice) -> NDArray[np.float32] | None:
        """Return signed distances (n,), metres, from the plane of the wall or of each point."""
        if self.wall is not None and self.wall.frame.bend is not None:
            on_wall = self.wall.frame.wall_from_world(self.cloud.points_world(part))
            return np.asarray(on_wall[:, 2], dtype=np.float32)
        if self.wall is not None:
            plane = self.wall.frame.plane
            distances = self.cloud.points_world(part) @ plane.normal - plane.offset_m
            return np.asarray(distances, dtype=np.float32)
        if self.planes is None or self.labels is None:
            return None
        index = np.asarray(self.labels.plane_index[part])
        known = (index >= 0) & (index < len(self.planes))
        deviation = np.full(len(index), np.nan, dtype=np.float32)
        own = index[known]
        world = self.cloud.points_world(part)[known]
        along = np.einsum("ij,ij->i", world, self.planes.normal[own])
        deviation[known] = along - self.planes.offset[own]
        return deviation

    def _colours(self, part: slice) -> NDArray[np.uint8]:
        cloud = self.cloud
        if self.photo_colours is not None:
            return np.asarray(self.photo_colours.rgb[part])
        if self.colouring == "rgb" and cloud.rgb is not None:
            rgb = np.array(cloud.rgb[part])
            if cloud.has_rgb is not None:
                # Points without a colour are grey.
                is_grey = ~np.asarray(cloud.has_rgb[part])
                rgb[is_grey] = np.rint(255.0 * np.clip(greys(cloud, part)[is_grey], 0, 1))[:, None]
            return rgb
        if self.colouring == "deviation":
            deviation_m = self._deviations(part)
            if deviation_m is not None:
                return deviation_colours(deviation_m, self.scale_m)
        low, high = self._grey_range
        grey = np.clip((greys(cloud, part) - low) / max(high - low, 1e-6), 0.0, 1.0)
        if self.colouring == "plane" and self.labels is not None:
            return plane_colours(np.asarray(self.labels.plane_index[part]), self._palette, grey)
        return np.repeat(np.rint(255.0 * grey).astype(np.uint8)[:, None], 3, axis=1)

    def _signs(
        self,
        world: NDArray[np.float64],
        normal: NDArray[np.float32],
        scan: NDArray[np.uint16] | None,
        plane: NDArray[np.int16] | None,
    ) -> NDArray[np.float32]:
        """Return signs (n,) that orient normals towards the scanner.

        If its position is unknown, normals point to the same side as the plane's normal, or upwards
        if there is no plane.
        """
        stations = self.cloud.stations
        towards = np.broadcast_to(self.cloud.up, world.shape)
        if self.station(0) is not None and stations is not None:
            towards = (
                stations[np.zeros(len(world), dtype=np.int64) if scan is None else scan] - world
            )
        elif stations is not None and len(stations) == 1:
            towards = stations[0] - world
        elif plane is not None and self.planes is not None:
            normals = np.vstack([self.planes.normal, self.cloud.up])
            # The indices of curved surfaces follow those of planes.
            towards = normals[np.minimum(plane, len(self.planes))]
        along = np.einsum("ij,ij->i", towards, normal)
        return np.where(along < 0.0, -1.0, 1.0).astype(np.float32)

    @cached_property
    def _grey_range(self) -> tuple[float, float]:
        return grey_range(self.cloud)

    @cached_property
    def _palette(self) -> NDArray[np.float64]:
        # The labels are int16, so the palette is small.
        highest = -1 if self.labels is None else int(self.labels.plane_index.max(initial=-1))
        return np.array([plane_colour(k) for k in range(-1, highest + 1)], dtype=np.float64)


# Successive hues differ by the golden ratio, so planes with similar numbers have different colours.
_HUE_STEP: Final = 0.618033988749895
_SATURATION: Final = 0.6
UNKNOWN: Final = (128, 128, 128)
# The darkest intensity still has this fraction of its plane's colour.
_DARKEST: Final = 0.4
_PIECES: Final = 64
_PIECE: Final = 4096
# Colours of deviations behind, on and in front of the plane.
BEHIND: Final = (33, 102, 172)
ON_PLANE: Final = (247, 247, 247)
BEFORE: Final = (178, 24, 43)


def plane_colour(index: int) -> tuple[int, int, int]:
    """Return the colour (red, green, blue) of a plane by its index in `Planes`; -1 is grey.

    >>> plane_colour(-1), plane_colour(0)
    ((128, 128, 128), (255, 102, 102))
    """
    if index < 0:
        return UNKNOWN
    red, green, blue = colorsys.hsv_to_rgb((index * _HUE_STEP) % 1.0, _SATURATION, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)


def plane_colours(
    plane: NDArray[np.int16], palette: NDArray[np.float64], grey: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Return colours (n, 3) of points on planes, darkened according to the points' brightness.

    Args:
        plane: (n,) number of the plane, or -1.
        palette: (p + 1, 3) results of `plane_colour` for -1, 0, 1 and so on.
        grey: (n,) brightness of the points, 0..1.
    """
    shade = _DARKEST + (1.0 - _DARKEST) * grey
    return np.rint(palette[plane + 1] * shade[:, None]).astype(np.uint8)


def deviation_colours(deviation_m: NDArray[np.float32], full_m: float) -> NDArray[np.uint8]:
    """Return colours (n, 3) of signed distances: blue behind, white on, red in front; grey for NaN.

    >>> deviation_colours(np.array([-0.01, 0.0, 0.02, np.nan], dtype=np.float32), 0.01).tolist()
    [[33, 102, 172], [247, 247, 247], [178, 24, 43], [128, 128, 128]]
    """
    share = np.clip(deviation_m / full_m, -1.0, 1.0).astype(np.float64)
    ends = np.where(share[:, None] < 0.0, np.array(BEHIND), np.array(BEFORE))
    weight = np.abs(np.nan_to_num(share))[:, None]
    mixed = np.rint((1.0 - weight) * np.array(ON_PLANE) + weight * ends)
    return np.where(np.isnan(share)[:, None], UNKNOWN, mixed).astype(np.uint8)


def round_scale_m(largest_m: float) -> float:
    """Round up to 1, 2, 5, 10 ... mm, for a readable scale.

    >>> round_scale_m(0.0031), round_scale_m(0.0), round_scale_m(0.09)
    (0.005, 0.001, 0.1)
    """
    for power in range(-3, 6):
        for step in (1, 2, 5):
            if largest_m <= (scale_m := float(f"{step}e{power}")):
                return scale_m
    return 1e6


def greys(cloud: PointCloud, part: slice) -> NDArray[np.float64]:
    """Return the brightness (n,) of points: square root of intensity, mean of the colours, or 1."""
    if cloud.intensity is not None:
        intensity = np.nan_to_num(np.asarray(cloud.intensity[part], dtype=np.float64))
        return np.sqrt(np.maximum(intensity, 0.0))
    if cloud.rgb is not None:
        grey: NDArray[np.float64] = np.asarray(cloud.rgb[part], dtype=np.float64).mean(axis=1)
        return grey / 255.0
    return np.ones(len(cloud.x[part]))


def grey_range(cloud: PointCloud) -> tuple[float, float]:
    """Return the 1st and 99th percentile of brightness, from sections spread over the cloud."""
    if (cloud.intensity is None and cloud.rgb is None) or not len(cloud):
        return 0.0, 1.0
    sample = np.concatenate([greys(cloud, piece) for piece in sampled_pieces(len(cloud))])
    low, high = np.percentile(sample, (1.0, 99.0))
    return float(low), float(high)


def sampled_pieces(n_points: int) -> list[slice]:
    """Return short, disjoint sections spread over a cloud; they cover a small cloud completely."""
    firsts = range(0, n_points, max(_PIECE, n_points // _PIECES))
    return [slice(k, min(k + _PIECE, n_points)) for k in firsts]


_MEANINGS: Final = {
    "photos": "colour from the oriented photo that shows the point best; 128 128 128 and photo "
    "-1 if no photo shows it",
    "rgb": "colours of the scan",
    "intensity": "square root of the scan's intensity, scaled from its 1st to its 99th percentile",
    "plane": "a hue per plane, shaded by the intensity or, if there is none, by the brightness "
    "of the colour; grey: on no plane",
    "deviation": "distance from the plane, positive towards the viewer; grey: on no plane",
}


def describe_cloud(path: Path, attributed: AttributedCloud, name: str, n_points: int) -> None:
    """Write the description of a cloud next to its file.

    Raises:
        StoreError: the file cannot be written.
    """
    cloud = attributed.cloud
    about: dict[str, JsonValue] = {
        "file": name,
        "points": n_points,
        "points_of_the_cloud": len(cloud),
        "product_digest": attributed.name,
        "coordinates": "metres, in the coordinates of the scan; `up` points upwards",
        "up": numbers(cloud.up),
        "origin_world": numbers(cloud.origin),
        "coordinate_system_wkt": attributed.crs_wkt or None,
        "colour": attributed.colouring,
        "colour_meaning": _MEANINGS[attributed.colouring],
        "normals": (
            "surface normals towards the viewer, from least-squares planes through the points in a "
            f"cube of {3.0 * attributed.neighbourhoods.side_m:.4g} m around each voxel; 0 0 0: no "
            "surface"
        ),
        "cleaned": "points with fewer than 10 neighbours in the surrounding 3 x 3 x 3 cubes, each "
        f"with sides of {3.0 * attributed.neighbourhoods.side_m:.4g} m, are omitted"
        if attributed.is_cleaned
        else None,
        "wall": None
        if attributed.wall is None
        else {"plane_index": attributed.wall_plane, "deviation": "from the plane of this wall"},
        "box_world": None if attributed.box_world is None else numbers(attributed.box_world),
        "scans": [
            {"scan": scan, "station_world": None if place is None else numbers(place)}
            for scan, place in ((scan, attributed.station(scan)) for scan in attributed.scans)
        ],
    }
    if attributed.colouring == "deviation":
        about["colour_scale"] = {
            "unit": "m",
            **{
                f"{place_m:+g}" if place_m else "0": list(colour)
                for place_m, colour in (
                    (-attributed.scale_m, BEHIND),
                    (0.0, ON_PLANE),
                    (attributed.scale_m, BEFORE),
                )
            },
            "none": list(UNKNOWN),
        }
    if attributed.photo_colours is not None and attributed.photo_colours.photo is not None:
        photo = attributed.photo_colours.photo
        counts = np.bincount(np.asarray(photo) + 1, minlength=len(attributed.photo_names) + 1)
        about["photos"] = list(attributed.photo_names)
        about["points_of_the_cloud_by_photo"] = [int(count) for count in counts[1:]]
        about["points_of_the_cloud_unseen"] = int(counts[0])
    write_json(path, about)
