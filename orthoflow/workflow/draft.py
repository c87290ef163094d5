"""Drafts a workflow: recognises files, and inserts them into a shipped recipe."""

from __future__ import annotations

import glob
import json
import os
import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.calibration import read_calibration
from orthoflow.files.camera_formats import read_given_cameras
from orthoflow.files.e57_images import SUFFIX as E57_SUFFIX
from orthoflow.files.e57_images import E57ImageCount, count_e57_images
from orthoflow.files.images import PHOTO_SUFFIXES, RAW_SUFFIXES
from orthoflow.files.photo_files import (
    HOW_TO_DEVELOP,
    photo_format,
    read_exif,
    stated_size,
    unreadable,
)
from orthoflow.files.points import FORMATS, ScanFile, open_scan
from orthoflow.files.points.formats import TEXT
from orthoflow.files.points.units import refuse_degrees
from orthoflow.files.survey_points import read_measured_ties, read_survey_points
from orthoflow.geometry.cloud_quality import judge_quality
from orthoflow.sdk.lines import text_of_path
from orthoflow.untrusted_text import first_few
from orthoflow.workflow.source import shipped_workflow

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
# These files identify a run folder, in which images are not photos.
_OF_RUNS: Final = frozenset(("run.h5", "journal.jsonl"))
#: levels of subfolders that `orthoflow new` searches
DEEPEST: Final = 3
#: files that `orthoflow new` inspects in a folder
MOST_FILES: Final = 20_000


@dataclass(frozen=True, kw_only=True)
class Recognised:
    """A recognised file, or a folder that counts as a single item, such as a run folder.

    Attributes:
        kind: type of the item; `unknown` if no method can read it.
        path: path of the file or folder.
        summary: description of the content, or the reason why the file cannot be used.
        n_points: number of points of a scan.
        n_photos: 1 for a photo; for a scan, number of photos in its file.
        n_posed: number of photos in a scan whose lens and pose are known.
        fields: point attributes of a scan that are not empty, without the coordinates.
        lens: camera and focal length of a photo, from its EXIF data.
        size_px: width and height of a photo.
        matrix: fx, fy, cx and cy in pixels, if the file contains a camera matrix.
        is_text: whether the file is a text file that cannot be read as a scan.
        up: up axis suggested by the surfaces of a scan; empty unless it is clearly not z.
        advice: suggested settings and inputs that follow from the data.
    """

    kind: FileKind
    path: Path
    summary: str = ""
    n_points: int = 0
    n_photos: int = 0
    n_posed: int = 0
    fields: frozenset[str] = frozenset()
    lens: str = ""
    size_px: tuple[int, int] | None = None
    matrix: tuple[float, ...] = ()
    is_text: bool = False
    up: str = ""
    advice: tuple[str, ...] = ()


def recognised(paths: Sequence[Path]) -> list[Recognised]:
    """Recognise files, and the files in folders, by their content.

    Raises:
        InputError: a path does not exist, there are too many files, or a scan is damaged.
    """
    found: list[Recognised] = []
    for path in paths:
        if not path.exists():
            raise InputError(
                f"{path} does not exist: give scans, photos, or folders that contain them"
            )
        found += _in_folder(path, 0) if path.is_dir() else [_file(path)]
        if len(found) > MOST_FILES:
            raise InputError(
                f"{path} contains more than {MOST_FILES} files: give only the files that are needed"
            )
    return found


def _in_folder(folder: Path, depth: int) -> Iterator[Recognised]:
    inside = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    files = [path for path in inside if path.is_file()]
    names = {path.name.lower() for path in files}
    if depth and not _OF_RUNS.isdisjoint(names):
        yield _unknown(folder, "a run folder")
        return
    if any({f"images{end}", f"cameras{end}"} <= names for end in (".bin", ".txt")):
        yield _read("cameras", folder, lambda _: _cameras_summary(files))
        return
    yield from map(_file, files)
    for path in inside:
        if path.is_dir() and not path.is_symlink() and depth < DEEPEST:
            yield from _in_folder(path, depth + 1)


def _unknown(path: Path, why: object) -> Recognised:
    return Recognised(kind="unknown", path=path, summary=str(why).partition("\n")[0])


def _file(path: Path) -> Recognised:
    suffix = path.suffix.lower()
    if not path.is_file():
        return _unknown(path, "a pipe or a device")
    if text_of_path(path) is None:
        return _unknown(path, "its path is not UTF-8: rename it")
    if suffix in _RASTERS and path.with_suffix(".json").is_file():
        return Recognised(kind="other", path=path, summary="an orthoimage with its position (JSON)")
    if suffix in RAW_SUFFIXES:
        return _unknown(path, f"camera raw format, which cannot be read: {HOW_TO_DEVELOP}")
    readers: list[tuple[Sequence[str], Callable[[Path], Recognised]]] = [
        (PHOTO_SUFFIXES, _photo),
        (TEXT.suffixes, _table),
        (_SCAN_SUFFIXES, _scan),
        (_YAML, _yaml),
        (_CAMERAS, lambda file: _read("cameras", file, lambda one: _cameras_summary([one]))),
    ]
    # JSON files are also written by scanners and as sidecars, so do not try to read them as
    # cameras.
    is_odd = suffix == ".json" and path.name != "cameras.json"
    for suffixes, reader in readers:
        if suffix in suffixes and not is_odd:
            return reader(path)
    return _unknown(path, "no method reads files of this type")


def _photo(path: Path) -> Recognised:
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    # A HEIC file must be read completely; other formats are recognised by their first bytes.
    problem = unreadable(path.read_bytes() if photo_format(head) == "HEIC" else head)
    if problem:
        return _unknown(path, problem)
    exif = read_exif(head)
    lengths = {"mm": exif.focal_mm, "mm (35 mm equivalent)": exif.focal_35mm}
    stated = [f"{value:g} {unit}" for unit, value in lengths.items() if value]
    lens = f"{exif.camera} {stated[0]}".strip() if stated else ""
    return Recognised(
        kind="photos",
        path=path,
        summary="a photo",
        n_photos=1,
        lens=lens,
        size_px=stated_size(head),
    )


def _scan(path: Path) -> Recognised:
    scan = open_scan(path)
    unit = scan.scans[0].unit
    if unit is not None:
        refuse_degrees(path.name, unit)
    stated = {str(name) for name in scan.fields} & _FIELDS.keys()
    fields, points_m = _seen_in(scan, np.ones(3) if unit is None else np.array(unit.metres))
    is_e57 = path.suffix.lower() == E57_SUFFIX
    photos = count_e57_images(path) if is_e57 else E57ImageCount()
    words = [scan.format_name, f"{scan.n_most:,} points"]
    if unit is not None:
        words.append(f"unit {unit.name} ({unit.source})")
    for beginning, names in (
        ("", fields),
        ("empty fields for ", stated - fields),
    ):
        if names:
            listed = " and ".join(word for name, word in _FIELDS.items() if name in names)
            words.append(f"{beginning}{listed}")
    if photos.n_images:
        count = f"{photos.n_images} photos" if photos.n_images > 1 else "a photo"
        words.append(count if photos.n_posed else f"{count} without a pose")
    up = _axis_up(points_m)
    # Largest extent along a coordinate axis.
    extent_m = float(np.ptp(points_m, axis=0).max()) if len(points_m) else 0.0
    advice = _about_extent(path.name, extent_m, "m" if unit is None else unit.name)
    if up:
        advice.append(
            f"the surfaces in {_word(path.name)} suggest that {up} points up, not z, so the "
            f"workflow contains cloud.up={up}; change it to -{up} if floors become ceilings"
        )
    return Recognised(
        kind="scan",
        path=path,
        summary=", ".join(words),
        n_points=scan.n_most,
        n_photos=photos.n_images,
        n_posed=photos.n_posed,
        fields=fields,
        up=up,
        advice=tuple(advice),
    )


def _axis_up(points_m: NDArray[np.float64]) -> str:
    """Return the up axis suggested by points (n, 3) in metres; empty unless it is clearly not z."""
    if not len(points_m):
        return ""
    offsets = (points_m - np.median(points_m, axis=0)).astype(np.float32)
    quality = judge_quality(list(offsets.T), None)
    axis = None if quality is None else quality.plainly_up(np.array([0.0, 0.0, 1.0]))
    return "" if axis is None else "xyz"[axis]


def _seen_in(
    scan: ScanFile, unit_m: NDArray[np.float64]
) -> tuple[frozenset[str], NDArray[np.float64]]:
    """Return the fields of a scan that are not empty, and points (n, 3) in metres.

    Only the first points of the scan are read. `unit_m` contains the lengths in metres of one unit
    along the three axes.
    """
    kept: list[NDArray[np.float64]] = []
    found: set[str] = set()
    n_seen = 0
    for block in scan.read():
        kept.append(block.points[np.isfinite(block.points).all(axis=1)] * unit_m)
        values = {"intensity": block.intensity, "rgb": block.rgb}
        found |= {
            name for name, one in values.items() if one is not None and np.nan_to_num(one).any()
        }
        n_seen += block.n_read
        if n_seen >= _LOOKED_AT:
            break
    return frozenset(found), np.concatenate([np.empty((0, 3)), *kept])


def _about_extent(name: str, extent_m: float, unit: str) -> list[str]:
    if extent_m > _MAX_EXTENT_M:
        size, hint = (
            f"{extent_m:,.0f} m",
            ("if its coordinates are in millimetres, set cloud.unit=mm"),
        )
    elif 0 < extent_m < _MIN_EXTENT_M:
        size = f"{extent_m * 1000:.3g} mm"
        hint = "check in which unit it was exported, and set cloud.unit"
    else:
        return []
    return [f"{_word(name)} extends over {size} if its unit is {unit}: {hint}"]


# Extents of terrestrial scans are usually between these limits.
_MAX_EXTENT_M: Final = 2000.0
_MIN_EXTENT_M: Final = 0.2
# Number of points read from a scan, and number of bytes read from the beginning of a photo, which
# contains the EXIF data.
_LOOKED_AT: Final = 1_000_000
_HEAD_BYTES: Final = 1 << 20
_FIELDS: Final[Mapping[str, str]] = {"intensity": "intensity", "rgb": "colours"}


def _table(path: Path) -> Recognised:
    with path.open("rb") as file:
        head = file.read(_FIRST_LINE_BYTES).decode("utf-8", "replace")
    if matrix := _matrix_in(head):
        summary = "a camera matrix: write it into a calibration file"
        return Recognised(kind="unknown", path=path, summary=summary, matrix=matrix)
    first = head.partition("\n")[0]
    columns = {word.strip().lower() for word in re.split(r"[,;\t]", first)}
    for kind, reader, noun, own in _TABLES:
        try:
            rows = reader(path)
        except InputError as error:
            # Only files of this type have these columns.
            if columns >= own:
                return _unknown(path, error)
            continue
        if not _is_cloud(rows):
            return Recognised(kind=kind, path=path, summary=f"{len(rows)} {noun}")
    if path.suffix.lower() == ".csv":
        found = _read("cameras", path, lambda file: _cameras_summary([file]))
        if found.kind == "cameras":
            return found
    try:
        return _scan(path)
    except InputError as error:
        return replace(_unknown(path, error), is_text=True)


def _matrix_in(text: str) -> tuple[float, ...]:
    """Return fx, fy, cx and cy if text begins with a 3 x 3 camera matrix, otherwise ()."""
    try:
        values = [float(word) for word in re.split(r"[\s,;]+", text.strip())[:9]]
    except ValueError:
        return ()
    if len(values) < 9 or values[3:4] + values[6:] != [0.0, 0.0, 0.0, 1.0]:
        return ()
    fx, _, cx, _, fy, cy = values[:6]
    return (fx, fy, cx, cy) if min(fx, fy, cx, cy) > 1.0 else ()


_TABLES: Final[
    Sequence[tuple[FileKind, Callable[[Path], Sequence[object]], str, frozenset[str]]]
] = (
    (
        "ties",
        read_measured_ties,
        "ties measured in photos",
        frozenset(("photo", "x", "y", "z")),
    ),
    ("checkpoints", read_survey_points, "surveyed points", frozenset(("name", "x", "y", "z"))),
)


def _is_cloud(rows: Sequence[object]) -> bool:
    """Whether all point names are decimal numbers, so that the points are in fact a scan."""
    names = [str(getattr(row, "name", "")) for row in rows]
    return all(re.fullmatch(r"[-+]?\d+\.\d*(e[-+]?\d+)?", name) for name in names)


def _yaml(path: Path) -> Recognised:
    found = _read(
        "calibration",
        path,
        lambda _: f"a calibration for the photos {', '.join(read_calibration(path).patterns)}",
    )
    with path.open("rb") as file:
        is_workflow = re.search(rb"^steps:", file.read(_WORKFLOW_BYTES), re.MULTILINE)
    if found.kind == "unknown" and is_workflow:
        return _unknown(path, f"{path.name} is already a workflow")
    return found


def _cameras_summary(paths: Sequence[Path]) -> str:
    n_cameras = len(read_given_cameras(paths))
    return "1 camera" if n_cameras == 1 else f"{n_cameras} cameras"


def _read(kind: FileKind, path: Path, summary: Callable[[Path], str]) -> Recognised:
    try:
        return Recognised(kind=kind, path=path, summary=summary(path))
    except InputError as error:
        return _unknown(path, error)


Recipe: TypeAlias = Literal["photos-on-scan", "direct", "plan"]

# Steps of the recipe that replace a missing scan by a simulated room.
_STAND_INS: Final = ("room", "check")
_PLAIN: Final = re.compile(r"[A-Za-z0-9_./][A-Za-z0-9_./-]*")
_INPUT: Final = re.compile(r"  (\w+): \{.*?\}( *#.*)?")
_MOST_LISTED: Final = 12
_FEW_SCANS: Final = 3
# A relative path that begins with this is replaced by the absolute path, because that is easier to
# read.
_FAR: Final = "../../.."


@dataclass(frozen=True, kw_only=True)
class Draft:
    """A drafted workflow.

    Attributes:
        recipe: name of the shipped recipe on which the workflow is based.
        text: text of the workflow file.
        inputs: input -> description of its files.
        left_out: files that are not used as input, each with the reason.
        advice: suggested settings and inputs that follow from the data.
    """

    recipe: Recipe
    text: str
    inputs: Mapping[str, str]
    left_out: Sequence[str]
    advice: Sequence[str] = ()


def draft_workflow(found: Sequence[Recognised], target: Path, recipe: Recipe | None) -> Draft:
    """Draft a workflow for a set of files.

    Args:
        found: recognised files.
        target: path of the workflow file; paths in the file are relative to its folder.
        recipe: recipe to use; if None, the recipe creates orthoimages from photos if there are any,
            otherwise from the colours of the scan.

    Raises:
        InputError: there is no scan, the recipe needs photos but there are none, or, if no recipe
            is given, the scan has neither colours nor intensity.
    """
    by_kind: dict[FileKind, list[Recognised]] = {}
    for item in found:
        by_kind.setdefault(item.kind, []).append(item)
    scans = by_kind.get("scan", [])
    if not scans:
        others = "; ".join(f"{item.path.name}: {item.summary}" for item in found[:_MOST_LISTED])
        raise InputError(
            "none of the files is a scan, but a workflow needs one (E57, LAS, LAZ, PLY, PCD, PTX "
            f"or text); found {others or 'nothing'}"
        )
    own_formats = [scan for scan in scans if scan.path.suffix.lower() not in TEXT.suffixes]
    if own_formats:
        # If there are scans in other formats, text files are probably not scans but notes.
        by_kind["unknown"] = [
            replace(
                item,
                summary="text file, ignored because there are scans in other formats",
                advice=(),
            )
            if item in scans or item.is_text
            else item
            for item in (*by_kind.get("unknown", []), *scans)
            if item not in own_formats
        ]
        scans = by_kind["scan"] = own_formats
    own_photos = [scan for scan in scans if scan.n_photos]
    has_posed = any(scan.n_posed for scan in own_photos)
    # Images without a pose in a scan are mostly meant for viewing, and could not be matched with
    # walls.
    is_usual = bool(by_kind.get("photos") or has_posed)
    chosen: Recipe = recipe or ("photos-on-scan" if is_usual else "direct")
    if chosen == "photos-on-scan" and not (own_photos or is_usual):
        raise InputError("none of the files is a photo, but the recipe photos-on-scan needs photos")
    has_paint = any({"intensity", "rgb"} & scan.fields for scan in scans)
    if recipe is None and chosen == "direct" and not has_paint:
        raise InputError(
            f"the points of {_some([scan.path.name for scan in scans])} have neither colours nor "
            "intensity, so no orthoimage can be made from them: give photos too, or export the "
            "scan with its colours (--recipe direct writes the workflow anyway)"
        )
    if own_photos and "photos" not in by_kind:
        # Photos taken by a scanner are stored in the scan file together with their poses.
        inside = [
            replace(scan, summary="the photos in this file", n_points=0) for scan in own_photos
        ]
        by_kind["photos"] = inside
        if len(inside) == 1 and has_posed:
            by_kind.setdefault(
                "cameras", [replace(inside[0], summary="the poses of the photos in this file")]
            )
    return _drafted(by_kind, target, chosen)


_ByKind: TypeAlias = Mapping[FileKind, Sequence[Recognised]]


def _drafted(by_kind: _ByKind, target: Path, recipe: Recipe) -> Draft:
    shipped = shipped_workflow(recipe).read_text(encoding="utf-8")
    _, inputs, steps = re.split(r"^(?=orthoflow:|steps:)", shipped, flags=re.MULTILINE)
    taken, left_out = _assigned(by_kind, inputs, recipe)
    lines = []
    for line in inputs.splitlines():
        match = _INPUT.fullmatch(line)
        files = taken.get(match[1], ()) if match else ()
        lines.append(_input_line(match[1], files, target) if match and files else line)
    described = {name: _described(files) for name, files in taken.items()}
    advice = _advice(by_kind)
    name = re.sub(r"[^A-Za-z0-9_-]+", "-", target.stem).strip("-") or recipe
    body = re.sub(r"^name: .*$", f"name: {name}", "\n".join(lines), flags=re.MULTILINE)
    run = shlex.quote(target.name)
    summary = [
        f"# Created by `orthoflow new` from the recipe {recipe}.yaml.",
        *(f"#   {name}: {text}" for name, text in described.items()),
        *(f"# Not used: {text}" for text in left_out[:_MOST_LISTED]),
        *(f"# Note: {text}" for text in advice[:_MOST_LISTED]),
        "#",
        f"#   orthoflow check {run}       check it for mistakes",
        f"#   orthoflow plan {run}        show what would run",
        f"#   orthoflow run {run} --set wall.gsd_m=0.02    a fast coarse run; then without",
        "",
    ]
    # Set the up axis if all scans suggest the same axis.
    steps = _without_stand_ins(steps)
    axes = {item.up for item in by_kind["scan"]}
    (up,) = axes if len(axes) == 1 else ("",)
    if up:
        reading = "in: {files: inputs.scan}\n"
        steps = steps.replace(reading, f"{reading}    params: {{up: {up}}}\n", 1)
    text = "\n".join([*map(_seen, summary), f"{body}\n{steps}"])
    return Draft(recipe=recipe, text=text, inputs=described, left_out=left_out, advice=advice)


def _advice(by_kind: _ByKind) -> list[str]:
    advice = [text for items in by_kind.values() for item in items for text in item.advice]
    photos = [item for item in by_kind.get("photos", ()) if item.kind == "photos"]
    without = [item.path.name for item in photos if not item.lens]
    if without and not {"calibration", "cameras"} & by_kind.keys():
        sizes = {item.size_px for item in photos if item.size_px}
        width, height = min(sizes) if len(sizes) == 1 else ("WIDTH", "HEIGHT")
        matrices = {item.matrix for item in by_kind.get("unknown", ()) if item.matrix}
        known = [f"{value:g}" for value in min(matrices)] if len(matrices) == 1 else ()
        fx, fy, cx, cy = known or ("FX", "FY", "CX", "CY")
        advice.append(
            f"{len(without)} of {len(photos)} photos have no focal length in their EXIF data: "
            f"{_some(without)}; if you have a calibration, give a file such as calibration.yaml: "
            f'cameras: {{"*": {{width: {width}, height: {height}, fx: {fx}, fy: {fy}, cx: {cx}, '
            f"cy: {cy}, distortion: [0, 0, 0, 0, 0]}}}}"
        )
    return advice


def _assigned(
    by_kind: _ByKind, inputs: str, recipe: Recipe
) -> tuple[dict[str, Sequence[Recognised]], list[str]]:
    names = [match[1] for line in inputs.splitlines() if (match := _INPUT.fullmatch(line))]
    taken: dict[str, Sequence[Recognised]] = {}
    left_out = []
    for kind, items in by_kind.items():
        if kind == "unknown":
            reasons: dict[str, list[str]] = {}
            for item in items:
                reasons.setdefault(item.summary, []).append(item.path.name)
            left_out += [f"{_some(each)}: {reason}" for reason, each in reasons.items()]
        elif kind not in names:
            left_out += [
                f"{item.path.name}: {item.summary}; {recipe} has no input for it" for item in items
            ]
        elif len(items) > 1 and kind not in ("scan", "photos", "other"):
            each = ", ".join(item.path.name for item in items)
            left_out.append(f"{each}: only one file is allowed as {kind}; choose one under inputs")
        elif items:
            taken[kind] = items
    return taken, left_out


def _input_line(name: str, items: Sequence[Recognised], target: Path) -> str:
    paths = _folders_of_photos(items) if name == "photos" else [item.path for item in items]
    if name == "other":
        paths += [path.with_suffix(".json") for path in paths]
    places = [_quoted(_place(path, target)) for path in paths]
    about = _seen(_described(items))
    if len(places) == 1:
        return f"  {name}: {{files: {places[0]}}}  # {about}"
    listed = "\n".join(f"      - {place}" for place in places)
    return f"  {name}:  # {about}\n    files:\n{listed}"


def _place(path: Path, target: Path) -> str:
    """Return a path relative to the folder of the workflow, or absolute if it is far away."""
    here, place = (Path(os.path.normpath(one.absolute())) for one in (target.parent, path))
    if not place.is_relative_to(here):
        # If `..` follows a symbolic link, it leads to another folder than the path suggests.
        here, place = here.resolve(), place.resolve()
    relative = Path(os.path.relpath(place, here)).as_posix()
    return place.as_posix() if relative.startswith(_FAR) else relative


def _folders_of_photos(items: Sequence[Recognised]) -> list[Path]:
    """Return paths of photos, with a folder or pattern in place of photos where possible.

    This is possible for a folder if all photos in it are used.
    """
    paths = [item.path for item in items]
    places: dict[Path, None] = {}
    for path in paths:
        inside = [p for p in path.parent.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES]
        whole = path.suffix.lower() in PHOTO_SUFFIXES and set(inside) <= set(paths)
        # A folder as input stands for all files in it, so it must contain only photos.
        beside = (file for file in path.parent.iterdir() if file.is_file())
        whole = whole and len(inside) > 1
        if whole and all(file.suffix.lower() in PHOTO_SUFFIXES for file in beside):
            path = path.parent  # noqa: PLW2901
        elif whole and glob.escape(str(path.parent)) == str(path.parent):
            path = path.with_name(f"*{path.suffix}")  # noqa: PLW2901
        places[path] = None
    return list(places)


def _described(items: Sequence[Recognised]) -> str:
    if len(items) == 1 or (len(items) <= _FEW_SCANS and all(item.n_points for item in items)):
        return "; ".join(f"{_word(item.path.name)}, {item.summary}" for item in items)
    n_photos = sum(item.n_photos for item in items)
    if n_photos == len(items):
        lenses = Counter(item.lens for item in items if item.lens)
        listed = [f"{_word(lens)} ({count})" for lens, count in lenses.most_common()]
        return ", ".join([f"{n_photos} photos", *([first_few(listed, most=4)] if listed else [])])
    return f"{len(items)} files: {_some([item.path.name for item in items])}"


def _some(names: Sequence[str]) -> str:
    return first_few([*map(_word, names)], most=4)


def _word(name: str) -> str:
    """Escape line breaks in the name of a file, for use in a comment."""
    return json.dumps(name, ensure_ascii=False)[1:-1]


def _quoted(text: str) -> str:
    return text if _PLAIN.fullmatch(text) else _seen(json.dumps(text, ensure_ascii=False))


def _seen(text: str) -> str:
    """Escape all invisible characters as in YAML, because some of them would end a comment."""
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode("ascii")
        for letter in text
    )


def _without_stand_ins(steps: str) -> str:
    blocks = re.split(r"^(?=  \w+:)", steps, flags=re.MULTILINE)
    has_room = any(block.startswith("  room:") for block in blocks)
    kept = [
        block
        for block in blocks
        if not (has_room and block.partition(":")[0].strip() in _STAND_INS)
    ]
    text = "".join(kept).replace(", room.cloud]", "]")
    return re.sub(r"\[([\w.]+)\]", r"\1", text)
