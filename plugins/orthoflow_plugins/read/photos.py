"""`read.photos`: a folder of photographs, with what EXIF and a calibration say of their cameras."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final

from orthoflow.errors import InputError
from orthoflow.files.calibration import intrinsics_for, matching_pattern, read_calibration
from orthoflow.files.containers import image_format, is_cut_off
from orthoflow.files.exif import Exif, FocalLength, focal_length, read_exif
from orthoflow.files.images import decode_image
from orthoflow.products import Calibration, InputFiles, Photo, Photos
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from orthoflow_plugins.read.figures import ContactSheet

_SUFFIXES: Final = frozenset({".jpg", ".jpeg", ".jpe", ".png", ".tif", ".tiff"})
_NAMED: Final = 3


class ReadPhotos(Method):
    """Read JPEG, PNG and TIFF photos as they are, ordered by name.

    The files' bytes are kept and never encoded again. Pixels are those of the stored array: the
    EXIF orientation is written down, not applied. Every photo is decoded once, so that a damaged
    file is found here and not after an hour.
    """

    id = "read.photos"
    result_version = 1
    determinism = "exact"
    citations: ClassVar[tuple[str, ...]] = (
        "CIPA DC-008, Exchangeable image file format for digital still cameras (Exif)",
        "CIPA DCG-001, 35 mm equivalent focal length over the diagonal",
        "Brown 1971, Close-range camera calibration, Photogrammetric Engineering 37(8)",
    )

    class Params(MethodParams):
        """Nothing to set: files and calibration say everything."""

    class In(Ports):
        """The photos, and a calibration file if there is one."""

        files: InputFiles
        calibration: InputFiles | None = None

    class Out(Ports):
        """The photos."""

        photos: Photos

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Read all photos; see the class."""
        paths = _photo_paths(ctx, inputs.files)
        calibration = _calibration(inputs.calibration)
        sheet = ContactSheet(len(paths))
        read = []
        for index, path in enumerate(paths):
            ctx.progress(index / len(paths), path.name)
            read.append(_read_photo(path, calibration, sheet))
            ctx.log(_described(read[-1]))
        _warn(ctx, read, calibration)
        photos = Photos(photos=tuple(item.photo for item in read))
        _report_metrics(ctx, photos)
        ctx.figure("photos", sheet.encoded(), sheet.caption)
        return self.Out(photos=photos)


@dataclass(frozen=True, kw_only=True)
class _ReadPhoto:
    photo: Photo
    exif: Exif
    focal: FocalLength


def _photo_paths(ctx: StepContext, files: InputFiles) -> list[Path]:
    """Image files ordered by name; says which others there are."""
    paths = [path for path in files.paths if path.suffix.lower() in _SUFFIXES]
    others = [path.name for path in files.paths if path.suffix.lower() not in _SUFFIXES]
    if not files.paths:
        raise InputError(f"the input {files.name} names no files: expected photos")
    if not paths:
        raise InputError(
            f"the input {files.name} holds no photo, only {len(others)} other files: "
            f"{_names(others)}; expected JPEG, PNG or TIFF (.jpg, .png, .tif), so develop raw and "
            "HEIC photos first"
        )
    counts = Counter(path.name for path in paths)
    twice = sorted(name for name, count in counts.items() if count > 1)
    if twice:
        raise InputError(
            f"the input {files.name} holds several photos named {_names(twice)} in different "
            "folders: poses and ties refer to photos by name, so rename one of them"
        )
    if others:
        ctx.warn(
            f"{len(others)} of {len(files.paths)} files of the input {files.name} are no JPEG, "
            f"PNG or TIFF and were left out: {_names(others)}"
        )
    return sorted(paths, key=lambda path: path.name)


def _calibration(files: InputFiles | None) -> Calibration | None:
    if files is None:
        return None
    if len(files.paths) != 1:
        raise InputError(
            f"the input {files.name} names {len(files.paths)} files: expected one calibration "
            "file, which may hold several cameras"
        )
    return read_calibration(files.paths[0])


def _read_photo(path: Path, calibration: Calibration | None, sheet: ContactSheet) -> _ReadPhoto:
    name = path.name
    try:
        encoded = path.read_bytes()
    except OSError as error:
        raise InputError(f"photo {name} cannot be read: {error.strerror}") from error
    if image_format(encoded) is None:
        raise InputError(
            f"photo {name} is no JPEG, PNG or TIFF file ({len(encoded)} bytes), whatever its name "
            "says: copy it again from the camera, or take it out"
        )
    if is_cut_off(encoded):
        raise InputError(
            f"photo {name} is cut off: its {len(encoded)} bytes end before the image does; copy "
            "it again from the camera, or take it out"
        )
    image = decode_image(encoded, f"photo {name}")
    height, width = image.shape[:2]
    exif = read_exif(encoded)
    focal = focal_length(exif, width, height)
    intrinsics = None
    if calibration is not None:
        intrinsics = intrinsics_for(calibration, name, width, height)
    photo = Photo(
        name=name,
        encoded=encoded,
        width=width,
        height=height,
        exif_orientation=exif.orientation,
        exif_focal_px=focal.value_px,
        intrinsics=intrinsics,
    )
    sheet.add(name, image)
    return _ReadPhoto(photo=photo, exif=exif, focal=focal)


def _described(read: _ReadPhoto) -> str:
    photo, exif, focal = read.photo, read.exif, read.focal
    parts = [f"{photo.name}: {photo.width} x {photo.height}"]
    if exif.camera:
        parts.append(exif.camera)
    if exif.orientation != 1:
        parts.append(f"EXIF orientation {exif.orientation} (not applied)")
    if photo.intrinsics is not None:
        parts.append(f"calibrated, focal length {photo.intrinsics.fx:.1f} px")
    elif focal.value_px is not None:
        parts.append(f"focal length {focal.value_px:.1f} px from the {focal.reason}")
    else:
        parts.append(focal.reason)
    return ", ".join(parts)


def _warn(ctx: StepContext, read: Sequence[_ReadPhoto], calibration: Calibration | None) -> None:
    damaged = [item.photo.name for item in read if item.exif.is_damaged]
    if damaged:
        ctx.warn(f"the EXIF data of {_counted(damaged)} are damaged; what is readable was taken")
    if calibration is not None:
        _warn_of_matches(ctx, read, calibration)
    unknown = [
        item.photo.name
        for item in read
        if item.photo.intrinsics is None and item.photo.exif_focal_px is None
    ]
    if unknown:
        reasons = Counter(item.focal.reason for item in read if item.photo.name in unknown)
        ctx.warn(
            f"the focal length of {_counted(unknown)} is unknown ({reasons.most_common(1)[0][0]}, "
            "and no calibration): the orientation has to find it, needs more ties for that and "
            "may refuse; a calibration file helps"
        )


def _warn_of_matches(
    ctx: StepContext, read: Sequence[_ReadPhoto], calibration: Calibration
) -> None:
    without = [item.photo.name for item in read if item.photo.intrinsics is None]
    if without:
        ctx.warn(f"the calibration has no entry for {_counted(without)}; the others are calibrated")
    used = {matching_pattern(calibration, item.photo.name) for item in read}
    unused = [pattern for pattern in calibration.patterns if pattern not in used]
    if unused:
        ctx.warn(
            f"calibration entries that no photo takes: {_names(unused)}; the case of letters "
            "counts, and the first entry that matches holds"
        )


def _report_metrics(ctx: StepContext, photos: Photos) -> None:
    known = [photo.intrinsics is not None for photo in photos.photos]
    by_exif = [photo.exif_focal_px is not None for photo in photos.photos]
    pixels = sum(photo.width * photo.height for photo in photos.photos)
    ctx.metric("n_photos", len(photos.photos), "1")
    ctx.metric("n_calibrated", sum(known), "1")
    ctx.metric("n_exif_focal", sum(by_exif), "1")
    ctx.metric("megapixels", pixels / 1e6, "Mpx")


def _counted(names: Sequence[str]) -> str:
    return f"photo {names[0]}" if len(names) == 1 else f"{len(names)} photos ({_names(names)})"


def _names(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMED]) + (" ..." if len(names) > _NAMED else "")
