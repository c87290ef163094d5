"""Camera files: choice of the reader, and readers for `cameras.json`, Bundler and RealityCapture.

Metashape, COLMAP and E57 have their own modules.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoflow.errors import InputError
from orthoflow.files.colmap import COLMAP_PARTS, read_colmap_model
from orthoflow.files.e57_images import read_e57_images
from orthoflow.files.given_cameras import (
    MOST_CAMERAS,
    CentredLens,
    GivenCamera,
    checked_lens,
    damaged,
    lines_of,
    numbers_of,
    photo_path,
    rotation_of,
    text_of,
)
from orthoflow.files.images import PHOTO_SUFFIXES
from orthoflow.files.metashape import read_metashape_xml
from orthoflow.geometry.cameras import HALF_PIXEL
from orthoflow.products import Intrinsics
from orthoflow.untrusted_text import first_few, parse_json

_FULL_FRAME_MM: Final = 36.0
# OpenGL axes, as in Bundler and RealityCapture: x right, y up, z backwards.
_FROM_OPENGL: Final = np.diag([1.0, -1.0, -1.0])
_ANGLES: Final = ("x", "y", "alt", "heading", "pitch", "roll")
_FOCAL_BEHIND: Final = re.compile(r"\s+0\s+[-+.\deE]+$")
_SEPARATORS: Final = re.compile("[,;\t]")
_FIRST_LINES: Final = 50
# Preferred names if a folder has several files of one format.
_USUAL_NAMES: Final = ("cameras.json", "bundle.out", "cameras.xml", "cameras.csv")


def read_given_cameras(paths: Sequence[Path]) -> tuple[GivenCamera, ...]:
    """Read the cameras from one file, or from a folder with files that belong together.

    Raises:
        InputError: the format is unknown, a file is damaged, or there are too many cameras.
    """
    found = _read(paths)
    if len(found) > MOST_CAMERAS:
        raise InputError(
            f"{paths[0].name} contains more than {MOST_CAMERAS} cameras: split the file"
        )
    return found


def _read(paths: Sequence[Path]) -> tuple[GivenCamera, ...]:
    models = _colmap_models(paths)
    if models:
        # If there are several reconstructions, use the one with the most oriented photos.
        found = [read_colmap_model(parts) for parts in models]
        return max(found, key=lambda cameras: sum(not camera.reason for camera in cameras))
    readers: dict[str, Callable[[Path], tuple[GivenCamera, ...]]] = {
        ".json": read_cameras_json,
        ".xml": read_metashape_xml,
        ".csv": read_realitycapture_list,
        ".e57": lambda path: tuple(image.camera for image in read_e57_images(path)),
        ".out": lambda path: read_bundler(path, _photo_list(path, paths)),
        ".txt": read_realitycapture_list,
    }
    several = ""
    for suffix, reader in readers.items():
        files = [path for path in paths if path.suffix.lower() == suffix]
        if suffix == ".txt":
            files = [path for path in files if _is_realitycapture(path)]
        usual = [path for path in files if path.name.lower() in _USUAL_NAMES]
        if len(files) == 1 or len(usual) == 1:
            return reader((usual or files)[0])
        if files and not several:
            several = f"{len(files)} {suffix} files, one of which must be chosen; "
    names = first_few([path.name for path in paths])
    raise InputError(
        f"{names or 'the input'}: no cameras that orthoflow can read: {several}expected the "
        "cameras.json of a run, a folder with COLMAP's cameras.txt and images.txt (or .bin), a "
        "Metashape .xml file, a Bundler .out file with its list of photos (.txt) next to it, a "
        "RealityCapture .csv file, or an E57 file with photos"
    )


def _colmap_models(paths: Sequence[Path]) -> list[list[Path]]:
    """Return the parts of each COLMAP model; text models only if there are no binary ones."""
    for suffix in (".bin", ".txt"):
        folders: dict[Path, dict[str, Path]] = {}
        for path in paths:
            if path.suffix.lower() == suffix and path.stem.lower() in COLMAP_PARTS:
                folders.setdefault(path.parent, {})[path.stem.lower()] = path
        models = [parts for parts in folders.values() if {"cameras", "images"} <= set(parts)]
        if models:
            return [list(parts.values()) for parts in models]
    return []


def _photo_list(path: Path, paths: Sequence[Path]) -> list[str]:
    """Return the photo names of a Bundler file, from a list in the same folder.

    Each line of the list contains a photo name, which may contain spaces or be quoted, and
    optionally 0 and a focal length in pixels. Only lists with one line per camera are used. A list
    with the same name as the Bundler file has priority over `list.txt`; if neither exists, all
    lists of photos must have the same content.
    """
    n_cameras = bundler_count(path)
    lists = {
        other.name.lower(): [
            photo_path(_FOCAL_BEHIND.sub("", line.strip()).strip("\"'"))
            for line in text_of(other).splitlines()
            if line.strip() and not line.startswith("#")
        ]
        for other in paths
        if other.suffix.lower() == ".txt" and other.parent == path.parent
    }
    fitting = {name: names for name, names in lists.items() if len(names) == n_cameras}
    usual = (f"{path.name}.list.txt".lower(), f"{path.stem}.list.txt".lower(), "list.txt")
    if called := next((name for name in usual if name in fitting), None):
        return fitting[called]
    of_photos = {
        tuple(names)
        for names in fitting.values()
        if len(fitting) == 1 or all(name.lower().endswith(PHOTO_SUFFIXES) for name in names)
    }
    if len(of_photos) == 1:
        return list(of_photos.pop())
    counts = ", ".join(f"{name} (lines: {len(names)})" for name, names in lists.items())
    raise InputError(
        f"{path.name} does not contain the names of its photos: pass its folder, in which a list "
        f"(.txt) names one photo per line (lines needed: {n_cameras}); found "
        f"{counts or 'no such file'}"
    )


def read_cameras_json(path: Path) -> tuple[GivenCamera, ...]:
    """Read the `cameras.json` of a run: OpenCV pixel coordinates, X_camera = R X_world + t.

    Raises:
        InputError: the file is damaged.
    """
    try:
        content: Any = parse_json(text_of(path))
        entries: Mapping[str, Any] = dict(content["cameras"])
        return tuple(
            _of_json(name, dict(entry), path)
            for name, entry in islice(entries.items(), MOST_CAMERAS + 1)
        )
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise damaged(path, "it is not the cameras.json of a run") from error


def _of_json(name: str, entry: Mapping[str, Any], path: Path) -> GivenCamera:
    if entry["status"] != "ok":
        return GivenCamera(name=name, reason=str(entry["status"]))
    matrix = np.array(entry["K"], dtype=np.float64)
    distortion = tuple(float(value) for value in entry["distortion"])
    if matrix.shape != (3, 3) or len(distortion) != 5:
        raise damaged(path, f"the lens of {name} must consist of K (3 x 3) and k1, k2, p1, p2, k3")
    lens = Intrinsics(
        width=int(entry["width"]),
        height=int(entry["height"]),
        fx=float(matrix[0, 0]),
        fy=float(matrix[1, 1]),
        cx=float(matrix[0, 2]) + HALF_PIXEL,
        cy=float(matrix[1, 2]) + HALF_PIXEL,
        distortion=distortion,
        source="given",
        skew=float(matrix[0, 1]) or None,
    )
    lens = checked_lens(lens, path, name)
    rotation = np.array(entry["R_camera_from_world"], dtype=np.float64).ravel().tolist()
    sigma_mm, covariance = entry.get("sigma_wall_mm"), entry.get("pose_covariance")
    if covariance is not None:
        covariance = np.array(covariance, dtype=np.float64)
        if covariance.shape != (6, 6) or not (np.isfinite(covariance).all()):
            raise damaged(path, f"pose_covariance of {name} must be 6 x 6 numbers")
    return GivenCamera(
        name=name,
        lens=lens,
        rotation=rotation_of(rotation, path, name),
        translation=np.array(
            numbers_of([str(v) for v in entry["t_camera_from_world"]], path, f"t of {name}")
        ).reshape(3),
        covariance=covariance,
        sigma_wall_m=None
        if sigma_mm is None
        else numbers_of([str(sigma_mm)], path, f"sigma_wall_mm of {name}")[0] / 1000.0,
    )


def bundler_count(path: Path) -> int:
    """Return the number of cameras according to the header of a Bundler file.

    Raises:
        InputError: the header does not contain the number.
    """
    words = list(islice(_words_of(path), 2))
    counts = numbers_of(words, path, "the counts of cameras and points")
    if len(counts) < 2 or not 0.0 <= counts[0] <= MOST_CAMERAS:
        raise damaged(path, "it does not contain the number of cameras")
    return int(counts[0])


def read_bundler(path: Path, names: Sequence[str]) -> tuple[GivenCamera, ...]:
    """Read a Bundler file: f, k1, k2, R and t of each camera, with OpenGL axes.

    Pixel coordinates in the file are relative to the centre of the photo, with y upwards.

    Args:
        path: the file.
        names: photo names, in the order of the file.

    Raises:
        InputError: the file is damaged.
    """
    # Read only the cameras, because many points may follow them.
    values = numbers_of(
        list(islice(_words_of(path), 2, 2 + 15 * len(names))), path, "the parameters of cameras"
    )
    if len(values) < 15 * len(names):
        raise damaged(path, f"it ends within camera {len(values) // 15}")
    return tuple(
        GivenCamera(
            name=name,
            lens=CentredLens(focal_px=focal, radial=(k1, k2, 0.0)),
            rotation=_FROM_OPENGL @ rotation_of(pose[:9], path, name),
            translation=_FROM_OPENGL @ np.array(pose[9:]),
        )
        if focal > 0.0
        else GivenCamera(name=name, reason="Bundler did not orient it")
        for name, (focal, k1, k2, *pose) in zip(
            names, np.reshape(values, (-1, 15)).tolist(), strict=True
        )
    )


def _words_of(path: Path) -> Iterator[str]:
    for line in lines_of(path):
        if not line.lstrip().startswith("#"):
            yield from line.split()


def _head_of(lines: Sequence[str]) -> tuple[int, list[str]] | None:
    """Return the line index and the columns of a RealityCapture list's header, or None."""
    for number, line in enumerate(lines):
        columns = [word.strip().lower() for word in _SEPARATORS.split(line.lstrip("# \ufeff"))]
        if {"name", "heading"} <= set(columns):
            return number, ["alt" if word == "z" else word for word in columns]
    return None


def _is_realitycapture(path: Path) -> bool:
    try:
        return _head_of(list(islice(lines_of(path), _FIRST_LINES))) is not None
    except InputError:
        return False


def read_realitycapture_list(path: Path) -> tuple[GivenCamera, ...]:
    """Read RealityCapture's "internal/external camera parameters" (CSV).

    The focal length refers to a frame whose longer side is 36 mm. The principal
    point is relative to the centre, as a fraction of the longer side. Heading is clockwise from
    north (y); pitch 0 looks straight down. Missing parameters are zero; comment lines may be
    anywhere.

    Raises:
        InputError: the file is damaged.
    """
    lines = text_of(path).splitlines()
    number, columns = _head_of(lines) or (0, [])
    missing = [name for name in ("name", *_ANGLES) if name not in columns]
    if missing:
        raise damaged(
            path,
            f"the column {missing[0]} is missing: expected RealityCapture's internal/external "
            "camera parameters, #name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2",
        )
    separator = next(mark for mark in ",;\t" if mark in lines[number])
    rows = csv.reader(lines[number + 1 :], delimiter=separator)
    try:
        return tuple(
            _of_row(dict(zip(columns, row, strict=False)), path, number + 1 + rows.line_num)
            for row in islice(rows, MOST_CAMERAS + 1)
            if any(row) and not row[0].lstrip().startswith("#")
        )
    except csv.Error as error:
        raise damaged(path, f"it is not a table: {error}") from error


def _of_row(row: Mapping[str, str], path: Path, line: int) -> GivenCamera:
    from scipy.spatial.transform import Rotation

    name = photo_path(row["name"])
    pose = numbers_of([row.get(key, "") for key in _ANGLES], path, "the parameters", line)
    terms = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
    px, py, *radial, t1, t2 = numbers_of(
        [row.get(key) or "0" for key in terms], path, "the parameters", line
    )
    if not row.get("f"):
        return GivenCamera(
            name=name,
            reason="the list has no focal length f: export internal/external camera parameters",
        )
    (focal,) = numbers_of([row["f"]], path, "the focal length", line)
    if not focal > 0.0:
        raise damaged(path, f"the focal length of {name} must be positive, got {focal:g}", line)
    # The camera's OpenGL axes are rotated about z by -heading, x by pitch and y by roll.
    heading, pitch, roll = pose[3:]
    world_from_axes = Rotation.from_euler("ZXY", [-heading, pitch, roll], degrees=True)
    rotation = _FROM_OPENGL @ world_from_axes.as_matrix().T
    return GivenCamera(
        name=name,
        lens=CentredLens(
            focal_share=focal / _FULL_FRAME_MM,
            off_middle=(px, py),
            radial=tuple(radial),
            tangential=(t1, t2),
        ),
        rotation=rotation,
        translation=-rotation @ np.array(pose[:3]),
    )
