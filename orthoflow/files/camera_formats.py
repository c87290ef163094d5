"""Which reader a file of cameras needs, told by its name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from orthoflow.alike import first_few
from orthoflow.errors import InputError
from orthoflow.files.colmap import read_colmap_model
from orthoflow.files.e57_images import read_e57_images
from orthoflow.files.given_cameras import (
    MOST_CAMERAS,
    GivenCamera,
    bare_name,
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
    by_name = {path.name.lower(): path for path in paths}
    for suffix in (".bin", ".txt"):
        if f"images{suffix}" in by_name and f"cameras{suffix}" in by_name:
            return read_colmap_model(by_name[f"cameras{suffix}"], by_name[f"images{suffix}"])
    readers: dict[str, Callable[[Path], tuple[GivenCamera, ...]]] = {
        ".json": read_cameras_json,
        ".xml": read_metashape_xml,
        ".csv": read_realitycapture_list,
        ".e57": lambda path: tuple(image.camera for image in read_e57_images(path)),
        ".out": lambda path: read_bundler(path, _photo_list(path, paths)),
    }
    for suffix, reader in readers.items():
        found = [path for path in paths if path.suffix.lower() == suffix]
        if len(found) == 1:
            return reader(found[0])
    names = first_few([path.name for path in paths])
    raise InputError(
        f"{names or 'nothing'} holds no cameras that orthoflow reads: expected one cameras.json of "
        "a run, a folder with COLMAP's cameras.txt and images.txt (or .bin), Metashape's .xml, "
        "Bundler's .out with its list of photos (.txt) beside it, RealityCapture's .csv, or an E57 "
        "file with photos"
    )


def _photo_list(path: Path, paths: Sequence[Path]) -> list[str]:
    """Names of the photos of a Bundler file, from the list beside it."""
    lists = [other for other in paths if other.suffix.lower() == ".txt"]
    if len(lists) != 1:
        raise InputError(
            f"{path.name} says nothing of names: give the folder with it and its list of photos "
            f"(.txt), one line each; there are {len(lists)} such files"
        )
    lines = [line.split(maxsplit=1) for line in text_of(lists[0]).splitlines()]
    return [bare_name(words[0]) for words in lines if words][: MOST_CAMERAS + 1]
