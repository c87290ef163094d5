"""Which reader a file of cameras needs, told by its name."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from orthoflow.alike import first_few
from orthoflow.errors import InputError
from orthoflow.files.colmap import COLMAP_PARTS, read_colmap_model
from orthoflow.files.e57_images import read_e57_images
from orthoflow.files.given_cameras import (
    MOST_CAMERAS,
    GivenCamera,
    bundler_count,
    photo_path,
    read_bundler,
    read_cameras_json,
    read_realitycapture_list,
    text_of,
)
from orthoflow.files.metashape import read_metashape_xml


def read_given_cameras(paths: Sequence[Path]) -> tuple[GivenCamera, ...]:
    """Read the cameras of one file, or of a folder that several files make.

    Raises:
        InputError: the files are of no known kind, damaged, or hold too many.
    """
    found = _read(paths)
    if len(found) > MOST_CAMERAS:
        raise InputError(f"{paths[0].name} holds more than {MOST_CAMERAS} cameras: split it")
    return found


def _read(paths: Sequence[Path]) -> tuple[GivenCamera, ...]:
    models = _colmap_models(paths)
    if models:
        # Of several reconstructions the one that orients most photos; COLMAP numbers them.
        found = [read_colmap_model(parts) for parts in models]
        return max(found, key=lambda cameras: sum(not camera.reason for camera in cameras))
    readers: dict[str, Callable[[Path], tuple[GivenCamera, ...]]] = {
        ".json": read_cameras_json,
        ".xml": read_metashape_xml,
        ".csv": read_realitycapture_list,
        ".e57": lambda path: tuple(image.camera for image in read_e57_images(path)),
        ".out": lambda path: read_bundler(path, _photo_list(path, paths)),
    }
    for suffix, reader in readers.items():
        files = [path for path in paths if path.suffix.lower() == suffix]
        named = [path for path in files if path.name.lower() == "cameras.json"]
        if len(files) == 1 or len(named) == 1:
            return reader((named or files)[0])
    names = first_few([path.name for path in paths])
    raise InputError(
        f"{names or 'nothing'} holds no cameras that orthoflow reads: expected one cameras.json of "
        "a run, a folder with COLMAP's cameras.txt and images.txt (or .bin), Metashape's .xml, "
        "Bundler's .out with its list of photos (.txt) beside it, RealityCapture's .csv, or an E57 "
        "file with photos"
    )


def _colmap_models(paths: Sequence[Path]) -> list[list[Path]]:
    """Parts of each COLMAP model among files, binary before text, by their folders."""
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
    """Names of the photos of a Bundler file, from the list beside it that has as many.

    A line is a name, which may hold spaces, or a name, 0 and a focal length in pixels.
    """
    n_cameras = bundler_count(path)
    lists = {
        other.name: [
            _FOCAL_BEHIND.sub("", line.strip())
            for line in text_of(other).splitlines()
            if line.strip() and not line.startswith("#")
        ]
        for other in paths
        if other.suffix.lower() == ".txt" and other.parent == path.parent
    }
    fitting = [name for name, lines in lists.items() if len(lines) == n_cameras]
    preferred = [name for name in fitting if "list" in name.lower()]
    if len(preferred) != 1 and len(fitting) == 1:
        preferred = fitting
    if len(preferred) != 1:
        counts = ", ".join(f"{name} ({len(lines)} lines)" for name, lines in lists.items())
        raise InputError(
            f"{path.name} has {n_cameras} cameras without names: give the folder with it and one "
            f"list of as many photos (.txt), one line each; there is {counts or 'no such file'}"
        )
    return [photo_path(name) for name in lists[preferred[0]]]


_FOCAL_BEHIND: Final = re.compile(r"\s+0\s+[-+.\deE]+$")
