"""`read.photos`: unchanged files, cameras, masks, and detection of damage."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from orthoflow_plugins.read.cameras import ReadCameras
from orthoflow_plugins.read.photos import ReadPhotos
from PIL import Image
from rasterio.transform import Affine

from orthoflow.errors import InputError
from orthoflow.files.images import decode_levels, encode_jpeg, encode_png, encode_webp, used_pixels
from orthoflow.files.polygons import MOST_BYTES
from orthoflow.products import InputFiles, Photo
from tests import photo_files as made
from tests.method_runs import Reader

CAMERA = "{width: 64, height: 48, fx: 60, fy: 61, cx: 31.5, cy: 23.5}"


class PhotoReader(Reader):
    """Function that returns the photos in files."""

    def __call__(
        self,
        *paths: Path,
        calibration: str | None = None,
        masks: dict[str, bytes] | None = None,
        **params: object,
    ) -> tuple[Photo, ...]:
        calibrations = None if calibration is None else {"calibration.yaml": calibration.encode()}
        given = {
            name: InputFiles(name=name, paths=made.write(self.folder / name, contents))
            for name, contents in (("calibration", calibrations), ("masks", masks))
            if contents is not None
        }
        photos: tuple[Photo, ...] = self.run(paths, params, **given).photos.photos
        return photos

    def files(self, contents: dict[str, bytes], **more: Any) -> tuple[Photo, ...]:
        return self(*made.write(self.folder, contents), **more)


@pytest.fixture
def read(tmp_path: Path) -> PhotoReader:
    return PhotoReader(ReadPhotos, tmp_path)


def test_photos_come_by_name_with_their_bytes_untouched(read: PhotoReader) -> None:
    block = made.exif_block({made.ORIENTATION: 6}, {made.FOCAL_35MM: 28})
    files = {
        "b.JPG": made.jpeg(made.picture(48, 64), block),
        "c.png": encode_png(made.picture(32, 16)),
        "a.tiff": made.tiff(made.picture(30, 20), 8),
        "B.jpeg": encode_jpeg(made.picture()),
    }
    photos = read.files(files)
    assert [photo.name for photo in photos] == ["B.jpeg", "a.tiff", "b.JPG", "c.png"]
    assert all(photo.encoded == files[photo.name] for photo in photos)
    assert [(photo.width, photo.height) for photo in photos] == [
        (64, 48), (30, 20), (48, 64), (32, 16),
    ]  # fmt: skip
    assert [photo.exif_orientation for photo in photos] == [1, 8, 6, 1]
    assert photos[2].exif_focal_px == pytest.approx(28 / np.hypot(36, 24) * 80, rel=1e-12)
    assert read.metrics == {
        "n_photos": 4,
        "n_calibrated": 0,
        "n_exif_focal": 1,
        "megapixels": (64 * 48 + 30 * 20 + 48 * 64 + 32 * 16) / 1e6,
    }


FISHEYE = (
    "{model: fisheye, width: 64, height: 48, fx: 20, fy: 20, cx: 31.5, cy: 23.5, "
    "distortion: [0, 0, 0, 0]}"
)


def test_panoramas_and_fisheyes_become_the_faces_that_they_show(read: PhotoReader) -> None:
    files = {
        "a.jpg": encode_jpeg(made.picture()),
        "b.jpg": encode_jpeg(made.picture()),
        "360.png": encode_png(made.picture(128, 64)),
    }
    text = f"cameras:\n  b.jpg: {CAMERA}\n  '*': {FISHEYE}\n"
    photos = read.files(files, calibration=text, panoramas=("360.png",))
    # A panorama has its own lens, even if a calibration applies to all photos.
    assert [photo.name for photo in photos] == [
        *(f"360_{face}.png" for face in ("back", "down", "front", "left", "right", "up")),
        *(f"a_{face}.png" for face in ("down", "front", "left", "right", "up")),
        "b.jpg",
    ]
    # The angle of view is 90 degrees, a quarter of the circle, so the focal length is half the
    # side.
    lens = photos[0].intrinsics
    assert lens is not None
    assert (photos[0].width, lens.fx, lens.cx) == (41, 20.5, 20.5)
    by_name = {photo.name: photo for photo in photos}
    front = by_name["a_front.png"]
    assert front.intrinsics is not None
    # A face of 90 degrees has 40 pixels; the photo has 64 x 48 pixels.
    assert (front.width, front.intrinsics.fx, front.intrinsics.cx) == (40, 20.0, 20.0)
    assert front.mask is None
    assert by_name["a_left.png"].mask is not None
    assert by_name["b.jpg"].intrinsics is not None
    assert read.warnings == ""


@pytest.mark.parametrize(
    ("lens", "faces"),
    [
        (b"OPENCV_FISHEYE 64 48 20 20 32 24 0 0 0 0", ("down", "front", "left", "right", "up")),
        (b"EQUIRECTANGULAR 64 48 64 48", ("back", "down", "front", "left", "right", "up")),
    ],
    ids=["fisheye", "panorama"],
)
def test_cameras_calibrate_wide_photos(tmp_path: Path, lens: bytes, faces: tuple[str, ...]) -> None:
    (path,) = made.write(tmp_path, {"a.jpg": encode_jpeg(made.picture())})
    model = made.write(
        tmp_path,
        {"cameras.txt": b"1 " + lens + b"\n", "images.txt": b"1 1 0 0 0 0 0 0 1 a.jpg\n\n"},
    )
    given = InputFiles(name="cameras", paths=model)

    def run(cameras: InputFiles | None) -> tuple[str, ...]:
        read = Reader(ReadPhotos, tmp_path).run((path,), {}, cameras=cameras)
        found = Reader(ReadCameras, tmp_path).run(model, {}, photos=read.photos)
        return tuple(f"{camera.photo}: {camera.status}" for camera in found.cameras.cameras)

    assert run(given) == tuple(f"a_{face}.png: ok" for face in faces)
    # If only the poses are connected, the error names the missing input.
    with pytest.raises(InputError, match="it is a fisheye or panorama photo: also connect the"):
        run(None)


# Other files in the folder


def test_other_files_are_left_out_and_counted(read: PhotoReader) -> None:
    photo = encode_jpeg(made.picture())
    files = {
        "a.jpg": photo,
        "a.jpg.camera": b"1",
        "Thumbs.db": b"\xd0\xcf",
        "a.CR2": b"II*\0",
        "K.txt": b"",
    }
    assert [item.name for item in read.files(files)] == ["a.jpg"]
    assert "and were ignored: a.jpg.camera, Thumbs.db, a.CR2 and 1 more" in read.warnings


@pytest.mark.parametrize(
    ("developed", "suffix"), [({}, ".nef"), ({"a.jpg": encode_jpeg(made.picture())}, ".DNG")]
)
def test_raw_photos_that_nobody_developed_are_refused_with_the_way_out(
    tmp_path: Path, read: PhotoReader, developed: dict[str, bytes], suffix: str
) -> None:
    # A raw photo next to its JPEG is ignored.
    paths = made.write(tmp_path, {**developed, "A.CR2": b"II*\0", f"b{suffix}": b"MM\0*"})
    raw = f"photo b{suffix}" if developed else rf"2 photos \(A.CR2, b{suffix}\)"
    with pytest.raises(
        InputError, match=f"camera raw files, .*: {raw}; develop each first to 16-bit TIFF"
    ):
        read(*paths)


@pytest.mark.parametrize(
    "layout",
    [
        {"interleave": "band"},
        {"interleave": "pixel", "alpha": "yes"},
        {"interleave": "pixel", "tiled": True, "blockxsize": 32, "blockysize": 32},
    ],
    ids=["band", "alpha", "tiles"],
)
def test_sixteen_bits_are_read_in_every_layout(
    tmp_path: Path, read: PhotoReader, layout: dict[str, object]
) -> None:
    bands = np.random.default_rng(1).integers(0, 65536, (4, 40, 60)).astype(np.uint16)
    bands[3] |= 0x8000
    bands = bands[: 3 + ("alpha" in layout)]
    shape = {"count": len(bands), "height": 40, "width": 60, "dtype": "uint16"}
    options = {**shape, "photometric": "RGB", "transform": Affine.scale(0.5), **layout}
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", **options) as file:
        file.write(bands)
    (photo,) = read(tmp_path / "a.tif")
    np.testing.assert_array_equal(decode_levels(photo.encoded), np.moveaxis(bands[:3], 0, 2))


def test_an_input_without_a_photo_is_refused(tmp_path: Path, read: PhotoReader) -> None:
    paths = made.write(tmp_path, {"a.doc": b"x", "b.txt": b"x"})
    with pytest.raises(InputError, match=r"contains no photo, only a\.doc, b\.txt; expected"):
        read(*paths)
    with pytest.raises(InputError, match="the input photos has no files: expected photos"):
        read()


def test_photos_of_one_name_live_together_under_their_paths(read: PhotoReader) -> None:
    pictures = [encode_jpeg(made.picture(seed=seed)) for seed in range(4)]
    names = ("x/one/a.jpg", "x/two/a.jpg", "x/two/b.jpg", "x/c.jpg")
    photos = read.files(dict(zip(names, pictures, strict=True)), calibration=None)
    assert {photo.name: photo.encoded for photo in photos} == {
        "one/a.jpg": pictures[0],
        "two/a.jpg": pictures[1],
        "b.jpg": pictures[2],
        "c.jpg": pictures[3],
    }
    assert [photo.folder for photo in photos] == ["two", "", "one", "two"]


# Transparency and pages


def test_what_is_transparent_is_masked(read: PhotoReader) -> None:
    alpha = np.full((48, 64), 255, dtype=np.uint8)
    alpha[:, :21] = 0
    stream = io.BytesIO()
    Image.fromarray(np.dstack([made.picture(), alpha])).save(stream, "PNG")
    mask = np.full((48, 64), 255, dtype=np.uint8)
    mask[:8] = 0
    files = {"a.png": stream.getvalue()}
    (photo,) = read.files(files)
    np.testing.assert_array_equal(used_pixels(photo), alpha > 0)
    (photo,) = read.files(files | {"a_mask.png": encode_png(mask)})
    np.testing.assert_array_equal(used_pixels(photo), (alpha > 0) & (mask > 0))


# Damage and other formats


def test_all_photos_that_are_cut_off_are_named_at_once(read: PhotoReader) -> None:
    image = made.picture(256, 192)
    writers = {"jpg": encode_jpeg, "png": encode_png, "tif": made.tiff, "webp": encode_webp}
    whole = {f"a.{suffix}": write(image) for suffix, write in writers.items()}
    cut = {name: content[: int(0.95 * len(content))] for name, content in whole.items()}
    half = len(whole["a.jpg"]) // 2
    cut["b.jpg"] = whole["a.jpg"][:half] + bytes(99) + whole["a.jpg"][half + 99 :]
    with pytest.raises(InputError) as caught:
        read.files({"0.jpg": encode_jpeg(image), **cut})
    lines = str(caught.value).splitlines()
    assert [line.split()[1] for line in lines] == sorted(cut)
    assert all("is damaged or truncated" in line or "cannot be decoded" in line for line in lines)
    assert all("is damaged or truncated" in line for line in lines if ".jpg" in line)


def test_what_is_odd_about_a_photo_is_reported(read: PhotoReader) -> None:
    picture = made.picture(320, 192)
    whole, shifted = encode_jpeg(picture), np.full_like(picture, 90)
    # A flipped bit changes all blocks after its own.
    shifted[96:, 160:] += 60
    shifted[112:, :160] += 60
    exif = made.exif_block({made.MODEL: "NIKON D3X"}, {made.FOCAL: (1, 9)})
    odd = {
        "a.jpg": (whole[:-2] + b"\0" * 40 + whole[-2:], "contains bytes that the decoder skips"),
        "b.jpg": (made.jpeg(picture, exif), "EXIF contains a focal length of 0.111111 mm"),
        "c.jpg": (made.jpeg(picture, exif[:-5]), "has damaged EXIF data, of which"),
        "d.tif": (
            made.tiff(picture[:96], append_images=[Image.fromarray(picture)]),
            "has 2 pages, of",
        ),
        "e.jpg": (encode_jpeg(shifted), "seems damaged from row 96 on"),
    }
    photos = read.files({"0.jpg": whole} | {name: encoded for name, (encoded, _) in odd.items()})
    assert [photo.height for photo in photos] == [192] * 6
    assert all(f"photo {name}: {remark}" in read.warnings for name, (_, remark) in odd.items())


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (b"<html>", "is not a JPEG"),
        (
            b"\0\0\0\x18ftypcrx \0\0\0\1crx isom",
            r"is camera raw \(Canon CR3\).*develop it first to 16-bit TIFF",
        ),
        (b"%PDF-1.7", "is PDF, which is not supported: convert it"),
        (b"\0\0\0\x1cftypheic\0\0\0\0mif1heic", r"is a HEIC file: install orthoflow-tls\[heic\]"),
    ],
)
def test_files_that_are_no_photos_are_named(read: PhotoReader, content: bytes, named: str) -> None:
    with pytest.raises(InputError, match=rf"photo a\.jpg {named}"):
        read.files({"a.jpg": content})


# Calibration


def test_the_calibration_reaches_the_photos_it_names(read: PhotoReader) -> None:
    block = made.exif_block({}, {made.FOCAL_35MM: 28})
    files = {
        "a.jpg": made.jpeg(made.picture(), block),
        "b.jpg": made.jpeg(made.picture(), block),
        "c.jpg": encode_jpeg(made.picture(48, 64)),
    }
    other = CAMERA.replace("fx: 60", "fx: 70")
    text = f"cameras:\n  b.jpg: {other}\n  '[ab].*': {CAMERA}\n  B.jpg: {CAMERA}\n"
    photos = read.files(files, calibration=text)
    assert [None if p.intrinsics is None else p.intrinsics.fx for p in photos] == [60.0, 70.0, None]
    assert photos[0].intrinsics is not None
    assert (photos[0].intrinsics.cx, photos[0].intrinsics.cy) == (32.0, 24.0)
    assert photos[0].exif_focal_px is not None
    assert read.metrics["n_calibrated"] == 2
    assert (
        "the calibration has no entry for photo c.jpg; the others are calibrated" in read.warnings
    )
    assert (
        "calibration entries that match no photo: B.jpg: names are case-sensitive" in read.warnings
    )
    assert "the focal length of photo c.jpg is unknown" in read.warnings


# Other properties


def test_portraits_need_an_entry_of_their_own(shared_data: Path, read: PhotoReader) -> None:
    folder = shared_data / "cyprus-arch-photos/images"
    paths = [folder / f"DSC_{number}.JPG" for number in (6470, 6471, 6472)]
    photos = read(*paths)
    assert [(photo.width, photo.height) for photo in photos] == [
        (1500, 1000), (1000, 1500), (1500, 1000),
    ]  # fmt: skip
    assert [photo.exif_focal_px for photo in photos] == pytest.approx([1166.67] * 3, abs=0.01)
    landscape = "{width: 1500, height: 1000, fx: 1160, fy: 1160, cx: 750, cy: 500}"
    portrait = "{width: 1000, height: 1500, fx: 1160, fy: 1160, cx: 500, cy: 750}"
    with pytest.raises(InputError, match=r"photo DSC_6471\.JPG has 1000 x 1500 pixels"):
        read(*paths, calibration=f'cameras: {{"*": {landscape}}}')
    calibrated = read(
        *paths, calibration=f'cameras: {{DSC_6471.JPG: {portrait}, "*": {landscape}}}'
    )
    assert [p.intrinsics and p.intrinsics.width for p in calibrated] == [1500, 1000, 1500]


SIZE = (64, 48)
INSIDE = np.s_[10:20, 30:50]


def picture() -> bytes:
    """Return a white picture with a black rectangle."""
    grey = np.full(SIZE[::-1], 255, dtype=np.uint8)
    grey[INSIDE] = 0
    return encode_png(grey)


PHOTO = encode_jpeg(np.full((*SIZE[::-1], 3), 99, dtype=np.uint8))


def masked(photo: Photo) -> NDArray[np.bool_]:
    used = used_pixels(photo)
    assert used is not None
    return ~used


def expected() -> NDArray[np.bool_]:
    cells = np.zeros(SIZE[::-1], dtype=np.bool_)
    cells[INSIDE] = True
    return cells


def polygons(photo: str, *rings: list[tuple[float, float]]) -> bytes:
    geometry = {"type": "Polygon", "coordinates": [[*ring, ring[0]] for ring in rings]}
    feature = {"type": "Feature", "properties": {"photo": photo}, "geometry": geometry}
    return json.dumps({"type": "FeatureCollection", "features": [feature]}).encode()


RING = [(30.0, 10.0), (50.0, 10.0), (50.0, 20.0), (30.0, 20.0)]


def test_a_mask_beside_its_photo_is_no_photo(read: PhotoReader) -> None:
    (photo,) = read.files({"a.jpg": PHOTO, "a_mask.png": picture()})
    assert photo.name == "a.jpg"
    np.testing.assert_array_equal(masked(photo), expected())
    assert "masks that match no photo" not in read.warnings
    # A file named like a mask, but without its photo, is a photo.
    (alone,) = read.files({"white_mask.png": picture()})
    assert alone.name == "white_mask.png"


def test_masks_of_no_photo_and_files_that_are_none_are_named(read: PhotoReader) -> None:
    masks = {
        "c.png": picture(),
        "a.png": picture(),
        "notes.txt": b"drawn on Friday",
        "none.geojson": polygons("x*.jpg", RING),
    }
    (photo,) = read.files({"a.jpg": PHOTO}, masks=masks)
    np.testing.assert_array_equal(masked(photo), expected())
    named = "masks that match no photo: c.png, x*.jpg: a mask must have the name of its photo"
    assert named in read.warnings
    kinds = "only images (PNG, JPEG, TIFF) and polygons (GeoJSON) can be masks: notes.txt"
    assert kinds in read.warnings


def test_polygons_mask_photos_by_name_or_pattern(read: PhotoReader) -> None:
    files = {"a.jpg": PHOTO, "b.jpg": PHOTO}
    first, second = read.files(files, masks={"one.geojson": polygons("a.jpg", RING)})
    np.testing.assert_array_equal(masked(first), expected())
    assert second.mask is None
    every = polygons("*", RING, [(35, 12), (45, 12), (40, 18)])
    first, second = read.files(files, masks={"all.geojson": every})
    holed = masked(first)
    # The hole has 30 pixels, except for those with centres on its border.
    assert not (holed & ~expected()).any()
    assert (expected() & ~holed).sum() == pytest.approx(30, abs=3)
    np.testing.assert_array_equal(masked(second), holed)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.png", encode_png(np.full(SIZE, 255, np.uint8)), "a.png has 48 x 64 pixels, but a.jpg"),
        ("a.png", encode_png(np.zeros(SIZE[::-1], np.uint8)), "of a.jpg excludes the whole"),
        ("a.png", b"no picture", "mask a.png"),
        ("a.txt", b"words", r"the masks contain no pictures .* only a\.txt"),
        ("a.json", b" " * (MOST_BYTES + 1), f"more than {MOST_BYTES} bytes"),
    ],
)
def test_impossible_masks_are_refused(
    read: PhotoReader, name: str, content: bytes, said: str
) -> None:
    with pytest.raises(InputError, match=said):
        read.files({"a.jpg": PHOTO}, masks={name: content})
