"""`read.cameras`: orientations of the photos that another program found."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePath
from typing import ClassVar

import numpy as np
from pydantic import Field

from orthoflow.errors import InputError
from orthoflow.files.camera_formats import read_given_cameras
from orthoflow.files.fisheyes import FisheyeLens
from orthoflow.files.given_cameras import CentredLens, GivenCamera
from orthoflow.files.panoramas import face_in
from orthoflow.geometry.frames import FARTHEST_M
from orthoflow.products import Camera, Cameras, InputFiles, Photo, Photos
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from orthoflow_plugins.read.scan import UNITS_M, Unit

_NAMED = 3


class ReadCameras(Method):
    """Read poses and lenses: `cameras.json`, COLMAP, Metashape, Bundler, RealityCapture.

    They must be in the frame of the scan; `orient.given` says when they show no wall. Photos are
    found by their file names, with or without suffix. A photo that the files say nothing of, or
    whose lens OpenCV's models have not, is not oriented, and the reason is said.

    The photo of a fisheye lens must have become the faces of a cube, as `read.photos` does it that
    knows the lens; each face has the pose of the whole.
    """

    id = "read.cameras"
    result_version = 3
    determinism = "exact"
    metrics = (
        "n_photos",
        "n_oriented",
        "n_refused",
        "sigma_wall_mm_median",
        "sigma_wall_mm_worst",
    )
    citations: ClassVar[tuple[str, ...]] = (
        (
            "Schoenberger, Frahm 2016, Structure-from-motion revisited (COLMAP), "
            "doi:10.1109/CVPR.2016.445"
        ),
        "Snavely, Seitz, Szeliski 2006, Photo tourism (Bundler), doi:10.1145/1141911.1141964",
        "Agisoft Metashape Professional user manual, camera models",
    )

    class Params(MethodParams):
        """What the files do not say themselves."""

        unit: Unit = Field(
            "m", description="Unit of the files' coordinates; the poses are in metres."
        )

    class In(Ports):
        """The files, and the photos that they speak of."""

        files: InputFiles
        photos: Photos

    class Out(Ports):
        """One orientation per photo."""

        cameras: Cameras

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Read the files; see the class."""
        ctx.progress(0.0, inputs.files.name)
        given = read_given_cameras(inputs.files.paths)
        photos = inputs.photos.photos
        by_name = GivenByName(given)
        cameras = tuple(_camera(photo, by_name, UNITS_M[params.unit]) for photo in photos)
        n_oriented = sum(camera.status == "ok" for camera in cameras)
        if not n_oriented:
            names = ", ".join(item.name for item in given[:_NAMED])
            raise InputError(
                f"the input {inputs.files.name} orients none of the {len(photos)} photos, such as "
                f"{photos[0].name if photos else 'none'}: it speaks of {names}"
                f"{' ...' if len(given) > _NAMED else ''}; {cameras[0].status if cameras else ''}"
                "; without these files, photos are oriented by matching with the scan"
            )
        for camera in cameras:
            if camera.status != "ok":
                ctx.warn(f"photo {camera.photo} is not oriented: {camera.status}")
        ctx.metric("n_photos", len(photos), "1")
        ctx.metric("n_oriented", n_oriented, "1")
        ctx.metric("n_refused", len(photos) - n_oriented, "1")
        sigmas_mm = [1000.0 * one.sigma_wall_m for one in cameras if one.sigma_wall_m is not None]
        if sigmas_mm:
            ctx.metric("sigma_wall_mm_median", float(np.median(sigmas_mm)), "mm")
            ctx.metric("sigma_wall_mm_worst", max(sigmas_mm), "mm")
        ctx.log(f"{n_oriented} poses are taken as given; nothing here has checked them")
        return self.Out(cameras=Cameras(cameras=cameras, details={"given": True}))


def _camera(photo: Photo, given: GivenByName, unit_m: float) -> Camera:
    found = given.of_photo(photo.name)
    if found is None:
        return Camera(photo=photo.name, status="the files of given cameras say nothing of it")
    if found.lens is None or found.rotation is None or found.translation is None:
        return Camera(photo=photo.name, status=found.reason)
    lens = found.lens
    if isinstance(lens, FisheyeLens):
        return Camera(
            photo=photo.name,
            status="its lens is a fisheye: wire the same files to read.photos as cameras, which "
            "makes photos of it that can be painted from",
        )
    if isinstance(lens, CentredLens):
        lens = lens.of_size(photo.width, photo.height)
    if (lens.width, lens.height) != (photo.width, photo.height):
        raise InputError(
            f"photo {photo.name} has {photo.width} x {photo.height} pixels, but its given camera "
            f"{lens.width} x {lens.height}: give the photos that were oriented, at the same size "
            "and not turned"
        )
    translation_m = unit_m * np.asarray(found.translation, dtype=np.float64)
    # Also not where it is no number.
    if not np.abs(translation_m).max() < FARTHEST_M:
        raise InputError(
            f"photo {photo.name} was taken {np.abs(translation_m).max():.3g} m from the origin, "
            f"as its given camera says; expected less than {FARTHEST_M:g} m: check the unit"
        )
    return Camera(
        photo=photo.name,
        status="ok",
        intrinsics=lens,
        rotation_camera_from_world=found.rotation,
        translation_camera_from_world=translation_m,
        sigma_wall_m=found.sigma_wall_m,
    )


class GivenByName:
    """Given cameras by the names of their photos."""

    def __init__(self, given: Sequence[GivenCamera]) -> None:
        self._exact: dict[str, list[GivenCamera]] = {}
        self._lower: dict[str, list[GivenCamera]] = {}
        self._fisheyes: dict[str, list[GivenCamera]] = {}
        for camera in given:
            self._exact.setdefault(camera.name, []).append(camera)
            self._lower.setdefault(camera.name.lower(), []).append(camera)
            if isinstance(camera.lens, FisheyeLens):
                stem = PurePath(camera.name).stem.lower()
                self._fisheyes.setdefault(stem, []).append(camera)

    def of_photo(self, name: str) -> GivenCamera | None:
        """Give the camera of a photo: of its name, or else of its name without suffix.

        A photo NAME_front.png may be a face of NAME, whose lens is a fisheye.

        Raises:
            InputError: several cameras have that name.
        """
        found, face = self._named(name), face_in(name)
        if found is None and face is not None:
            whole = self._of_stem(face[0])
            return whole.of_face(face[1]) if whole is not None else None
        return found

    def _of_stem(self, stem: str) -> GivenCamera | None:
        """The fisheye camera of a photo that has this name but for its suffix."""
        fisheyes = self._fisheyes.get(stem.lower(), [])
        exact = [camera for camera in fisheyes if PurePath(camera.name).stem == stem]
        return _only(exact or fisheyes, stem)

    def _named(self, name: str) -> GivenCamera | None:
        for wanted in (name, PurePath(name).stem):
            found = self._exact.get(wanted) or self._lower.get(wanted.lower(), [])
            if found:
                return _only(found, name)
        return None


def _only(found: Sequence[GivenCamera], photo: str) -> GivenCamera | None:
    if len(found) > 1:
        raise InputError(
            f"the files of given cameras have {len(found)} cameras {found[0].name}: photo {photo} "
            "must have one"
        )
    return found[0] if found else None
