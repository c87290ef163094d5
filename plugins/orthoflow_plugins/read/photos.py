"""`read.photos`: a folder of photos, with cameras from EXIF and from a calibration."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import InputError
from orthoflow.files.calibration import (
    CalibratedLenses,
    lens_for,
    matching_pattern,
    read_calibration,
)
from orthoflow.files.camera_formats import read_given_cameras
from orthoflow.files.cube_faces import (
    CubeFace,
    FisheyeLens,
    PanoramaLens,
    WideLens,
    faces_of,
)
from orthoflow.files.e57_images import SUFFIX as E57_SUFFIX
from orthoflow.files.e57_images import E57Image, read_e57_images
from orthoflow.files.images import (
    PHOTO_SUFFIXES,
    RAW_SUFFIXES,
    decode_image,
    decode_levels,
    decode_mask,
    encode_png,
)
from orthoflow.files.photo_files import (
    Exif,
    FocalLength,
    count_pages,
    damage,
    focal_length,
    opaque_pixels,
    read_exif,
    shifted_row,
    stated_bits,
    unreadable,
)
from orthoflow.geometry.levels import eight_bits
from orthoflow.products import InputFiles, Intrinsics, Photo, Photos
from orthoflow.sdk import DiagnosticSpec, Method, MethodParams, MetricSpec, Ports, StepContext
from orthoflow.untrusted_text import first_few
from orthoflow_plugins.read.cameras import GivenByName
from orthoflow_plugins.read.figures import ContactSheet
from orthoflow_plugins.read.masks import Masks, beside_photos

_PLAIN_BITS: Final = 8
_MOST_PROBLEMS: Final = 20
NO_PHOTOS: Final = DiagnosticSpec(
    code="files-are-no-photos",
    text="{n} of {n_files} files of the input {subject} are not photos (JPEG, PNG, TIFF, WebP, "
    "HEIC) and were ignored: {names}",
    rank_by="n",
)
REMARK: Final = DiagnosticSpec(
    code="photo-file-limited",
    text="{photos}: {remark}",
    rank_by="n",
)
FOCAL_UNKNOWN: Final = DiagnosticSpec(
    code="focal-length-unknown",
    text="the focal length of {photos} is unknown ({reason}, and no calibration): the orientation "
    "must estimate it, needs more ties for this and may fail",
    remedy="provide a calibration file",
    rank_by="n",
)
NOT_CALIBRATED: Final = DiagnosticSpec(
    code="calibration-without-photo",
    text="the calibration has no entry for {photos}; the others are calibrated",
    remedy="add an entry for each",
    rank_by="n",
)
UNUSED_ENTRIES: Final = DiagnosticSpec(
    code="calibration-entries-unused",
    text="calibration entries that match no photo: {names}",
    remedy="names are case-sensitive, and the first matching entry applies",
    rank_by="n",
)


class ReadPhotos(Method):
    """Read JPEG, PNG, TIFF, WebP and HEIC photos and photos in E57 files, ordered by name.

    If photos in several folders have the same file name, their names include the path within the
    input.

    A panorama that is in an E57 file or listed in `panoramas` is split into the six faces of a
    cube. The faces are photos without distortion, stored as PNG files. Photos are split in the same
    way if they have a fisheye lens (OpenCV's model) or are panoramas according to the calibration
    or the given cameras. Of a fisheye photo, only the parts of the faces that the photo shows are
    used.

    The content of the files is kept unchanged and never re-encoded. Pixels are those of the stored
    array; the EXIF orientation is recorded but not applied. If a TIFF file has several pages, the
    photo is the largest page that is not a preview. Every photo is decoded once, so that damaged
    files are found here and not in a later step.

    Pixels that are transparent, black in a mask, or inside polygons are used neither for ties nor
    for colours. Masks are images named NAME_mask.png next to NAME.jpg, or files of the input
    `masks`: images with that name or the name of the photo, or GeoJSON files with polygons in
    pixels. Masks of a panorama or a fisheye photo apply to its faces.
    """

    id = "read.photos"
    result_version: ClassVar[int] = 2
    repeatable: ClassVar[tuple[str, ...]] = ("calibration", "cameras", "masks")
    determinism = "exact"
    metrics = (
        MetricSpec("n_photos", label="photos"),
        MetricSpec("n_calibrated", label="photos with a calibration"),
        MetricSpec("n_exif_focal", label="photos with a focal length in EXIF"),
        MetricSpec("megapixels", label="megapixels in total"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "CIPA DC-008, Exchangeable image file format for digital still cameras, Exif",
        "CIPA DCG-001, 35 mm equivalent focal length over the diagonal",
        "Brown 1971, Close-range camera calibration, Photogrammetric Engineering 37(8)",
        (
            "Kannala, Brandt 2006, A generic camera model ... for fish-eye lenses, "
            "doi:10.1109/TPAMI.2006.153"
        ),
    )

    class Params(MethodParams):
        """Parameters that are in neither the files nor the calibration."""

        panoramas: tuple[str, ...] = Field(
            (),
            description="Names of photos, or patterns such as '360_*.jpg', that are panoramas over "
            "the whole sphere (equirectangular, twice as wide as high): each becomes six photos, "
            "NAME_front.png and so on.",
        )

    class In(Ports):
        """The photos, and optionally a calibration file, masks and given cameras.

        Of the given cameras, only panoramas and those with a fisheye lens are used here.
        """

        files: InputFiles
        calibration: InputFiles | None = None
        cameras: InputFiles | None = None
        masks: InputFiles | None = None

    class Out(Ports):
        """The photos."""

        photos: Photos

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Read all photos."""
        ctx.progress(0.0, inputs.files.name)
        beside = beside_photos(inputs.files.paths)
        masks = Masks.of(sorted(beside), () if inputs.masks is None else inputs.masks.paths)
        calibration = _calibration(inputs.calibration)
        cubes = _Cubes(
            panoramas=params.panoramas,
            calibration=calibration,
            given=_given(inputs.cameras),
            masks=masks,
        )
        sources = _sources(ctx, inputs.files, beside, cubes)
        sheet = ContactSheet(len(sources))
        read: list[_ReadPhoto] = []
        problems: list[str] = []
        for index, source in enumerate(sources):
            ctx.progress(index / len(sources), source.name)
            try:
                read.append(_masked(_read_photo(source, calibration, sheet), source, masks))
            except InputError as error:
                problems.append(str(error))
        if problems:
            more = len(problems) - _MOST_PROBLEMS
            counted = [f"... and {more} more"] if more > 0 else []
            raise InputError("\n".join(problems[:_MOST_PROBLEMS] + counted))
        masks.warn_of_unused(ctx)
        _warn(ctx, read, calibration)
        photos = Photos(photos=tuple(item.photo for item in read))
        known = [photo.intrinsics is not None for photo in photos.photos]
        by_exif = [photo.exif_focal_px is not None for photo in photos.photos]
        n_pixels = sum(photo.width * photo.height for photo in photos.photos)
        ctx.metric("n_photos", len(photos.photos), "1")
        ctx.metric("n_calibrated", sum(known), "1")
        ctx.metric("n_exif_focal", sum(by_exif), "1")
        ctx.metric("megapixels", n_pixels / 1e6, "Mpx")
        ctx.figure("photos", sheet.encoded(), sheet.caption)
        return self.Out(photos=photos)


@dataclass(frozen=True, kw_only=True)
class _ReadPhoto:
    photo: Photo
    focal: FocalLength
    whole: str = ""
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class _Source:
    """Origin of a photo.

    Attributes:
        name: name of the photo.
        content: a file, the content of a photo in an E57 file, or a cube face.
        lens: lens parameters read from the E57 file, or None.
        whole: name of the panorama or fisheye photo from which a cube face was cut, or "".
        folder: folder of the file within the input.
    """

    name: str
    content: Path | bytes | CubeFace
    lens: Intrinsics | None = None
    whole: str = ""
    folder: str = ""

    def encoded(self) -> bytes:
        """Return the encoded content of the photo."""
        if isinstance(self.content, bytes):
            return self.content
        return _bytes_of(self.content) if isinstance(self.content, Path) else self.content.encoded()


def _bytes_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read photo {path.name}: {error.strerror}") from error


@dataclass(frozen=True, kw_only=True)
class _Cubes:
    """Photos that are split into cube faces.

    Attributes:
        panoramas: names of photos that are panoramas, or patterns of such names.
        calibration: lenses by photo name, or None.
        given: cameras from other programs, or None.
        masks: masks of the photos.
    """

    panoramas: Sequence[str]
    calibration: CalibratedLenses | None
    given: GivenByName | None
    masks: Masks

    def sources(self, path: Path, folder: str) -> list[_Source]:
        """Return the photo in a file, the cube faces of the photo, or the photos in an E57 file."""
        if path.suffix.lower() == E57_SUFFIX:
            return [source for image in read_e57_images(path) for source in self._of_e57(image)]
        lens = self._lens(path.name, folder)
        if any(fnmatchcase(path.name, pattern) for pattern in self.panoramas):
            lens = _PANORAMA
        if lens is None:
            return [_Source(name=path.name, content=path)]
        return self._faces(path.name, _bytes_of(path), lens)

    def _of_e57(self, image: E57Image) -> list[_Source]:
        lens = image.camera.lens
        if isinstance(lens, PanoramaLens):
            return self._faces(image.name, image.content, lens)
        lens = lens if isinstance(lens, Intrinsics) else None
        return [_Source(name=image.name, content=image.content, lens=lens)]

    def _lens(self, name: str, folder: str) -> WideLens | None:
        """Return the lens of a panorama or fisheye photo, or None if the photo is neither."""
        camera = None if self.given is None else self.given.of_photo(name, folder)
        if camera is not None and isinstance(camera.lens, WideLens):
            return camera.lens
        if self.calibration is None:
            return None
        pattern = matching_pattern(self.calibration.patterns, name)
        if pattern is None:
            return None
        lens = self.calibration.lenses[self.calibration.patterns.index(pattern)]
        return lens if isinstance(lens, FisheyeLens) else None

    def _faces(self, name: str, encoded: bytes, lens: WideLens) -> list[_Source]:
        """Return the cube faces of a photo that are not completely masked."""
        _require_whole(name, encoded)
        height, width = decode_image(encoded, f"photo {name}").shape[:2]
        if lens == _PANORAMA and width != 2 * height:
            raise InputError(
                f"photo {name} is listed in panoramas, but has {width} x {height} pixels: a "
                "panorama over the whole sphere is twice as wide as high"
            )
        if lens == _PANORAMA:
            lens = PanoramaLens(width=width, height=height)
        if (width, height) != (lens.width, lens.height):
            raise InputError(
                f"photo {name} has {width} x {height} pixels, but its panorama or fisheye lens is "
                f"for {lens.width} x {lens.height}: calibrate at the size of the photos as they "
                "are stored, without the EXIF rotation"
            )
        mask = self.masks.encoded(name, (width, height))
        given = None if mask is None else decode_mask(mask, f"the mask of {name}")
        used = _both(given, opaque_pixels(encoded))
        return [
            _Source(name=face.name, content=face, lens=face.lens, whole=name)
            for face in faces_of(encoded, Path(name).stem, lens, used)
            if (own := face.mask()) is None or own.any()
        ]


# Lens of photos that the user declares to be panoramas; the size is set later.
_PANORAMA: Final = PanoramaLens(width=0, height=0)


def _both(
    one: NDArray[np.bool_] | None, other: NDArray[np.bool_] | None
) -> NDArray[np.bool_] | None:
    """Return a mask of the pixels that are usable in both masks; None means all pixels."""
    return other if one is None else one if other is None else one & other


def _masked(read: _ReadPhoto, source: _Source, masks: Masks) -> _ReadPhoto:
    photo = read.photo
    mask = masks.encoded(photo.name, (photo.width, photo.height))
    face = source.content if isinstance(source.content, CubeFace) else None
    own = opaque_pixels(photo.encoded) if face is None else face.mask()
    if own is not None:
        given = None if mask is None else decode_mask(mask, f"the mask of {photo.name}")
        used = _both(own, given)
        if used is None or not used.any():
            raise InputError(
                f"no pixel of photo {photo.name} is opaque and unmasked: remove the photo"
            )
        mask = encode_png(np.where(used, np.uint8(255), np.uint8(0)))
    return replace(read, photo=replace(photo, mask=mask))


def _sources(ctx: StepContext, files: InputFiles, masks: Set[Path], cubes: _Cubes) -> list[_Source]:
    """Return the photos ordered by name, and warn of other files."""
    if not files.paths:
        raise InputError(f"the input {files.name} has no files: expected photos")
    photos = [path for path in files.paths if path not in masks]
    folders = _folders(photos)
    sources, others = [], []
    for path in photos:
        if path.suffix.lower() in (*PHOTO_SUFFIXES, E57_SUFFIX):
            found = cubes.sources(path, folders[path])
            sources += [replace(source, folder=folders[path]) for source in found]
        else:
            others.append(path.name)
    _refuse_raw(files.name, [source.name for source in sources], others)
    if not sources:
        raise InputError(
            f"the input {files.name} contains no photo, only {first_few(others)}; expected JPEG, "
            "PNG, TIFF, WebP or HEIC (.jpg, .png, .tif ...)"
        )
    if others:
        counts = {"n": len(others), "n_files": len(files.paths)}
        ctx.report(NO_PHOTOS, subject=files.name, names=first_few(others), **counts)
    # If photos have the same file name, name them by their paths within the input.
    counts = Counter(source.name for source in sources)
    named = (
        replace(source, name=f"{source.folder}/{source.name}")
        if counts[source.name] > 1 and source.folder
        else source
        for source in sources
    )
    return sorted(named, key=lambda source: source.name)


def _folders(paths: Sequence[Path]) -> dict[Path, str]:
    """Return the folder of each file relative to the common folder; empty for that folder."""
    common = os.path.commonpath([path.parent for path in paths]) if paths else ""
    relative = {path: path.parent.relative_to(common).as_posix() for path in paths}
    return {path: "" if folder == "." else folder for path, folder in relative.items()}


def _refuse_raw(input_name: str, photos: Sequence[str], others: Sequence[str]) -> None:
    """Reject undeveloped camera raw files, since photos must not be omitted silently.

    Raises:
        InputError: there is a raw file without a photo of the same name.
    """
    developed = {Path(name).stem.lower() for name in photos}
    raw = [
        name
        for name in others
        if Path(name).suffix.lower() in RAW_SUFFIXES and Path(name).stem.lower() not in developed
    ]
    if raw:
        raise InputError(
            f"the input {input_name} contains camera raw files, which are not supported: "
            f"{_counted(raw)}; develop each first to 16-bit TIFF or JPEG, without lens "
            "corrections, so that a calibration stays valid, or list only the other photos, e.g. "
            "'FOLDER/*.jpg'"
        )


def _given(files: InputFiles | None) -> GivenByName | None:
    """Return cameras from other programs; those in E57 files belong to the photos in them."""
    if files is None or all(path.suffix.lower() == E57_SUFFIX for path in files.paths):
        return None
    return GivenByName(read_given_cameras(files.paths))


def _calibration(files: InputFiles | None) -> CalibratedLenses | None:
    if files is None:
        return None
    if len(files.paths) != 1:
        raise InputError(
            f"the input {files.name} has {len(files.paths)} files: expected one calibration "
            "file, which may contain several cameras"
        )
    return read_calibration(files.paths[0])


def _require_whole(name: str, encoded: bytes) -> str:
    """Check that a photo is intact; return a remark if it is unusual, otherwise an empty string.

    Raises:
        InputError: the file is not a photo, has an unsupported format, or is incomplete.
    """
    problem = unreadable(encoded)
    if problem:
        raise InputError(f"photo {name} {problem}")
    found, is_lost = damage(encoded)
    if is_lost:
        raise InputError(
            f"photo {name} is damaged or truncated: a part of its {len(encoded)} bytes cannot be "
            f"decoded ({found}); copy it again from the camera, or remove it"
        )
    return found


def _read_photo(
    source: _Source, calibration: CalibratedLenses | None, sheet: ContactSheet
) -> _ReadPhoto:
    name, encoded = source.name, source.encoded()
    odd = _require_whole(name, encoded)
    is_deep = (stated_bits(encoded) or 0) > _PLAIN_BITS
    pixels = (decode_levels if is_deep else decode_image)(encoded, f"photo {name}")
    height, width = pixels.shape[:2]
    exif = read_exif(encoded)
    focal = focal_length(exif, width, height)
    intrinsics = source.lens
    if calibration is not None and not source.whole:
        calibrated = lens_for(calibration, name, width, height)
        if isinstance(calibrated, FisheyeLens):
            raise InputError(
                f"photo {name} is in an E57 file, but its calibration is for a fisheye lens: "
                "provide the photo as a separate file"
            )
        intrinsics = calibrated or intrinsics
    if intrinsics is not None and (intrinsics.width, intrinsics.height) != (width, height):
        raise InputError(
            f"photo {name} has {width} x {height} pixels, but its file declares "
            f"{intrinsics.width} x {intrinsics.height}: export it again"
        )
    photo = Photo(
        name=name,
        encoded=encoded,
        width=width,
        height=height,
        exif_orientation=exif.orientation,
        exif_focal_px=focal.value_px,
        intrinsics=intrinsics,
        camera=_camera(exif),
        folder=source.folder,
    )
    sheet.add(name, eight_bits(pixels))
    n_pages = count_pages(encoded)
    row = shifted_row(encoded, eight_bits(pixels))
    remarks = (
        ""
        if row is None
        else f"seems damaged from row {row} on, where colours change abruptly at JPEG block "
        "boundaries: check it, copy it again from the camera, or remove it",
        f"contains bytes that the decoder skips ({odd}), so it may be damaged" if odd else "",
        f"has {n_pages} pages, of which the largest is read" if n_pages > 1 else "",
        "has damaged EXIF data, of which the readable part was used" if exif.is_damaged else "",
        f"{focal.doubt}: it is ignored" if focal.doubt else "",
    )
    return _ReadPhoto(
        photo=photo,
        focal=focal,
        whole=source.whole,
        remarks=tuple(filter(None, remarks)),
    )


def _camera(exif: Exif) -> str:
    """Return the names of camera and focal length, which identify a lens; empty if unknown."""
    if not exif.camera:
        return ""
    return exif.camera if exif.focal_mm is None else f"{exif.camera}, {exif.focal_mm:g} mm"


def _warn(
    ctx: StepContext, read: Sequence[_ReadPhoto], calibration: CalibratedLenses | None
) -> None:
    for remark in dict.fromkeys(remark for item in read for remark in item.remarks):
        names = [item.photo.name for item in read if remark in item.remarks]
        ctx.report(REMARK, subject=remark, n=len(names), photos=_counted(names), remark=remark)
    if calibration is not None:
        _warn_of_matches(ctx, read, calibration)
    unknown = [
        item.photo.name
        for item in read
        if item.photo.intrinsics is None and item.photo.exif_focal_px is None
    ]
    if unknown:
        reasons = Counter(item.focal.reason for item in read if item.photo.name in unknown)
        reason = reasons.most_common(1)[0][0]
        ctx.report(FOCAL_UNKNOWN, n=len(unknown), photos=_counted(unknown), reason=reason)


def _warn_of_matches(
    ctx: StepContext, read: Sequence[_ReadPhoto], calibration: CalibratedLenses
) -> None:
    without = [item.photo.name for item in read if item.photo.intrinsics is None]
    if without:
        ctx.report(NOT_CALIBRATED, n=len(without), photos=_counted(without))
    used = {matching_pattern(calibration.patterns, item.whole or item.photo.name) for item in read}
    unused = [pattern for pattern in calibration.patterns if pattern not in used]
    if unused:
        ctx.report(UNUSED_ENTRIES, n=len(unused), names=first_few(unused))


def _counted(names: Sequence[str]) -> str:
    return f"photo {names[0]}" if len(names) == 1 else f"{len(names)} photos ({first_few(names)})"
