"""What the files are that somebody has: scans, photos, calibrations, surveyed points, cameras."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

from orthoflow.errors import InputError
from orthoflow.files.calibration import read_calibration
from orthoflow.files.camera_formats import read_given_cameras
from orthoflow.files.containers import HOW_TO_DEVELOP
from orthoflow.files.e57_images import SUFFIX as E57_SUFFIX
from orthoflow.files.e57_images import E57ImageCount, count_e57_images
from orthoflow.files.images import PHOTO_SUFFIXES, RAW_SUFFIXES
from orthoflow.files.points.formats import FORMATS, TEXT, open_scan
from orthoflow.files.survey_points import read_measured_ties, read_survey_points
from orthoflow.sdk.lines import text_of_path

FileKind: TypeAlias = Literal[
    "scan", "photos", "calibration", "checkpoints", "ties", "cameras", "other", "unknown"
]

_RASTERS: Final = (".tif", ".tiff")
_YAML: Final = (".yaml", ".yml")
_CAMERAS: Final = (".xml", ".out", ".json")
_SCAN_SUFFIXES: Final = tuple(
    suffix for item in FORMATS if item is not TEXT for suffix in item.suffixes
)
_FIRST_LINE_BYTES: Final = 10_000
_WORKFLOW_BYTES: Final = 1_000_000
# What a run leaves in its folder: pictures in there are no photos.
_OF_RUNS: Final = frozenset(("run.h5", "journal.jsonl"))
DEEPEST: Final = 3
MOST_FILES: Final = 20_000


@dataclass(frozen=True, kw_only=True)
class Recognised:
    """A file, or a folder that is one thing.

    Attributes:
        kind: what it is; `unknown` for what no method reads.
        path: as it was found.
        said: what is in it, in words; why nothing is known of it.
        n_photos: photos in it, also those in a scan.
        n_posed: photos in a scan whose lens and pose it states.
        fields: what each point of a scan has besides coordinates.
    """

    kind: FileKind
    path: Path
    said: str = ""
    n_photos: int = 0
    n_posed: int = 0
    fields: frozenset[str] = frozenset()


def recognised(paths: Sequence[Path]) -> list[Recognised]:
    """Say what files are, and what lies in folders, by looking into them.

    Raises:
        InputError: a path leads nowhere, there are too many files, or a scan is damaged.
    """
    found: list[Recognised] = []
    for path in paths:
        if not path.exists():
            raise InputError(f"{path} does not exist: give scans, photos, and folders with them")
        found += _in_folder(path, 0) if path.is_dir() else [_file(path)]
        if len(found) > MOST_FILES:
            raise InputError(f"{path} holds more than {MOST_FILES} files: name those that count")
    return found


def _in_folder(folder: Path, depth: int) -> Iterator[Recognised]:
    inside = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    files = [path for path in inside if path.is_file()]
    names = {path.name.lower() for path in files}
    if depth and not _OF_RUNS.isdisjoint(names):
        yield Recognised(kind="unknown", path=folder, said="a folder of results")
        return
    if any({f"images{end}", f"cameras{end}"} <= names for end in (".bin", ".txt")):
        yield _read("cameras", folder, lambda _: _cameras_said(files))
        return
    yield from map(_file, files)
    for path in inside:
        if path.is_dir() and not path.is_symlink() and depth < DEEPEST:
            yield from _in_folder(path, depth + 1)


def _file(path: Path) -> Recognised:
    if not path.is_file():
        return Recognised(kind="unknown", path=path, said="a pipe or a device")
    if text_of_path(path) is None:
        return Recognised(kind="unknown", path=path, said="its path is no UTF-8: rename it")
    suffix = path.suffix.lower()
    if suffix in _RASTERS and path.with_suffix(".json").is_file():
        return Recognised(kind="other", path=path, said="an orthoimage with its frame beside it")
    if suffix in PHOTO_SUFFIXES:
        return Recognised(kind="photos", path=path, said="a photo", n_photos=1)
    readers: dict[str, Callable[[Path], Recognised]] = {
        **dict.fromkeys(TEXT.suffixes, _table),
        **dict.fromkeys(_SCAN_SUFFIXES, _scan),
        **dict.fromkeys(RAW_SUFFIXES, _raw),
        **dict.fromkeys(_YAML, _yaml),
        **dict.fromkeys(
            _CAMERAS, lambda file: _read("cameras", file, lambda f: _cameras_said([f]))
        ),
    }
    # Scanners and sidecars write JSON of all kinds.
    if suffix not in readers or (suffix == ".json" and path.name != "cameras.json"):
        return Recognised(kind="unknown", path=path, said="no method reads such files")
    return readers[suffix](path)


def _raw(path: Path) -> Recognised:
    said = f"camera raw, which is not read: {HOW_TO_DEVELOP}"
    return Recognised(kind="unknown", path=path, said=said)


def _scan(path: Path) -> Recognised:
    scan = open_scan(path)
    fields = frozenset(str(name) for name in scan.fields)
    is_e57 = path.suffix.lower() == E57_SUFFIX
    photos = count_e57_images(path) if is_e57 else E57ImageCount()
    words = [scan.format_name, f"{scan.n_most:,} points"]
    if has := [word for name, word in _FIELDS.items() if name in fields]:
        # Files may have room for them and nothing in it.
        words.append(f"fields for {' and '.join(has)}")
    if photos.n_images:
        count = f"{photos.n_images} photos" if photos.n_images > 1 else "a photo"
        words.append(count if photos.n_posed else f"{count} without a pose")
    return Recognised(
        kind="scan",
        path=path,
        said=", ".join(words),
        n_photos=photos.n_images,
        n_posed=photos.n_posed,
        fields=fields,
    )


_FIELDS: Final[Mapping[str, str]] = {"intensity": "intensity", "rgb": "colours"}


def _table(path: Path) -> Recognised:
    """A table of points or ties, else a scan in text: of which a name stands in no line."""
    for kind, reader, noun in _TABLES:
        try:
            rows = reader(path)
        except InputError as error:
            if _has_columns_of(path, kind):
                first = str(error).partition("\n")[0]
                return Recognised(kind="unknown", path=path, said=first)
            continue
        if not _is_cloud(rows):
            return Recognised(kind=kind, path=path, said=f"{len(rows)} {noun}")
    if path.suffix.lower() == ".csv":
        found = _read("cameras", path, lambda file: _cameras_said([file]))
        if found.kind == "cameras":
            return found
    try:
        return _scan(path)
    except InputError as error:
        return Recognised(kind="unknown", path=path, said=str(error))


_TABLES: Final[Sequence[tuple[FileKind, Callable[[Path], Sequence[object]], str]]] = (
    ("ties", read_measured_ties, "ties measured in photos"),
    ("checkpoints", read_survey_points, "surveyed points"),
)


_COLUMNS: Final[Mapping[FileKind, frozenset[str]]] = {
    "ties": frozenset(("photo", "x", "y", "z")),
    "checkpoints": frozenset(("name", "x", "y", "z")),
}


def _has_columns_of(path: Path, kind: FileKind) -> bool:
    """Whether the first line names the columns of a table, which nothing else would."""
    with path.open("rb") as file:
        first = file.readline(_FIRST_LINE_BYTES).decode("utf-8", "replace")
    names = {word.strip().lower() for word in re.split(r"[,;\t]", first)}
    return _COLUMNS[kind] <= names


def _is_cloud(rows: Sequence[object]) -> bool:
    """Whether what was read as names are coordinates: nobody calls a point 12.345."""
    names = [str(getattr(row, "name", "")) for row in rows]
    return all(re.fullmatch(r"[-+]?\d+\.\d*(e[-+]?\d+)?", name) for name in names)


def _yaml(path: Path) -> Recognised:
    """A calibration; a workflow, which `new` may have written before, is told as one."""
    found = _read("calibration", path, _calibration_said)
    with path.open("rb") as file:
        is_workflow = re.search(rb"^steps:", file.read(_WORKFLOW_BYTES), re.MULTILINE)
    if found.kind == "unknown" and is_workflow:
        return Recognised(kind="unknown", path=path, said=f"{path.name} is a workflow itself")
    return found


def _calibration_said(path: Path) -> str:
    return f"a calibration of {', '.join(read_calibration(path).patterns)}"


def _cameras_said(paths: Sequence[Path]) -> str:
    return f"{len(read_given_cameras(paths))} cameras"


def _read(kind: FileKind, path: Path, said: Callable[[Path], str]) -> Recognised:
    try:
        return Recognised(kind=kind, path=path, said=said(path))
    except InputError as error:
        first = str(error).partition("\n")[0]
        return Recognised(kind="unknown", path=path, said=first)
