"""Scan files as other programs write them, drawn by seed, each with what is right of it.

All show one scene: a painted wall, a floor and a side wall. Every case is a function from a `Draw`,
which chooses numbers, orders, encodings, names and shares, to a `Case`.
"""

from __future__ import annotations

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


@dataclass(frozen=True)
class Scene:
    """Points (n, 3) in metres with what is painted on them: reflectance 0..1 and colour."""

    points: NDArray[np.float64]
    reflectance: NDArray[np.float64]
    rgb: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points)

    def part(self, chosen: NDArray[Any] | slice) -> Scene:
        return Scene(self.points[chosen], self.reflectance[chosen], self.rgb[chosen])

    def halves(self) -> tuple[Scene, Scene]:
        """What lies left and right of x = 1.5, as two scans show it."""
        is_left = self.points[:, 0] < 1.5
        return self.part(is_left), self.part(~is_left)

    def with_points(self, places: NDArray[np.int64], point: NDArray[np.float64]) -> Scene:
        """The scene with black points at one place, inserted before those of some indices."""
        return Scene(
            np.insert(self.points, places, point, axis=0),
            np.insert(self.reflectance, places, 0.0),
            np.insert(self.rgb, places, 0, axis=0),
        )


@dataclass
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
        has_grid: whether the cloud must have rows and columns; None if it does not matter.
        not_used: fields that must be named as not used.
        left_out: points that are left out, by cause.
        unit: what `scans.json` must say of all scans, in words.
        warnings: parts of what must be reported.
        not_reported: parts of what must not be reported.
        refusal: parts of the sentence with which the file is refused instead.
    """

    scene: Scene
    paths: list[Path]
    params: dict[str, Any] = field(default_factory=dict)
    shift: NDArray[np.float64] | float = 0.0
    atol_m: float = 2e-3
    intensity: Literal["equal", "linear", "none"] = "none"
    has_intensity: NDArray[np.bool_] | None = None
    has_linear: NDArray[np.bool_] | None = None
    rgb: bool = False
    has_rgb: NDArray[np.bool_] | None = None
    has_grid: bool | None = None
    not_used: tuple[str, ...] = ()
    left_out: dict[str, int] = field(default_factory=dict)
    unit: str = "m"
    warnings: tuple[str, ...] = ()
    not_reported: tuple[str, ...] = ()
    refusal: tuple[str, ...] = ()


class Draw:
    """Choices of a case by seed: the first of everything, each of up to three in turn, or drawn.

    Seeds 1 to 3 make each choice among up to three, and each but the first among four.
    """

    def __init__(self, seed: int, folder: Path, n_points: int | None = None) -> None:
        self.folder = folder
        self.rng = np.random.default_rng(seed)
        self.seed, self.n_choices = seed, 0
        self.is_first = seed == 0
        drawn = 900 if self.is_first else int(self.rng.integers(500, 1500))
        self.scene = paint(self.rng, n_points or drawn)

    def one_of(self, *choices: T) -> T:
        self.n_choices += 1
        turns = np.random.default_rng(self.n_choices).permutation(len(choices))
        if len(choices) > 3:
            turns = np.append(0, turns[turns > 0])
        drawn = turns[self.seed % len(turns)] if self.seed < 4 else self.rng.choice(turns)
        return choices[0] if self.is_first else choices[drawn]

    def path(self, *suffixes: str) -> Path:
        return self.folder / f"a.{self.one_of(*suffixes)}"

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

    def places(self, count: int) -> NDArray[np.int64]:
        return np.sort(self.rng.integers(0, len(self.scene) + 1, count))


def paint(rng: np.random.Generator, n_points: int) -> Scene:
    """Draw a wall 3 x 2 m at y = 2 with a bar and a square, a floor and a side wall."""
    a, b = rng.uniform(0.02, 0.98, (2, n_points))
    which = np.arange(n_points) % 4
    zero, wall = np.zeros(n_points), which < 2
    surfaces = ([3 * a, zero + 2.0, 2 * b], [3 * a, 2 * b, zero], [zero, 2 * a, 2 * b])
    x, y, z = (np.select([wall, which == 2], [s[k] for s in surfaces[:2]], surfaces[2][k])
               for k in range(3))  # fmt: skip
    points = np.column_stack([x, y, z]) + rng.normal(0.0, 0.002, (n_points, 3))
    # None without a return, whatever the noise.
    points = np.round(points, 4) + np.where(np.abs(points) < 1e-4, 1e-3, 0.0)
    x, z = points[:, 0], points[:, 2]
    bar = (x > 0.4) & (x < 0.8) & (z > 0.3) & (z < 1.7) & wall
    square = (x > 2.2) & (x < 2.7) & (z > 1.3) & (z < 1.8) & wall
    parts = [bar, square, x > 1.5]
    reflectance = np.select(parts, [0.15, 0.95, 0.35], 0.75)
    reflectance = np.clip(reflectance + rng.normal(0.0, 0.005, n_points), 0.0, 1.0)
    paints = [[180, 30, 30], [40, 60, 220], [90, 110, 70]]
    rgb = np.select([part[:, None] for part in parts], paints, [200, 180, 150])
    rgb = np.clip(rgb + rng.integers(-2, 3, rgb.shape), 0, 255).astype(np.uint8)
    return Scene(points, reflectance, rgb)


def joined(scenes: Sequence[Scene]) -> Scene:
    """Points of several scans, one after the other."""
    return Scene(*(np.concatenate(arrays) for arrays in zip(*map(_arrays, scenes), strict=True)))


def _arrays(scene: Scene) -> tuple[NDArray[Any], ...]:
    return scene.points, scene.reflectance, scene.rgb


def _fields(scene: Scene, *, grey: Any = None, rgb: Any = None) -> dict[str, NDArray[Any]]:
    """Columns x, y, z, then those of an intensity and of colours where they are given."""
    fields = dict(zip("xyz", scene.points.T, strict=True))
    if grey is not None:
        fields["intensity"] = grey
    return fields | (_named("red green blue", rgb) if rgb is not None else {})


def _named(names: str, table: NDArray[Any]) -> dict[str, NDArray[Any]]:
    return dict(zip(names.split(), table.T, strict=True))


def write_scene(
    path: Path, scene: Scene, *, grey: Any = None, rgb: Any = None, **options: Any
) -> Path:
    """Write points with an intensity and colours, as they are, in the format of the suffix."""
    fields = _fields(scene, grey=grey, rgb=rgb)
    match path.suffix:
        case ".e57":
            scan = {"fields": _e57_fields(scene, grey=grey, rgb=rgb)} | options
            return scan_files.write_e57(path, [scan])
        case ".las" | ".laz":
            return scan_files.write_las(path, scene.points, intensity=grey, rgb=rgb, **options)
        case ".ply":
            return scan_files.write_ply(path, fields, **options)
        case ".pcd":
            return scan_files.write_pcd(path, fields, **options)
        case ".ptx":
            table = np.column_stack(list(fields.values()))
            return scan_files.write_ptx(path, [(table, 1, np.eye(4))])
    return _write_table(path, fields, header=str(len(scene)) if path.suffix == ".pts" else "")


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
    columns |= _named(axes, scene.points) | _named(colours, scene.rgb)
    has_intensity = draw.one_of(False, True)
    if has_intensity:
        name = draw.one_of("Intensity", "i", "Reflectance", "Scalar_field")
        columns[name] = scene.reflectance * draw.one_of(1.0, 255.0, 4095.0)
    # The first numbers may all be whole, where others have decimal commas.
    scene.points[0] = draw.one_of(scene.points[0], np.array([1.0, 2.0, 1.0]))
    path = _write_table(
        draw.path("csv", "txt", "xyz"),
        {name: columns[name] for name in draw.order(list(columns))},
        separator=separator,
        decimal="," if (separator == ";" or quote) and draw.one_of(False, True) else ".",
        end=draw.one_of("\n", "\r\n"),
        encoding=draw.one_of("utf-8", "latin-1", "utf-8-sig"),
        quote=quote,
    )
    return Case(scene, [path], rgb=True, intensity="linear" if has_intensity else "none")


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
    words = header.replace('"', "").split(separator)
    table = {str(k): draw.rng.uniform(0.0, 9.0, 60) for k in range(len(words))}
    path = _write_table(draw.path("txt", "csv"), table, separator=separator, header=header)
    words += ["if these are degrees"] * ("lat" in header.lower())
    return Case(draw.scene, [path], refusal=("cloud.columns", *words))


def text_names_twice(draw: Draw) -> Case:
    """Other columns whose names may stand for a coordinate or the intensity, too."""
    scene = draw.scene
    other = draw.rng.uniform(0.0, 9.0, (len(scene), 3)).round(3)
    names = draw.one_of(("N",), ("H",), ("i",), ("E", "N"), ("I", "J", "K"), ("Height",))
    columns: dict[str, Any] = dict(zip(names, other.T, strict=False))
    has_intensity = draw.one_of(True, False) or names == ("i",)
    columns |= _named(draw.one_of("X Y Z", "x y z"), scene.points)
    if has_intensity:
        columns["Intensity"] = scene.reflectance
    columns = {name: columns[name] for name in draw.order(list(columns))}
    path = _write_table(draw.path("csv"), columns, separator=draw.one_of(",", " ", ";"))
    intensity: Any = "linear" if has_intensity else "none"
    return Case(scene, [path], intensity=intensity, not_used=names)


def text_index_first(draw: Draw) -> Case:
    """A first column 1, 2, 3 ... with and without a name."""
    scene = draw.scene
    numbers = np.arange(len(scene)) + draw.one_of(1, 0, 1001)
    has_rgb = draw.one_of(False, True)
    columns = {draw.one_of("OBJECTID", "id", "Point No", "//nr"): numbers}
    columns |= _fields(scene, rgb=scene.rgb if has_rgb else None)
    path = _write_table(
        draw.path("csv"), columns, separator=draw.one_of(",", ";"), header=draw.one_of("", None)
    )
    return Case(scene, [path], rgb=has_rgb)


def text_not_a_number(draw: Draw) -> Case:
    """NaN and infinity in every spelling, of coordinates and colours."""
    scene = draw.scene
    lost = draw.chosen(draw.one_of(0.02, 0.3, 0.0))
    spellings = ["-nan(ind)", "nan", "NaN", "-nan", "1.#QNAN", "-1.#IND00", "1.#INF", "inf"]
    spellings += ["-Infinity", "nan(snan)", "NAN", "#NUM!", "#N/A", "n/a", "NA", "null"]
    spelling = draw.one_of(*spellings)
    columns: dict[str, Any] = _fields(scene, rgb=scene.rgb)
    names = draw.one_of("xyz", "z", ("red",))
    is_point = "z" in names
    for name in names:
        columns[name] = [
            spelling if is_lost else f"{value:.4f}"
            for value, is_lost in zip(columns[name], lost, strict=True)
        ]
    separator = draw.one_of(" ", ",", ";")
    path = draw.path("xyz", "csv", "txt")
    _write_table(path, columns, separator=separator, header=draw.one_of(None, ""))
    n_lost = int(lost.sum())
    return Case(
        scene.part(~lost) if is_point else scene,
        [path],
        rgb=True,
        has_rgb=None if is_point else ~lost,
        left_out={"not_finite": n_lost} if is_point else {},
        warnings=(f"{n_lost} points",),
    )


def text_normals(draw: Draw) -> Case:
    """Normals without a header are no colours."""
    scene = draw.scene
    header, facing = draw.one_of(
        (None, [0.0, -1.0, 0.0]),
        ("", [0.0, -1.0, 0.0]),
        (None, [0.6, 0.64, 0.48]),
        ("//X Y Z Nx Ny Nz", [0.0, -1.0, 0.0]),
    )
    normals = draw.rng.normal(size=(len(scene), 3)) * 0.05 + facing
    normals = np.round(normals / np.linalg.norm(normals, axis=1)[:, None], 3)
    parts = [_named("nx ny nz", normals)]
    has_rgb = draw.one_of(False, True) and not header
    if has_rgb:
        parts.append(_named("r g b", scene.rgb))
    columns = _fields(scene)
    for part in draw.order(parts):
        columns |= part
    path = draw.path("xyz")
    _write_table(path, columns, separator=draw.one_of(" ", ",", "\t"), header=header)
    return Case(scene, [path], rgb=has_rgb)


def in_unit(scene: Scene, unit: str) -> Scene:
    return replace(scene, points=scene.points / UNITS_M[unit])


def text_units(draw: Draw) -> Case:
    """Units in comments and in the names of columns."""
    unit, words = draw.one_of(
        ("ft", ("ft", "feet", "international feet")),
        ("us-ft", ("us-ft", "US survey feet", "ftUS")),
        ("mm", ("mm", "millimetres", "millimeters")),
        ("cm", ("cm", "centimetres", "centimeters")),
    )
    word = draw.one_of(*words)
    header = draw.one_of(
        f"X [{word}],Y [{word}],Z [{word}]",
        f"# units: {word}\nx,y,z",
        f"x,y,z\n{word},{word},{word}",
    )
    columns = _fields(in_unit(draw.scene, unit))
    path = _write_table(draw.path("csv"), columns, separator=",", header=header)
    return Case(draw.scene, [path], unit=unit)


def pts_two_scanners(draw: Draw) -> Case:
    """Two PTS files of scanners whose intensities have other ranges."""
    ranges = draw.order([(-2048.0, 2047.0), (0.0, 255.0)])
    halves = draw.scene.halves()
    paths = [
        write_scene(
            draw.folder / name,
            half,
            grey=np.rint(low + half.reflectance * (high - low)),
            rgb=half.rgb,
        )
        for name, half, (low, high) in zip(("a.pts", "b.pts"), halves, ranges, strict=True)
    ]
    return Case(joined(halves), paths, intensity="equal", rgb=True, warnings=("range",))


# E57


def _e57_fields(scene: Scene, *, grey: Any = None, rgb: Any = None) -> dict[str, Any]:
    fields = scan_files.cartesian(scene.points)
    if grey is not None:
        fields["intensity"] = grey
    return fields | (_named("colorRed colorGreen colorBlue", rgb) if rgb is not None else {})


# What most files state of a scan.
_LIMITS: Final = {"intensity_limits": (0.0, 1.0), "rgb_limit": 255}


def _whole(scene: Scene) -> dict[str, Any]:
    return _e57_fields(scene, grey=scene.reflectance, rgb=scene.rgb)


def e57_colour_invalid(draw: Draw) -> Case:
    """Points whose colour is flagged invalid, and written as black."""
    scene = draw.scene
    lost = draw.chosen(draw.one_of(0.3, 0.05, 0.9))
    fields = _whole(scene)
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
    return Case(
        scene,
        [scan_files.write_e57(draw.path("e57"), [{"fields": fields, **_LIMITS}])],
        rgb=True,
        has_rgb=~lost,
        intensity="equal",
        has_intensity=has_intensity,
        warnings=(f"{int(lost.sum())} points", "colour"),
    )


def e57_colour_limit_wrong(draw: Draw) -> Case:
    """A colour limit that the data do not fit is named and not used."""
    limit, scale = draw.one_of((1, 1), (65535, 1), (255, 257), (4095, 1))
    scene = draw.scene
    rgb = scene.rgb.astype(np.float64) * scale
    path = write_scene(draw.path("e57"), scene, grey=scene.reflectance, rgb=rgb, rgb_limit=limit)
    warnings = (str(limit), "the file declares colours up to")
    return Case(scene, [path], rgb=True, intensity="linear", warnings=warnings)


def one_scan_without(draw: Draw) -> Case:
    """One of the scans of a file, or one of several files, has no colour or no intensity."""
    scenes = list(draw.scene.halves())[:: draw.one_of(1, -1)]
    lacks, place = draw.one_of("rgb", "grey"), draw.one_of(1, 0)
    values = [{"grey": scene.reflectance, "rgb": scene.rgb} for scene in scenes]
    values[place].pop(lacks)
    is_one = draw.one_of(True, False)
    if is_one:
        pairs = zip(scenes, values, strict=True)
        scans = [{"fields": _e57_fields(scene, **some), **_LIMITS} for scene, some in pairs]
        paths = [scan_files.write_e57(draw.path("e57"), scans)]
    else:
        paths = [draw.folder / "0.ply", draw.folder / "1.ply"]
        for path, scene, some, unit in zip(paths, scenes, values, ("m", "mm"), strict=True):
            write_scene(path, in_unit(scene, unit), **some)
            path.write_bytes(path.read_bytes().replace(b"made by hand", f"unit: {unit}".encode()))
    has = np.concatenate([np.full(len(scene), k != place) for k, scene in enumerate(scenes)])
    return Case(
        joined(scenes),
        paths,
        rgb=True,
        has_rgb=has if lacks == "rgb" else None,
        intensity="equal" if is_one else "linear",
        has_intensity=has if lacks == "grey" else None,
        unit="m" if is_one else "m mm",
        warnings=(f"no {'colour' if lacks == 'rgb' else 'intensity'}", str(len(scenes[place]))),
        not_reported=("is zero",),
    )


def e57_two_scales(draw: Draw) -> Case:
    """Scans of one file with limits of intensity and depths of colour of their own."""
    scenes, scans = draw.scene.halves(), []
    limits = [(0.0, 1.0), (0.0, 65535.0), (-2048.0, 2047.0), (0.0, 255.0), (0.0, 100.0)]
    depths = draw.order([(255, 1), (65535, draw.one_of(257, 256))])
    for scene, (low, high), (most, scale) in zip(
        scenes, draw.order(limits)[:2], depths, strict=True
    ):
        rgb = scene.rgb.astype(np.float64) * scale
        fields = _e57_fields(scene, grey=low + scene.reflectance * (high - low), rgb=rgb)
        scans.append({"fields": fields, "intensity_limits": (low, high)})
        if draw.one_of(True, False):
            scans[-1]["rgb_limit"] = most
    path = scan_files.write_e57(draw.path("e57"), scans)
    wrong = ("declares colours",)
    return Case(joined(scenes), [path], rgb=True, intensity="equal", not_reported=wrong)


def e57_not_finite(draw: Draw) -> Case:
    """Coordinates that are not finite, with or without a pose of the scan."""
    scene = draw.scene
    lost = draw.chosen(draw.one_of(0.1, 0.5))
    fields = _whole(replace(scene, points=scene.points - STATION))
    for name in draw.one_of(("cartesianY",), ("cartesianX", "cartesianY", "cartesianZ")):
        fields[name] = np.where(lost, draw.one_of(np.nan, np.inf, -np.inf), fields[name])
    fields["timeStamp"] = np.zeros(len(scene))
    scan = {"fields": fields, "rotation": (1.0, 0.0, 0.0, 0.0), "translation": STATION} | _LIMITS
    return Case(
        scene.part(~lost),
        [scan_files.write_e57(draw.path("e57"), [scan])],
        rgb=True,
        intensity="equal",
        not_used=("timeStamp",),
        left_out={"not_finite": int(lost.sum())},
        warnings=("not finite",),
    )


# Points without a return, in any format


def points_at_zero(draw: Draw) -> Case:
    """Points without a return written as 0 0 0 without a flag: one, a tenth, half, most."""
    scene, shift = draw.scene, draw.shift()
    share = draw.one_of(0.5, 0.1, 0.0, 0.8)
    n_lost = max(1, int(share / (1.0 - share) * len(scene)))
    moved = replace(scene, points=scene.points + shift)
    all_of = moved.with_points(draw.places(n_lost), np.zeros(3))
    path = draw.path("e57", "ply", "pcd", "las", "laz", "xyz", "pts", "ptx")
    grey, options = all_of.reflectance, {}
    if path.suffix == ".ply":
        options = {"encoding": draw.one_of(*_PLY_ENCODINGS)}
    elif path.suffix == ".pcd":
        options = {"data": draw.one_of("binary", "ascii", "binary_compressed")}
    elif path.suffix in (".las", ".laz"):
        # Coordinates of LAS count from an offset, here that of the file's world.
        grey, options = grey * 65535.0, {"offset": np.zeros(3), "scale": 0.005}
    write_scene(path, all_of, grey=grey, rgb=all_of.rgb, **options)
    return Case(
        scene,
        [path],
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
    moved = replace(scene, points=scene.points + shift)
    all_of = moved.with_points(draw.places(n_lost), STATION + shift)
    path = draw.path("las", "xyz", "ply", "laz")
    options = {"offset": STATION + shift} if path.suffix.startswith(".la") else {}
    write_scene(path, all_of, rgb=all_of.rgb, **options)
    return Case(
        scene,
        [path],
        shift=shift,
        rgb=True,
        left_out={"one_place": n_lost},
        warnings=(f"{n_lost} points are at exactly",),
    )


# LAS


def _las(path: Path, scene: Scene, **options: Any) -> Path:
    """A LAS file whose intensities and colours reach 65,535."""
    given = {"grey": scene.reflectance * 65535.0, "rgb": scene.rgb.astype(np.int64) * 256}
    return write_scene(path, scene, **(given | {"offset": np.zeros(3)} | options))


def las_header_stale(draw: Draw) -> Case:
    """Bounds of another place, and of a LAS file the number before points were appended."""
    scene, shift = draw.scene, draw.shift()
    moved = replace(scene, points=scene.points + shift)
    path = _las(draw.path("las", "laz"), moved, offset=np.floor(shift), version="1.2")
    content = bytearray(path.read_bytes())
    bounds = np.array(struct.unpack_from("<6d", content, 179)) + draw.one_of(-1000.0, 250.0, 1e5)
    struct.pack_into("<6d", content, 179, *bounds)
    warnings = ["outside the bounding box"]
    if path.suffix == ".las":
        struct.pack_into("<I", content, 107, draw.one_of(len(scene) // 2, 1, len(scene) - 1))
        warnings.append(f"contains {len(scene)}")
    path.write_bytes(bytes(content))
    return Case(scene, [path], shift=shift, rgb=True, intensity="linear", warnings=(*warnings,))


def colours_of_few_bits(draw: Draw) -> Case:
    """Colours of 10 or 12 bits in fields of 16, without a limit."""
    scene = draw.scene
    most = draw.one_of(1023, 4095)
    scene.rgb[:10] = 255
    deep = np.rint(scene.rgb / 255.0 * most).astype(np.uint16)
    path = write_scene(draw.path("las", "ply", "xyz"), scene, rgb=deep)
    return Case(scene, [path], rgb=True, warnings=(f"colours reach {most} and",))


# Codes of systems with coordinates and with heights in a unit, and of the unit.
_CODES: Final = {"m": (32618, 5703, 9001), "ft": (2222, 8228, 9002), "us-ft": (2260, 6360, 9003)}


def las_feet(draw: Draw) -> Case:
    """Feet by WKT or a citation, also with heights in another unit."""
    how = draw.one_of("wkt", "wkt behind the points", "citation")
    units = (("us-ft", "us-ft"), ("us-ft", "m"), ("ft", "ft"), ("m", "us-ft"))
    level, height = draw.one_of(*units)
    if how == "citation":
        height, foot = level, {"us-ft": "US survey foot", "ft": "foot", "m": "metre"}[level]
        number, data = 34737, f"PCS Name = site|Linear unit = {foot}|\0".encode()
    else:
        has_height = height != level or draw.one_of(False, True)
        vertical = f"+{_CODES[height][1]}" if has_height else ""
        number, data = 2112, _wkt(f"EPSG:{_CODES[level][0]}{vertical}", draw)
    return _of_unit(draw, (level, height), number, data, is_behind=how == "wkt behind the points")


def las_feet_by_keys(draw: Draw) -> Case:
    """Feet by GeoTIFF keys: those of coded systems, or stated ones, which win over them."""
    level, height = draw.one_of(("us-ft", "us-ft"), ("ft", "m"), ("m", "us-ft"))
    keys = {1024: 1, 3072: _CODES[level][0], 4096: _CODES[height][1]}
    if draw.one_of(True, False):
        other = _CODES["ft" if level == "m" else "m"]
        keys |= {3072: other[0], 4096: other[1], 3076: _CODES[level][2], 4099: _CODES[height][2]}
    words = [1, 1, 0, len(keys), *(w for key, value in keys.items() for w in (key, 0, 1, value))]
    return _of_unit(draw, (level, height), 34735, struct.pack(f"<{len(words)}H", *words))


def _of_unit(
    draw: Draw, units: tuple[str, str], number: int, data: bytes, *, is_behind: bool = False
) -> Case:
    """A LAS file with a record that states the units of coordinates and heights."""
    level, height = units
    scene = draw.scene
    metres = np.array([UNITS_M[level], UNITS_M[level], UNITS_M[height]])
    in_feet = replace(scene, points=scene.points / metres)
    record = {"evlrs" if is_behind else "vlrs": [("LASF_Projection", number, data)]}
    path = _las(draw.path("las", "laz"), in_feet, **record)
    unit = level if level == height else f"{level}/{height}"
    if draw.one_of(False, True):
        # What the user says wins over what the file states.
        params = {"unit": "m"}
        return Case(in_feet, [path], rgb=True, intensity="linear", params=params)
    return Case(scene, [path], rgb=True, intensity="linear", unit=unit)


def _wkt(system: str, draw: Draw) -> bytes:
    import pyproj

    form = draw.one_of("WKT1_GDAL", "WKT2_2019")
    return str(pyproj.CRS.from_user_input(system).to_wkt(form)).encode() + b"\0"


def las_degrees(draw: Draw) -> Case:
    """Geographic coordinates are refused, with the way out."""
    data = _wkt(f"EPSG:{draw.one_of(4326, 4979, 4258)}", draw)
    path = _las(draw.path("las"), draw.scene, vlrs=[("LASF_Projection", 2112, data)])
    if draw.one_of(False, True):
        return Case(draw.scene, [path], rgb=True, intensity="linear", params={"unit": "m"})
    return Case(draw.scene, [path], refusal=("degrees", "cloud.unit"))


def las_extra_intensity(draw: Draw) -> Case:
    """Intensity 0, and fields of the scanner's maker that hold it."""
    scene = draw.scene
    names = draw.one_of(
        ("Reflectance", "Amplitude"), ("reflectance", "Deviation"), ("Echo",), ("Amplitude",)
    )
    # Reflectance of this maker is in decibels.
    extra = {names[0]: (scene.reflectance * 20.0 - 15.0).astype(np.float32)}
    extra |= {name: draw.rng.uniform(0.0, 9.0, len(scene)).astype(np.float32) for name in names[1:]}
    wants = draw.one_of(False, True)
    has_rgb = draw.one_of(False, True)
    path = _las(
        draw.path("las", "laz"),
        scene,
        grey=draw.rng.uniform(0.0, 9.0, len(scene)) if wants else np.zeros(len(scene)),
        extra={name: extra[name] for name in draw.order(list(extra))},
        **({} if has_rgb else {"rgb": None}),
    )
    params = {"intensity_field": draw.one_of(names[0], names[0].upper())} if wants else {}
    is_taken = wants or names != ("Echo",)
    return Case(
        scene,
        [path],
        rgb=has_rgb,
        intensity="linear" if is_taken else "none",
        params=params,
        not_used=tuple(names[is_taken:]),
        warnings=() if is_taken else ("fields not used: Echo",),
    )


def one_reflector(draw: Draw) -> Case:
    """A few points of a reflector set no scale."""
    scene = draw.scene
    low, high = draw.one_of((300.0, 1800.0), (20.0, 90.0), (1000.0, 9000.0))
    grey = np.rint(low + scene.reflectance * (high - low)).astype(np.float32)
    places = draw.rng.choice(len(scene), draw.one_of(5, 1, 3), replace=False)
    grey[places] = 65535
    path = draw.path("las", "ply", "xyz", "e57")
    is_e57 = path.suffix == ".e57"
    options = {"intensity_limits": (0.0, 65535.0)} if is_e57 else {}
    write_scene(path, scene, grey=grey, **options)
    is_usual = ~np.isin(np.arange(len(scene)), places)
    warnings = ("declares intensities from 0 to 65535",) if is_e57 else ()
    return Case(scene, [path], intensity="linear", has_linear=is_usual, warnings=warnings)


# PLY and PCD

_PLY_ENCODINGS: Final = ("binary_little_endian", "binary_big_endian", "ascii")


def ply_lists(draw: Draw) -> Case:
    """A list property somewhere among the others, and names of colours that programs use."""
    from plyfile import PlyElement

    scene = draw.scene
    names = draw.one_of("red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b")
    kind = draw.one_of("f4", "f8")
    fields = _fields(replace(scene, points=scene.points.astype(kind))) | _named(names, scene.rgb)
    columns = [(name, array.dtype.str[1:]) for name, array in fields.items()]
    columns.insert(draw.one_of(len(columns), 0, 3), ("view_indices", "O"))
    table = np.zeros(len(scene), dtype=columns)
    item = draw.one_of("u4", "i4", "f4")
    for name, array in fields.items():
        table[name] = array
    for k, count in enumerate(draw.rng.integers(0, 4, len(scene))):
        table["view_indices"][k] = np.arange(count, dtype=item)
    element = PlyElement.describe(
        table, "vertex", len_types={"view_indices": "u1"}, val_types={"view_indices": item}
    )
    comments = draw.one_of(["x"], [])
    path = draw.path("ply")
    # In the other order of bytes plyfile writes no lists.
    encoding = draw.one_of("binary_little_endian", "ascii")
    scan_files.write_elements(path, [element], encoding, comments)
    # Other names of the same types.
    old, new = draw.one_of((b"", b""), (b" uchar ", b" uint8 "), (b" float ", b" float32 "))
    path.write_bytes(path.read_bytes().replace(old, new, 20))
    return Case(scene, [path], rgb=True)


def comment_units(draw: Draw) -> Case:
    """PLY, PCD and E57 files whose comments state a unit or a coordinate system."""
    unit, words = draw.one_of(
        ("us-ft", ("units: US survey feet", "EPSG:2260", "unit us-ft")),
        ("ft", ("units: feet", "coordinates in ft", "EPSG:2222")),
        ("mm", ("unit: mm", "units = millimeters", "length unit mm")),
    )
    word = draw.one_of(*words)
    inside = in_unit(draw.scene, unit)
    path = draw.path("ply", "pcd", "e57")
    if path.suffix == ".e57":
        scan = {"fields": _e57_fields(inside, rgb=inside.rgb)}
        scan_files.write_e57(path, [scan], coordinate_metadata=word)
    else:
        write_scene(path, inside, rgb=inside.rgb)
        content = path.read_bytes().replace(b"made by hand", word.encode(), 1)
        path.write_bytes(content if path.suffix == ".ply" else f"# {word}\n".encode() + content)
    return Case(draw.scene, [path], rgb=True, unit=unit)


def pcd_names(draw: Draw) -> Case:
    """PCD files of any first line and capitalisation, with colours in fields of their own."""
    scene = draw.scene
    fields: dict[str, Any] = _named(draw.one_of("x y z", "X Y Z"), scene.points.astype(np.float32))
    colours = draw.one_of("red green blue", "Red Green Blue", "r g b", "R G B", "packed", "")
    if colours == "packed":
        bits = scene.rgb.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], dtype=np.uint32)
        bits = bits if draw.one_of(True, False) else bits.view(np.float32)
        fields[draw.one_of("rgb", "RGB", "rgba")] = bits
    elif colours:
        fields |= _named(colours, scene.rgb.astype(draw.one_of(np.uint8, np.uint16)))
    has_intensity = draw.one_of(True, False) or not colours
    if has_intensity:
        name = draw.one_of("scalar_Intensity", "Intensity", "INTENSITY", "i", "Reflectance")
        fields[name] = (scene.reflectance * draw.one_of(1.0, 255.0)).astype(np.float32)
    data = draw.one_of("binary", "ascii", "binary_compressed")
    if data == "ascii" and colours == "packed":
        data = "binary"
    path = scan_files.write_pcd(draw.path("pcd"), fields, data=data)
    first, rest = path.read_bytes().split(b"\n", 1)
    first = draw.one_of(
        b"#.PCD v.7 - Point Cloud Data file format", b"# made by hand", b"", b"# PCD", first
    )
    head, body = rest.split(b"DATA", 1)
    if draw.one_of(False, True):
        head = head.replace(b"HEIGHT 1\n", b"")
    if draw.one_of(False, True):
        words = [line.partition(b" ") for line in head.split(b"\n")]
        head = b"\n".join(word.lower() + space + more for word, space, more in words)
    path.write_bytes((first + b"\n" if first else b"") + head + b"DATA" + body)
    return Case(scene, [path], rgb=bool(colours), intensity="linear" if has_intensity else "none")


# PTX


def ptx_scans(draw: Draw) -> Case:
    """Scans with missing lines, blank lines between them, and one without colour."""
    angle = draw.one_of(0.0, 0.7, -2.0)
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = STATION
    lacks = draw.one_of("lines", "colour", "blank", "nothing")
    place = draw.one_of(1, 0)
    path, content = draw.path("ptx"), ""
    has_rgb, kept = [], []
    for k, half in enumerate(draw.scene.halves()):
        scene = half.part(slice(len(half) // 2 * 2))
        stated = f"{len(scene) // 2}\n2\n"
        if lacks == "lines" and k == place:
            left = draw.rng.uniform(size=len(scene)) > draw.one_of(0.1, 0.6)
            scene = scene.part(left)
        local = (scene.points - pose[:3, 3]) @ pose[:3, :3]
        is_grey = lacks == "colour" and k == place
        table = np.column_stack([local, scene.reflectance, *([] if is_grey else scene.rgb.T)])
        scan_files.write_ptx(path, [(table, 1, pose)])
        content += stated + path.read_text().split("\n", 2)[2]
        content += "\n" * (draw.one_of(1, 2) if lacks == "blank" else 0)
        has_rgb.append(np.full(len(scene), not is_grey))
        kept.append(scene)
    path.write_bytes(content.replace("\n", draw.one_of("\n", "\r\n")).encode())
    return Case(
        joined(kept),
        [path],
        rgb=True,
        has_rgb=np.concatenate(has_rgb),
        intensity="equal",
        has_grid=lacks != "lines",
        warnings={"lines": ("lines of points",), "colour": ("no colour",)}.get(lacks, ()),
    )


CASES: Final[Mapping[str, Callable[[Draw], Case]]] = {
    name: function
    for name, function in list(globals().items())
    if name[0] != "_" and getattr(function, "__annotations__", {}).get("return") == "Case"
}
