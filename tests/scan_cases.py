"""Scan files as other programs write them, drawn by seed, each with what is right of it.

All show one scene: a painted wall, a floor and a side wall. Every case is a function from a `Draw`,
which chooses numbers, orders, encodings, names and shares, to a `Case`.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.points.units import UNITS_M
from tests import scan_files

T = TypeVar("T")
STATION: Final = np.array([1.5, 0.3, 1.1])


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Points (n, 3) in metres with what is painted on them: reflectance 0..1 and colour."""

    points: NDArray[np.float64]
    reflectance: NDArray[np.float64]
    rgb: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points)

    def part(self, chosen: NDArray[Any] | slice) -> Scene:
        return Scene(
            points=self.points[chosen], reflectance=self.reflectance[chosen], rgb=self.rgb[chosen]
        )

    def halves(self) -> tuple[Scene, Scene]:
        """What lies left and right of x = 1.5, as two scans show it."""
        is_left = self.points[:, 0] < 1.5
        return self.part(is_left), self.part(~is_left)


@dataclass(kw_only=True)
class Case:
    """Files and what is right of them.

    Attributes:
        scene: what the cloud must be, in the order of the files.
        paths: the files.
        params: of `read.scan`.
        shift: of the coordinates.
        atol_m: how far coordinates may be off: the digits of the file.
        intensity: `equal` to the reflectance, an increasing `linear` function of it, or `none`.
        has_intensity: (n,) which points have one; None for all.
        has_linear: (n,) of which of them it is a function of reflectance; None for all.
        rgb: the colours must be the scene's; False: the cloud must have none.
        has_rgb: (n,) which points have a colour; None for all.
        left_out: points that are left out, by cause.
        unit: what `scans.json` must say.
        warnings: parts of what must be reported.
        refusal: parts of the sentence with which the file is refused instead.
    """

    scene: Scene
    paths: list[Path]
    params: dict[str, Any] = field(default_factory=dict)
    shift: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    atol_m: float = 2e-3
    intensity: Literal["equal", "linear", "none"] = "none"
    has_intensity: NDArray[np.bool_] | None = None
    has_linear: NDArray[np.bool_] | None = None
    rgb: bool = False
    has_rgb: NDArray[np.bool_] | None = None
    left_out: dict[str, int] = field(default_factory=dict)
    unit: str = "m"
    warnings: tuple[str, ...] = ()
    refusal: tuple[str, ...] = ()


class Draw:
    """Choices of a case by seed; of seed 0 the first of everything."""

    def __init__(self, seed: int, folder: Path, n_points: int | None = None) -> None:
        self.folder = folder
        self.rng = np.random.default_rng(seed)
        self.is_first = seed == 0
        drawn = 900 if self.is_first else int(self.rng.integers(500, 1500))
        self.scene = paint(self.rng, n_points or drawn)

    def one_of(self, *choices: T) -> T:
        return choices[0] if self.is_first else choices[int(self.rng.integers(len(choices)))]

    def order(self, items: Sequence[T]) -> list[T]:
        places = range(len(items)) if self.is_first else self.rng.permutation(len(items))
        return [items[place] for place in places]

    def shift(self) -> NDArray[np.float64]:
        """Survey coordinates."""
        far = self.one_of([301234.0, 4651234.0, 112.0], [0.0, 0.0, 0.0], [-52310.0, 910.0, -40.0])
        return np.array(far)

    def chosen(self, share: float) -> NDArray[np.bool_]:
        """So many of the points, at least one."""
        mask = self.rng.uniform(size=len(self.scene)) < share
        mask[len(mask) // 2] = True
        return mask


def paint(rng: np.random.Generator, n_points: int) -> Scene:
    """Draw a wall 3 x 2 m at y = 2 with a bar and a square, a floor and a side wall."""
    a, b = rng.uniform(0.02, 0.98, (2, n_points))
    which = np.arange(n_points) % 4
    wall = which < 2
    points = np.where(
        wall[:, None],
        np.column_stack([3 * a, np.full(n_points, 2.0), 2 * b]),
        np.where(
            (which == 2)[:, None],
            np.column_stack([3 * a, 2 * b, np.zeros(n_points)]),
            np.column_stack([np.zeros(n_points), 2 * a, 2 * b]),
        ),
    )
    points += rng.normal(0.0, 0.002, points.shape)
    # None without a return, whatever the noise.
    points = np.round(points, 4) + np.where(np.abs(points) < 1e-4, 1e-3, 0.0)
    x, z = points[:, 0], points[:, 2]
    right = x > 1.5
    bar = (x > 0.4) & (x < 0.8) & (z > 0.3) & (z < 1.7) & wall
    square = (x > 2.2) & (x < 2.7) & (z > 1.3) & (z < 1.8) & wall
    parts = [bar, square, right]
    reflectance = np.select(parts, [0.15, 0.95, 0.35], 0.75)
    reflectance = np.clip(reflectance + rng.normal(0.0, 0.005, n_points), 0.0, 1.0)
    paints = [[180, 30, 30], [40, 60, 220], [90, 110, 70]]
    rgb = np.select([part[:, None] for part in parts], paints, [200, 180, 150])
    rgb = np.clip(rgb + rng.integers(-2, 3, rgb.shape), 0, 255).astype(np.uint8)
    return Scene(points=points, reflectance=reflectance, rgb=rgb)


# Text


def _write_table(
    path: Path,
    columns: Mapping[str, Sequence[object] | NDArray[Any]],
    *,
    separator: str = " ",
    header: str | None = "",
    decimal: str = ".",
    end: str = "\n",
    encoding: str = "utf-8",
    quote: bool = False,
) -> Path:
    """Write columns; `header` None for none, empty for their names."""
    rows = [] if header is None else [header or separator.join(columns)]
    for row in zip(*columns.values(), strict=True):
        words = [item if isinstance(item, str) else f"{item:.10g}" for item in row]
        words = [word.replace(".", decimal) for word in words]
        rows.append(separator.join(f'"{word}"' if quote else word for word in words))
    path.write_bytes((end.join(rows) + end).encode(encoding))
    return path


def _xyz(scene: Scene, shift: NDArray[np.float64] | float = 0.0) -> dict[str, NDArray[Any]]:
    return dict(zip("xyz", (scene.points + shift).T, strict=True))


def _rgb(scene: Scene, names: str = "rgb") -> dict[str, NDArray[Any]]:
    return dict(zip(names, scene.rgb.T, strict=True))


def csv_named(draw: Draw) -> Case:
    """A CSV file with header, a column of texts among the numbers."""
    scene = draw.scene
    axes = draw.one_of(
        *("x y z", "X Y Z", "Easting Northing Elevation", "POINT_X POINT_Y POINT_Z"),
        "Rechtswert Hochwert Höhe",
    )
    colours = draw.one_of(
        *("r g b", "Red Green Blue", "R G B", "color_red color_green color_blue"), "Rot Grün Blau"
    )
    separator = draw.one_of(",", ";", "\t", ", ")
    quote = draw.one_of(False, True) and separator != "\t"
    text = draw.one_of("P{}", "Böschung {}", "wall-{}", "", "Wall, north; {}" if quote else "")
    columns: dict[str, Any] = {"name": [text.format(k) for k in range(len(scene))]} if text else {}
    columns |= dict(zip(axes.split(), scene.points.T, strict=True))
    columns |= dict(zip(colours.split(), scene.rgb.T, strict=True))
    has_intensity = draw.one_of(False, True)
    if has_intensity:
        columns[draw.one_of("Intensity", "i", "Reflectance", "Scalar_field")] = (
            scene.reflectance * draw.one_of(1.0, 255.0, 4095.0)
        )
    columns = {name: columns[name] for name in draw.order(list(columns))}
    # The first numbers may all be whole, where others have decimal commas.
    scene.points[0] = draw.one_of(scene.points[0], np.array([1.0, 2.0, 1.0]))
    path = _write_table(
        draw.folder / draw.one_of("named.csv", "named.txt", "named.xyz"),
        columns,
        separator=separator,
        decimal="," if (separator == ";" or quote) and draw.one_of(False, True) else ".",
        end=draw.one_of("\n", "\r\n"),
        encoding=draw.one_of("utf-8", "latin-1", "utf-8-sig"),
        quote=quote,
    )
    intensity: Literal["linear", "none"] = "linear" if has_intensity else "none"
    return Case(scene=scene, paths=[path], rgb=True, intensity=intensity)


def text_header_unknown(draw: Draw) -> Case:
    """A header that does not say which columns are x, y and z."""
    header = draw.one_of(
        "GpsTime Px Py Pz",
        '"intensity","Points:0","Points:1","Points:2"',
        "RelativeTime,Latitude,Longitude,Elevation",
        "Z_up,Y_m,X_m",
        "a;b;c;d",
        "id,lat,lon,height",
    )
    separator = next((mark for mark in ";," if mark in header), " ")
    n_columns = len(header.replace("#", "").replace(separator, " ").split())
    table = {str(k): draw.rng.uniform(0.0, 9.0, 60) for k in range(n_columns)}
    path = _write_table(
        draw.folder / draw.one_of("a.txt", "a.csv"), table, separator=separator, header=header
    )
    words = header.replace("#", "").replace(separator, " ").replace('"', "").split()
    return Case(scene=draw.scene, paths=[path], refusal=("cloud.columns", *words))


def text_names_twice(draw: Draw) -> Case:
    """Other columns whose names may stand for a coordinate or the intensity, too."""
    scene = draw.scene
    other = draw.rng.uniform(0.0, 9.0, (len(scene), 3)).round(3)
    names = draw.one_of(("N",), ("H",), ("i",), ("E", "N"), ("I", "J", "K"), ("Height",))
    columns: dict[str, Any] = dict(zip(names, other.T, strict=False))
    has_intensity = draw.one_of(True, False) or names == ("i",)
    columns |= dict(zip(draw.one_of("XYZ", "xyz"), scene.points.T, strict=True))
    if has_intensity:
        columns["Intensity"] = scene.reflectance
    columns = {name: columns[name] for name in draw.order(list(columns))}
    path = _write_table(draw.folder / "a.csv", columns, separator=draw.one_of(",", " ", ";"))
    return Case(scene=scene, paths=[path], intensity="linear" if has_intensity else "none")


def text_index_first(draw: Draw) -> Case:
    """A first column 1, 2, 3 ... with and without a name."""
    scene = draw.scene
    numbers = np.arange(len(scene)) + draw.one_of(1, 0, 1001)
    columns = {draw.one_of("OBJECTID", "id", "Point No", "//nr"): numbers, **_xyz(scene)}
    has_rgb = draw.one_of(False, True)
    if has_rgb:
        columns |= _rgb(scene)
    path = _write_table(
        draw.folder / "points.csv",
        columns,
        separator=draw.one_of(",", ";"),
        header=draw.one_of("", None),
    )
    return Case(scene=scene, paths=[path], rgb=has_rgb)


def text_not_a_number(draw: Draw) -> Case:
    """NaN and infinity in every spelling."""
    scene = draw.scene
    lost = draw.chosen(draw.one_of(0.02, 0.3, 0.0))
    spellings = ["-nan(ind)", "nan", "NaN", "-nan", "1.#QNAN", "-1.#IND00", "1.#INF", "inf"]
    spellings += ["-Infinity", "nan(snan)", "NAN", "#NUM!", "#N/A", "n/a", "NA", "null"]
    spelling = draw.one_of(*spellings)
    columns: dict[str, Any] = {**_xyz(scene), **_rgb(scene)}
    for name in draw.one_of(("x", "y", "z"), ("z",), ("x", "y")):
        columns[name] = [
            spelling if is_lost else f"{value:.4f}"
            for value, is_lost in zip(columns[name], lost, strict=True)
        ]
    path = _write_table(
        draw.folder / draw.one_of("a.xyz", "a.csv", "a.txt"),
        columns,
        separator=draw.one_of(" ", ",", ";"),
        header=draw.one_of(None, ""),
    )
    n_lost = int(lost.sum())
    return Case(
        scene=scene.part(~lost),
        paths=[path],
        rgb=True,
        left_out={"not_finite": n_lost},
        warnings=(f"{n_lost} points",),
    )


def text_normals(draw: Draw) -> Case:
    """Normals without a header are no colours."""
    scene = draw.scene
    normals = draw.rng.normal(size=(len(scene), 3)) * 0.05 + [0.0, -1.0, 0.0]
    normals = np.round(normals / np.linalg.norm(normals, axis=1)[:, None], 3)
    parts: list[dict[str, Any]] = [dict(zip(("nx", "ny", "nz"), normals.T, strict=True))]
    has_rgb = draw.one_of(False, True)
    if has_rgb:
        parts.append(_rgb(scene))
    columns: dict[str, Any] = _xyz(scene)
    for part in draw.order(parts):
        columns |= part
    path = _write_table(
        draw.folder / "normals.xyz",
        columns,
        separator=draw.one_of(" ", ",", "\t"),
        header=draw.one_of(None, "", "//X Y Z Nx Ny Nz" if not has_rgb else None),
    )
    return Case(scene=scene, paths=[path], rgb=has_rgb)


def text_units(draw: Draw) -> Case:
    """Units in comments and in the names of columns; the user's word wins."""
    scene, unit = draw.scene, draw.one_of("ft", "us-ft", "mm", "cm")
    spelled = {
        "ft": ("ft", "feet", "international feet"),
        "us-ft": ("us-ft", "US survey feet", "ftUS"),
        "mm": ("mm", "millimetres", "millimeters"),
        "cm": ("cm", "centimetres", "centimeters"),
    }[unit]
    word = draw.one_of(*spelled)
    header = draw.one_of(
        f"X [{word}],Y [{word}],Z [{word}]",
        f"# units: {word}\nx,y,z",
        f"x,y,z\n{word},{word},{word}",
    )
    path = _write_table(
        draw.folder / "a.csv",
        _xyz(replace(scene, points=scene.points / UNITS_M[unit])),
        separator=",",
        header=header,
    )
    return Case(scene=scene, paths=[path], unit=unit)


def pts_two_scanners(draw: Draw) -> Case:
    """Two PTS files of scanners whose intensities have other ranges."""
    ranges = draw.order([(-2048.0, 2047.0), (0.0, 255.0)])
    paths = []
    halves = draw.scene.halves()
    for name, half, (low, high) in zip("ab", halves, ranges, strict=True):
        intensity = np.rint(low + half.reflectance * (high - low))
        columns = {**_xyz(half), "i": intensity, **_rgb(half)}
        path = draw.folder / f"{name}.pts"
        paths.append(_write_table(path, columns, header=str(len(half))))
    scene = joined(halves)
    return Case(scene=scene, paths=paths, intensity="equal", rgb=True, warnings=("range",))


def joined(scenes: Sequence[Scene]) -> Scene:
    """Points of several scans, one after the other."""
    names = ("points", "reflectance", "rgb")
    return Scene(**{name: np.concatenate([getattr(s, name) for s in scenes]) for name in names})


# E57


def _e57_fields(
    scene: Scene,
    shift: NDArray[np.float64] | float = 0.0,
    *,
    intensity: float | None = 1.0,
    low: float = 0.0,
    rgb: float | None = 1.0,
) -> dict[str, Any]:
    fields = scan_files.cartesian(scene.points + shift)
    if intensity is not None:
        fields["intensity"] = low + scene.reflectance * (intensity - low)
    if rgb is not None:
        names = ("colorRed", "colorGreen", "colorBlue")
        values = np.rint(scene.rgb.astype(np.float64).T * rgb)
        fields |= dict(zip(names, values, strict=True))
    return fields


def e57_colour_invalid(draw: Draw) -> Case:
    """Points whose colour is flagged invalid, and written as black."""
    scene = draw.scene
    lost = draw.chosen(draw.one_of(0.3, 0.05, 0.9))
    fields = _e57_fields(scene)
    for name in ("colorRed", "colorGreen", "colorBlue"):
        fields[name] = np.where(lost, draw.one_of(0, 255), fields[name])
    fields["isColorInvalid"] = lost
    has_intensity = np.ones(len(scene), dtype=np.bool_)
    if draw.one_of(False, True):
        has_intensity = ~draw.chosen(0.2)
        fields["isIntensityInvalid"] = ~has_intensity
        fields["intensity"] = np.where(has_intensity, fields["intensity"], 0.0)
    if draw.one_of(False, True):
        fields["cartesianInvalidState"] = np.zeros(len(scene))
    path = scan_files.write_e57(
        draw.folder / "a.e57",
        [{"fields": fields, "intensity_limits": (0.0, 1.0), "rgb_limit": 255}],
    )
    return Case(
        scene=scene,
        paths=[path],
        rgb=True,
        has_rgb=~lost,
        intensity="equal",
        has_intensity=has_intensity,
        warnings=(f"{int(lost.sum())} points", "colour"),
    )


def e57_colour_limit_wrong(draw: Draw) -> Case:
    """A colour limit that the data do not fit is named and not used."""
    limit, scale = draw.one_of((1, 1.0), (65535, 1.0), (255, 257.0), (4095, 1.0))
    path = scan_files.write_e57(
        draw.folder / "a.e57", [{"fields": _e57_fields(draw.scene, rgb=scale), "rgb_limit": limit}]
    )
    return Case(
        scene=draw.scene,
        paths=[path],
        rgb=True,
        intensity="linear",
        warnings=(str(limit), "colours reach at most"),
    )


def e57_scan_without(draw: Draw) -> Case:
    """One of several scans has no colour, or no intensity."""
    left, right = draw.scene.halves()
    scenes = [left, right] if draw.one_of(True, False) else [right, left]
    lacks = draw.one_of("colour", "intensity")
    place = draw.one_of(1, 0)
    scans = []
    for k, scene in enumerate(scenes):
        fields = _e57_fields(
            scene,
            intensity=None if lacks == "intensity" and k == place else 1.0,
            rgb=None if lacks == "colour" and k == place else 1.0,
        )
        scans.append({"fields": fields, "intensity_limits": (0.0, 1.0), "rgb_limit": 255})
    path = scan_files.write_e57(draw.folder / "a.e57", scans)
    has = np.concatenate([np.full(len(scene), k != place) for k, scene in enumerate(scenes)])
    return Case(
        scene=joined(scenes),
        paths=[path],
        rgb=True,
        has_rgb=has if lacks == "colour" else None,
        intensity="equal",
        has_intensity=has if lacks == "intensity" else None,
        warnings=(f"scan {place}", f"no {lacks}", str(len(scenes[place]))),
    )


def e57_two_depths(draw: Draw) -> Case:
    """Scans of one file with colours of different depth."""
    scenes = draw.scene.halves()
    depths = draw.order(draw.one_of([(255, 1.0), (65535, 257.0)], [(255, 1.0), (65535, 256.0)]))
    scans = []
    for scene, (limit, scale) in zip(scenes, depths, strict=True):
        scans.append({"fields": _e57_fields(scene, rgb=scale)})
        if draw.one_of(True, False):
            scans[-1]["rgb_limit"] = limit
    path = scan_files.write_e57(draw.folder / "a.e57", scans)
    return Case(scene=joined(scenes), paths=[path], rgb=True, intensity="linear")


def e57_two_intensity_limits(draw: Draw) -> Case:
    """Scans of one file with intensity limits of their own."""
    scenes = draw.scene.halves()
    limits = [(0.0, 1.0), (0.0, 65535.0), (-2048.0, 2047.0), (0.0, 255.0), (0.0, 100.0)]
    chosen = draw.order(limits)[:2]
    scans = [
        {"fields": _e57_fields(scene, intensity=high, low=low), "intensity_limits": (low, high)}
        for scene, (low, high) in zip(scenes, chosen, strict=True)
    ]
    path = scan_files.write_e57(draw.folder / "a.e57", scans)
    return Case(scene=joined(scenes), paths=[path], rgb=True, intensity="equal")


def e57_not_finite(draw: Draw) -> Case:
    """Coordinates that are not finite, with or without a pose of the scan."""
    scene = draw.scene
    lost = draw.chosen(draw.one_of(0.1, 0.5))
    fields = _e57_fields(scene, -STATION)
    for name in draw.one_of(("cartesianY",), ("cartesianX", "cartesianY", "cartesianZ")):
        fields[name] = np.where(lost, draw.one_of(np.nan, np.inf, -np.inf), fields[name])
    scan = {"fields": fields, "intensity_limits": (0.0, 1.0), "rgb_limit": 255}
    scan |= {"rotation": (1.0, 0.0, 0.0, 0.0), "translation": STATION}
    return Case(
        scene=scene.part(~lost),
        paths=[scan_files.write_e57(draw.folder / "a.e57", [scan])],
        rgb=True,
        intensity="equal",
        left_out={"not_finite": int(lost.sum())},
        warnings=("not finite",),
    )


# Points without a return, in any format


def points_at_zero(draw: Draw) -> Case:
    """Points without a return written as 0 0 0 without a flag: one, a tenth, half, most."""
    scene, shift = draw.scene, draw.shift()
    share = draw.one_of(0.5, 0.1, 0.0, 0.8)
    n_lost = max(1, int(share / (1.0 - share) * len(scene)))
    places = np.sort(draw.rng.integers(0, len(scene) + 1, n_lost))

    def with_zeros(values: NDArray[Any], fill: float = 0.0) -> NDArray[Any]:
        return np.insert(values.astype(np.float64), places, fill, axis=0)

    points, greys = with_zeros(scene.points + shift), with_zeros(scene.reflectance)
    rgb = with_zeros(scene.rgb)
    all_of = Scene(points=points, reflectance=greys, rgb=rgb.astype(np.uint8))
    kind = draw.one_of("e57", "ply", "pcd", "las", "laz", "xyz", "pts", "ptx")
    path = draw.folder / f"zeros.{kind}"
    if kind == "e57":
        scan_files.write_e57(path, [{"fields": _e57_fields(all_of), "intensity_limits": (0, 1)}])
    elif kind == "ply":
        fields = {**_xyz(all_of), **_rgb_named(all_of), "intensity": greys}
        scan_files.write_ply(path, fields, encoding=draw.one_of(*_PLY_ENCODINGS))
    elif kind == "pcd":
        fields = {**_xyz(all_of), **_rgb(all_of), "intensity": greys}
        scan_files.write_pcd(path, fields, data=draw.one_of("binary", "ascii", "binary_compressed"))
    elif kind in ("las", "laz"):
        # Coordinates of LAS count from an offset, here that of the file's world.
        _write_las(path, all_of, offset=np.zeros(3), scale=0.005)
    elif kind == "ptx":
        table = np.column_stack([points, greys, rgb])
        scan_files.write_ptx(path, [(table, 1, np.eye(4))])
    else:
        columns: dict[str, Any] = {**_xyz(all_of), "intensity": greys, **_rgb(all_of)}
        header = str(len(points)) if kind == "pts" else None
        _write_table(path, columns, header=header if kind == "pts" else "")
    return Case(
        scene=scene,
        paths=[path],
        shift=shift,
        atol_m=0.004,
        rgb=True,
        intensity="linear",
        left_out={"no_return": n_lost},
    )


def points_at_one_place(draw: Draw) -> Case:
    """Points without a return that were moved with the scan, to its scanner or a file's offset."""
    scene, shift = draw.scene, draw.shift()
    n_lost = round(draw.one_of(1.0, 0.2, 4.0) * len(scene))
    places = np.sort(draw.rng.integers(0, len(scene) + 1, n_lost))
    all_of = Scene(
        points=np.insert(scene.points + shift, places, STATION + shift, axis=0),
        reflectance=np.insert(scene.reflectance, places, 0.0),
        rgb=np.insert(scene.rgb, places, 0, axis=0),
    )
    kind = draw.one_of("las", "xyz", "ply", "laz")
    path = draw.folder / f"a.{kind}"
    if kind == "ply":
        scan_files.write_ply(path, {**_xyz(all_of), **_rgb_named(all_of)})
    elif kind == "xyz":
        _write_table(path, {**_xyz(all_of), **_rgb(all_of)})
    else:
        _write_las(path, all_of, offset=STATION + shift, intensity=np.zeros(len(all_of)))
    return Case(
        scene=scene,
        paths=[path],
        shift=shift,
        rgb=True,
        left_out={"one_place": n_lost},
        warnings=(f"{n_lost} points are at exactly",),
    )


# LAS


def _write_las(
    path: Path,
    scene: Scene,
    *,
    offset: NDArray[np.float64],
    scale: float = 0.0001,
    intensity: NDArray[Any] | None = None,
    rgb: bool = True,
    extra: Mapping[str, NDArray[Any]] | None = None,
    vlrs: Sequence[Any] = (),
    version: str = "1.4",
    factor: int = 256,
) -> Path:
    import laspy

    point_format = (7 if rgb else 6) if version == "1.4" else (2 if rgb else 0)
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.offsets, header.scales = offset, np.full(3, scale)
    for name, values in (extra or {}).items():
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=values.dtype))
    header.vlrs.extend(vlrs)
    las = laspy.LasData(header)
    las.x, las.y, las.z = scene.points.T
    grey = scene.reflectance * 65535.0 if intensity is None else intensity
    las.intensity = np.rint(grey).astype(np.uint16)
    if rgb:
        las.red, las.green, las.blue = scene.rgb.astype(np.uint16).T * factor
    for name, values in (extra or {}).items():
        las[name] = values
    las.write(path)
    return path


def las_bounds_stale(draw: Draw) -> Case:
    """Bounds of another place, or fewer points stated than there are."""
    scene, shift = draw.scene, draw.shift()
    moved = replace(scene, points=scene.points + shift)
    kind = draw.one_of("las", "laz")
    path = _write_las(draw.folder / f"a.{kind}", moved, offset=np.floor(shift), version="1.2")
    content = bytearray(path.read_bytes())
    away = draw.one_of(-1000.0, 250.0, 1e5)
    bounds = np.array(struct.unpack_from("<6d", content, 179)) + away
    struct.pack_into("<6d", content, 179, *bounds)
    path.write_bytes(bytes(content))
    return Case(
        scene=scene,
        paths=[path],
        shift=shift,
        rgb=True,
        intensity="linear",
        warnings=("outside the bounding box",),
    )


def las_count_stale(draw: Draw) -> Case:
    """Points were appended, and the header still states the number before."""
    scene = draw.scene
    path = _write_las(draw.folder / "a.las", scene, offset=np.zeros(3), version="1.2")
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, 107, draw.one_of(len(scene) // 2, 1, len(scene) - 1))
    path.write_bytes(bytes(content))
    return Case(
        scene=scene, paths=[path], rgb=True, intensity="linear", warnings=(str(len(scene)),)
    )


def colours_of_few_bits(draw: Draw) -> Case:
    """Colours of 10 or 12 bits in fields of 16, without a limit."""
    scene = draw.scene
    most = draw.one_of(1023, 4095)
    scene.rgb[:10] = 255
    deep = np.rint(scene.rgb / 255.0 * most).astype(np.uint16)
    path = draw.folder / draw.one_of("a.las", "a.ply", "a.xyz")
    if path.suffix == ".las":
        deep_scene = replace(scene, rgb=deep)
        _write_las(path, deep_scene, offset=np.zeros(3), factor=1, intensity=np.zeros(len(scene)))
    else:
        colours = dict(zip(("red", "green", "blue"), deep.T, strict=True))
        write = scan_files.write_ply if path.suffix == ".ply" else _write_table
        write(path, {**_xyz(scene), **colours})
    return Case(scene=scene, paths=[path], rgb=True, warnings=(f"colours, which reach {most}",))


def las_feet(draw: Draw) -> Case:
    """Feet by GeoTIFF keys or WKT, also with heights in another unit."""
    import laspy
    import pyproj

    level, height, epsg = draw.one_of(
        ("us-ft", "us-ft", 2260),
        ("ft", "ft", 2222),
        ("us-ft", "us-ft", 2229),
        ("us-ft", "m", 2260),
        ("m", "us-ft", 32618),
    )
    vertical = {"us-ft": 6360, "m": 5703, "ft": 8228}[height]
    how = draw.one_of("keys", "wkt", "wkt behind the points", "citation")
    if how == "citation" and level != height:
        how = "keys"
    if how == "citation":
        foot = {"us-ft": "US survey foot", "ft": "foot", "m": "metre"}[level]
        text = f"PCS Name = site|Linear unit = {foot}|"
        record = laspy.VLR("LASF_Projection", 34737, "", text.encode() + b"\0")
    elif how == "keys":
        codes = {"m": 9001, "ft": 9002, "us-ft": 9003}
        keys = [(1024, 1), (3072, epsg), (3076, codes[level])]
        if height != level or draw.one_of(False, True):
            keys.append((4099, codes[height]))
        words = [1, 1, 0, len(keys)]
        for key, value in keys:
            words += [key, 0, 1, value]
        record = laspy.VLR("LASF_Projection", 34735, "", struct.pack(f"<{len(words)}H", *words))
    else:
        crs = pyproj.CRS.from_epsg(epsg)
        if height != level or draw.one_of(False, True):
            crs = pyproj.CRS.from_user_input(f"EPSG:{epsg}+{vertical}")
        text = crs.to_wkt(draw.one_of("WKT1_GDAL", "WKT2_2019"))
        record = laspy.VLR("LASF_Projection", 2112, "", text.encode() + b"\0")
    scene = draw.scene
    metres = np.array([UNITS_M[level], UNITS_M[level], UNITS_M[height]])
    in_feet = replace(scene, points=scene.points / metres)
    path = _write_las(
        draw.folder / draw.one_of("a.las", "a.laz"),
        in_feet,
        offset=np.zeros(3),
        vlrs=[] if how == "wkt behind the points" else [record],
    )
    if how == "wkt behind the points":
        _append_record(path, record)
    params: dict[str, Any] = {}
    unit = level if level == height else f"{level}/{height}"
    if draw.one_of(False, True):
        # What the user says wins over what the file states.
        params, unit = {"unit": "m"}, "m"
        scene = in_feet
    return Case(scene=scene, paths=[path], rgb=True, intensity="linear", params=params, unit=unit)


def _append_record(path: Path, record: Any) -> None:
    """Add a record behind the points, which LAS 1.4 allows."""
    content, data = bytearray(path.read_bytes()), record.record_data
    struct.pack_into("<QI", content, 235, len(content), 1)
    struct.pack_into("<H", content, 6, 0x11)
    head = struct.pack("<H16sHQ32s", 0, b"LASF_Projection", record.record_id, len(data), b"")
    path.write_bytes(bytes(content) + head + data)


def las_degrees(draw: Draw) -> Case:
    """Geographic coordinates are refused, with the way out."""
    import laspy
    import pyproj

    text = pyproj.CRS.from_epsg(draw.one_of(4326, 4979, 4258)).to_wkt("WKT2_2019")
    record = laspy.VLR("LASF_Projection", 2112, "", text.encode())
    path = _write_las(draw.folder / "a.las", draw.scene, offset=np.zeros(3), vlrs=[record])
    return Case(scene=draw.scene, paths=[path], refusal=("degrees", "cloud.unit"))


def las_extra_intensity(draw: Draw) -> Case:
    """Intensity 0, and fields of the scanner's maker that hold it."""
    scene = draw.scene
    names = draw.one_of(("Reflectance", "Amplitude"), ("reflectance", "Deviation"), ("Amplitude",))
    # Reflectance of this maker is in decibels.
    extra = {names[0]: (scene.reflectance * 20.0 - 15.0).astype(np.float32)}
    extra |= {name: draw.rng.uniform(0.0, 9.0, len(scene)).astype(np.float32) for name in names[1:]}
    wants = draw.one_of(False, True)
    path = _write_las(
        draw.folder / draw.one_of("a.las", "a.laz"),
        scene,
        offset=np.zeros(3),
        intensity=draw.rng.uniform(0.0, 9.0, len(scene)) if wants else np.zeros(len(scene)),
        extra={name: extra[name] for name in draw.order(list(extra))},
        rgb=draw.one_of(False, True),
    )
    params = {"intensity_field": draw.one_of(names[0], names[0].upper())} if wants else {}
    import laspy

    has_rgb = laspy.read(path).header.point_format.id == 7
    return Case(scene=scene, paths=[path], rgb=has_rgb, intensity="linear", params=params)


def one_reflector(draw: Draw) -> Case:
    """A few points of a reflector set no scale."""
    scene = draw.scene
    low, high = draw.one_of((300.0, 1800.0), (20.0, 90.0), (1000.0, 9000.0))
    grey = np.rint(low + scene.reflectance * (high - low))
    places = draw.rng.choice(len(scene), draw.one_of(5, 1, 3), replace=False)
    grey[places] = 65535
    is_usual = np.ones(len(scene), dtype=np.bool_)
    is_usual[places] = False
    kind = draw.one_of("las", "ply", "pcd", "xyz", "e57")
    path = draw.folder / f"a.{kind}"
    if kind == "las":
        _write_las(path, scene, offset=np.zeros(3), intensity=grey, rgb=False)
    elif kind == "e57":
        fields = {**_e57_fields(scene, rgb=None), "intensity": grey}
        scan_files.write_e57(path, [{"fields": fields, "intensity_limits": (0.0, 65535.0)}])
    elif kind == "xyz":
        _write_table(path, {**_xyz(scene), "intensity": grey})
    else:
        fields = {**_xyz(scene), "intensity": grey.astype(np.float32)}
        (scan_files.write_ply if kind == "ply" else scan_files.write_pcd)(path, fields)
    return Case(scene=scene, paths=[path], intensity="linear", has_linear=is_usual)


# PLY and PCD

_PLY_ENCODINGS: Final = ("binary_little_endian", "binary_big_endian", "ascii")


def _rgb_named(scene: Scene, names: str = "red green blue") -> dict[str, NDArray[Any]]:
    return dict(zip(names.split(), scene.rgb.T, strict=True))


def ply_lists(draw: Draw) -> Case:
    """A list property somewhere among the others, and names of colours that programs use."""
    scene = draw.scene
    encoding = draw.one_of(*_PLY_ENCODINGS)
    order = {"ascii": "", "binary_big_endian": ">"}.get(encoding, "<")
    names = draw.one_of("red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b")
    axis_kind, axis_name = draw.one_of(("f4", "float"), ("f8", "double"), ("f4", "float32"))
    members = [(name, axis_kind, f"property {axis_name} {name}") for name in "xyz"]
    members += [
        (name, "u1", f"property {draw.one_of('uchar', 'uint8')} {name}") for name in names.split()
    ]
    item = draw.one_of(("u4", "uint"), ("i4", "int"), ("f4", "float"))
    listed = ("list", item[0], f"property list uchar {item[1]} view_indices")
    place = draw.one_of(len(members), 0, 3)
    members.insert(place, listed)
    values = {**_xyz(scene), **dict(zip(names.split(), scene.rgb.T, strict=True))}
    body = io.BytesIO()
    for k in range(len(scene)):
        count = int(draw.rng.integers(0, 4))
        words = []
        for name, kind, _ in members:
            numbers = [count, *range(count)] if name == "list" else [values[name][k]]
            kinds = ["u1", *[kind] * count] if name == "list" else [kind]
            if order:
                for number, one in zip(numbers, kinds, strict=True):
                    body.write(np.array(number, dtype=order + one).tobytes())
            else:
                words += [f"{number:.9g}" for number in numbers]
        body.write((" ".join(words) + "\n").encode() if not order else b"")
    header = [
        "ply",
        f"format {encoding} 1.0",
        *draw.one_of(["comment x"], ["obj_info y"], []),
        f"element vertex {len(scene)}",
        *(line for _, _, line in members),
        "end_header",
    ]
    path = draw.folder / "a.ply"
    path.write_bytes(("\n".join(header) + "\n").encode() + body.getvalue())
    return Case(scene=scene, paths=[path], rgb=True)


def comment_units(draw: Draw) -> Case:
    """PLY and PCD files whose comments state a unit or a coordinate system."""
    unit = draw.one_of("us-ft", "ft", "mm")
    comment = {
        "us-ft": ("units: US survey feet", "EPSG:2260", "unit us-ft"),
        "ft": ("units: feet", "coordinates in ft", "EPSG:2222"),
        "mm": ("unit: mm", "units = millimeters", "length unit mm"),
    }[unit]
    word = draw.one_of(*comment)
    scene = draw.scene
    inside = replace(scene, points=scene.points / UNITS_M[unit])
    kind = draw.one_of("ply", "pcd", "e57")
    path = draw.folder / f"a.{kind}"
    if kind == "ply":
        scan_files.write_ply(path, {**_xyz(inside), **_rgb_named(inside)})
        path.write_bytes(path.read_bytes().replace(b"made by hand", word.encode(), 1))
    elif kind == "pcd":
        scan_files.write_pcd(path, {**_xyz(inside), **_rgb(inside)})
        path.write_bytes(f"# {word}\n".encode() + path.read_bytes())
    else:
        scan = {"fields": _e57_fields(inside, intensity=None)}
        scan_files.write_e57(path, [scan], coordinate_metadata=word)
    return Case(scene=scene, paths=[path], rgb=True, unit=unit)


def pcd_names(draw: Draw) -> Case:
    """PCD files of any first line and capitalisation, with colours in fields of their own."""
    scene = draw.scene
    fields: dict[str, Any] = dict(
        zip(draw.one_of("xyz", "XYZ"), scene.points.astype(np.float32).T, strict=True)
    )
    colours = draw.one_of("red green blue", "Red Green Blue", "r g b", "R G B", "packed", "")
    if colours == "packed":
        parts = scene.rgb.astype(np.uint32)
        bits = (parts[:, 0] << 16) | (parts[:, 1] << 8) | parts[:, 2]
        name = draw.one_of("rgb", "RGB", "rgba")
        fields[name] = bits if draw.one_of(True, False) else bits.view(np.float32)
    elif colours:
        kind = draw.one_of(np.uint8, np.uint16)
        fields |= dict(zip(colours.split(), scene.rgb.astype(kind).T, strict=True))
    has_intensity = draw.one_of(True, False) or not colours
    if has_intensity:
        name = draw.one_of("intensity", "Intensity", "INTENSITY", "i", "Reflectance")
        fields[name] = (scene.reflectance * draw.one_of(1.0, 255.0)).astype(np.float32)
    data = draw.one_of("binary", "ascii", "binary_compressed")
    if data == "ascii" and colours == "packed":
        data = "binary"
    path = scan_files.write_pcd(draw.folder / "a.pcd", fields, data=data)
    content = path.read_bytes()
    first, rest = content.split(b"\n", 1)
    first = draw.one_of(
        b"#.PCD v.7 - Point Cloud Data file format", b"# made by hand", b"", b"# PCD", first
    )
    head, body = rest.split(b"DATA", 1)
    if draw.one_of(False, True):
        head = head.replace(b"HEIGHT 1\n", b"")
    if draw.one_of(False, True):
        head = b"\n".join(
            line.replace(line.split()[0], line.split()[0].lower(), 1) if line.split() else line
            for line in head.split(b"\n")
        )
    path.write_bytes((first + b"\n" if first else b"") + head + b"DATA" + body)
    return Case(
        scene=scene,
        paths=[path],
        rgb=bool(colours),
        intensity="linear" if has_intensity else "none",
    )


# PTX


def _ptx_lines(
    table: NDArray[np.float64], pose: NDArray[np.float64], shape: tuple[int, int]
) -> list[str]:
    lines = [str(shape[0]), str(shape[1])]
    lines += [" ".join(f"{value:.9f}" for value in pose[:3, 3])]
    lines += [" ".join(f"{value:.9f}" for value in pose[:3, axis]) for axis in range(3)]
    lines += [" ".join(f"{value:.9f}" for value in row) for row in pose.T]
    numbers = table.tolist()
    return lines + [
        " ".join([*(f"{value:.6f}" for value in row[:4]), *(f"{value:.0f}" for value in row[4:])])
        for row in numbers
    ]


def ptx_scans(draw: Draw) -> Case:
    """Scans with missing lines, blank lines between them, and one without colour."""
    angle = draw.one_of(0.0, 0.7, -2.0)
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = STATION
    lines: list[str] = []
    scenes = draw.scene.halves()
    lacks = draw.one_of("lines", "colour", "blank", "nothing")
    place = draw.one_of(1, 0)
    has_rgb = []
    kept = []
    for k, half in enumerate(scenes):
        n_points = len(half) // 2 * 2
        scene = half.part(slice(n_points))
        rows, columns = 2, n_points // 2
        if lacks == "lines" and k == place:
            left = draw.rng.uniform(size=n_points) > draw.one_of(0.1, 0.6)
            scene = scene.part(left)
        local = (scene.points - pose[:3, 3]) @ pose[:3, :3]
        table = np.column_stack([local, scene.reflectance, scene.rgb])
        is_grey = lacks == "colour" and k == place
        lines += _ptx_lines(table[:, :4] if is_grey else table, pose, (columns, rows))
        lines += [""] * (draw.one_of(1, 2) if lacks == "blank" else 0)
        has_rgb.append(np.full(len(scene), not is_grey))
        kept.append(scene)
    path = draw.folder / "a.ptx"
    path.write_bytes(draw.one_of("\n", "\r\n").join([*lines, ""]).encode())
    warnings = {"lines": ("lines of points",), "colour": ("no colour",)}.get(lacks, ())
    return Case(
        scene=joined(kept),
        paths=[path],
        rgb=True,
        has_rgb=np.concatenate(has_rgb),
        intensity="equal",
        warnings=warnings,
    )


CASES: Final[Mapping[str, Callable[[Draw], Case]]] = {
    name: function
    for name, function in list(globals().items())
    if getattr(function, "__annotations__", {}).get("return") == "Case"
}
