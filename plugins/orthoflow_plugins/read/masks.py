"""Masks of photos from files: images next to the photos, or polygons."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.images import PHOTO_SUFFIXES, decode_mask, encode_png
from orthoflow.files.polygons import NamedPolygon, filled, read_polygons
from orthoflow.sdk import DiagnosticSpec, StepContext
from orthoflow.untrusted_text import first_few

_ENDING: Final = "_mask"
_POLYGONS: Final = (".geojson", ".json")
UNUSED: Final = DiagnosticSpec(
    code="masks-of-no-photo",
    text="masks that match no photo: {names}",
    remedy="a mask must have the name of its photo",
    rank_by="n",
)
NO_MASKS: Final = DiagnosticSpec(
    code="files-are-no-masks",
    text="files ignored, because only images (PNG, JPEG, TIFF) and polygons (GeoJSON) can be "
    "masks: {names}",
    rank_by="n",
)


class Masks:
    """Mask images, mask polygons, the photos whose masks have been used, and other files."""

    def __init__(
        self,
        pictures: Mapping[str, Path],
        polygons: Sequence[NamedPolygon],
        others: Sequence[str] = (),
    ) -> None:
        self._pictures = pictures
        self._polygons = polygons
        self._others = others
        self._taken: set[str] = set()

    @classmethod
    def of(cls, beside: Iterable[Path], given: Iterable[Path]) -> Masks:
        """Sort mask files by type.

        Args:
            beside: images found next to the photos.
            given: files of the input `masks`.

        Raises:
            InputError: none of the given files is a mask, a polygon file is invalid, or a photo has
                two masks.
        """
        pictures: dict[str, Path] = {}
        polygons: list[NamedPolygon] = []
        others: list[str] = []
        given = tuple(given)
        for path in [*beside, *given]:
            if path.suffix.lower() in _POLYGONS:
                polygons += read_polygons(path, "photo", what="a mask of photos")
            elif path.suffix.lower() not in PHOTO_SUFFIXES:
                others.append(path.name)
            elif pictures.setdefault(_key(path.stem), path) != path:
                raise InputError(
                    f"{path.name} and {pictures[_key(path.stem)].name} are masks of the same "
                    "photo: remove one of them"
                )
        if others and len(others) == len(given):
            raise InputError(
                f"the masks contain no pictures (PNG, JPEG, TIFF) or polygons (GeoJSON), only "
                f"{first_few(sorted(set(others)))}"
            )
        return cls(pictures, polygons, others)

    def encoded(self, photo: str, size: tuple[int, int]) -> bytes | None:
        """Return the mask of a photo as PNG, with usable pixels in white; None if all are usable.

        Raises:
            InputError: the mask is not an image, has a different size, or excludes the whole photo.
        """
        used: NDArray[np.bool_] | None = None
        for key in dict.fromkeys((photo, Path(photo).name, Path(photo).stem)):
            path = self._pictures.get(key)
            if path is not None:
                used = self._picture(path, photo, size)
                break
        for polygon in self._polygons:
            if fnmatchcase(photo, polygon.name):
                self._taken.add(polygon.name)
                used = np.ones(size[::-1], dtype=np.bool_) if used is None else used
                used = used & ~filled(polygon.rings, (size[1], size[0]))
        if used is None or used.all():
            return None
        if not used.any():
            raise InputError(f"the mask of {photo} excludes the whole photo: remove the photo")
        return encode_png(np.where(used, np.uint8(255), np.uint8(0)))

    def warn_of_unused(self, ctx: StepContext) -> None:
        """Warn of masks without a photo, and of files that are not masks."""
        unused = [path.name for path in self._pictures.values() if path.name not in self._taken] + [
            polygon.name for polygon in self._polygons if polygon.name not in self._taken
        ]
        if unused:
            ctx.report(UNUSED, n=len(unused), names=first_few(sorted(set(unused))))
        if self._others:
            ctx.report(NO_MASKS, n=len(self._others), names=first_few(sorted(set(self._others))))

    def _picture(self, path: Path, photo: str, size: tuple[int, int]) -> NDArray[np.bool_]:
        self._taken.add(path.name)
        try:
            encoded = path.read_bytes()
        except OSError as error:
            raise InputError(f"cannot read mask {path.name}: {error.strerror}") from error
        used = decode_mask(encoded, f"mask {path.name}")
        if used.shape != size[::-1]:
            raise InputError(
                f"mask {path.name} has {used.shape[1]} x {used.shape[0]} pixels, but {photo} "
                f"has {size[0]} x {size[1]}: a mask must have the size of its photo, not rotated"
            )
        return used


def beside_photos(paths: Sequence[Path]) -> frozenset[Path]:
    """Return the files that are masks of other photos, such as NAME_mask.png for NAME.jpg."""
    stems = {path.stem for path in paths}
    return frozenset(
        path
        for path in paths
        if path.stem.endswith(_ENDING)
        and path.suffix.lower() in PHOTO_SUFFIXES
        and _key(path.stem) in stems | {other.name for other in paths}
    )


def _key(stem: str) -> str:
    """Return the name or stem of the photo that a mask with this stem belongs to."""
    return stem.removesuffix(_ENDING)
