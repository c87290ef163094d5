"""`read.cameras`: photo orientations from other programs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import ClassVar, Final

import numpy as np
from pydantic import Field

from orthoflow.errors import InputError
from orthoflow.files.camera_formats import read_given_cameras
from orthoflow.files.cube_faces import WideLens, face_in
from orthoflow.files.given_cameras import CentredLens, GivenCamera, lens_or_reason
from orthoflow.files.points.units import UNITS_M
from orthoflow.files.survey_points import read_measured_ties
from orthoflow.geometry.cameras import from_opencv
from orthoflow.geometry.frames import FARTHEST_M
from orthoflow.products import Camera, Cameras, InputFiles, Photo, Photos, TieRole, Ties
from orthoflow.sdk import DiagnosticSpec, Method, MethodParams, MetricSpec, Ports, StepContext
from orthoflow.untrusted_text import first_few
from orthoflow_plugins.read.scan import Unit

_OF_RUN: Final = "cameras.json"
_EXPORT_OTHERWISE = "align with the model Brown3, or export a COLMAP model"
LIMITED: Final = DiagnosticSpec(
    code="cameras-limited",
    text="{note} (affected photos: {n}, e.g. {subject})",
    rank_by="n",
)
WITHOUT_TIES: Final = DiagnosticSpec(
    code="cameras-without-ties",
    text="{subject} of a run was given without the ties.csv of the same folder, so it is unknown "
    "which walls have ties, and the accuracy of orthoimages is not assessed",
    remedy="give the folder that contains both files",
)
NOT_ORIENTED: Final = DiagnosticSpec(
    code="photo-not-oriented",
    text="photo {subject} is not oriented: {status}",
)


class ReadCameras(Method):
    """Read poses and lenses from `cameras.json`, COLMAP, Metashape, Bundler or RealityCapture.

    Poses must be in the frame of the scan; `orient.given` reports cameras that show no wall. Photos
    are identified by their file names, with or without suffix, and by their folders if several have
    the same name. A photo is not oriented if it is missing or disabled in the files, or if its lens
    differs from OpenCV's models by more than half a pixel; the reason is reported. Smaller
    differences of the lens are also reported.

    For a run of orthoflow, give the folder with `cameras.json` and `ties.csv`. The poses then keep
    their covariances and ties, from which the errors of orthoimages are predicted.

    Photos with a fisheye lens must be split into cube faces by `read.photos`, which needs the lens
    for this. Each face gets the pose of the whole photo.
    """

    id = "read.cameras"
    result_version = 2
    repeatable: ClassVar[tuple[str, ...]] = ("files",)
    determinism = "exact"
    metrics = (
        MetricSpec("n_photos", label="photos"),
        MetricSpec("n_oriented", label="photos oriented", better="higher", headline=True),
        MetricSpec("n_refused", label="photos refused"),
        MetricSpec(
            "sigma_wall_mm_median",
            label="expected error of the orientation on the wall, median photo",
            better="lower",
            counted_by="n_oriented",
        ),
        MetricSpec(
            "sigma_wall_mm_worst",
            label="expected error of the orientation on the wall, worst photo",
            better="lower",
            counted_by="n_oriented",
            headline=True,
            description="relative to the scan, so errors of the scan and its depths are not "
            "included",
        ),
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
        """Parameters that are not in the files."""

        unit: Unit = Field(
            "m", description="Unit of the coordinates in the files; poses are converted to metres."
        )

    class In(Ports):
        """The files, and the photos that they orient."""

        files: InputFiles
        photos: Photos

    class Out(Ports):
        """One orientation per photo."""

        cameras: Cameras

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Read all files."""
        ctx.progress(0.0, inputs.files.name)
        given = read_given_cameras(inputs.files.paths)
        photos = inputs.photos.photos
        by_name = GivenByName(given, photos)
        notes: dict[str, list[str]] = {}
        cameras = tuple(_camera(photo, by_name, UNITS_M[params.unit], notes) for photo in photos)
        n_oriented = sum(camera.status == "ok" for camera in cameras)
        if not n_oriented:
            why = f" ({photos[0].name}: {cameras[0].status})" if photos else ""
            raise InputError(
                f"the input {inputs.files.name} orients none of the photos{why}; it contains "
                f"{first_few([item.name for item in given])}; without this input, photos are "
                "oriented by matching with the scan"
            )
        for note, of_photos in notes.items():
            ctx.report(LIMITED, subject=of_photos[0], note=note, n=len(of_photos))
        for camera in cameras:
            if camera.status != "ok":
                ctx.report(NOT_ORIENTED, subject=camera.photo, status=camera.status)
        ctx.metric("n_photos", len(photos), "1")
        ctx.metric("n_oriented", n_oriented, "1")
        ctx.metric("n_refused", len(photos) - n_oriented, "1")
        sigmas_mm = [1000.0 * one.sigma_wall_m for one in cameras if one.sigma_wall_m is not None]
        if sigmas_mm:
            ctx.metric("sigma_wall_mm_median", float(np.median(sigmas_mm)), "mm")
            ctx.metric("sigma_wall_mm_worst", max(sigmas_mm), "mm")
        ctx.log(f"given poses, which are not checked here: {n_oriented}")
        ties = _ties(inputs.files.paths, [photo.name for photo in photos], params)
        if ties is None and any(camera.covariance is not None for camera in cameras):
            ctx.report(WITHOUT_TIES, subject=_OF_RUN)
        return self.Out(cameras=Cameras(cameras=cameras, ties=ties, details={"given": True}))


def _ties(paths: Sequence[Path], names: Sequence[str], params: ReadCameras.Params) -> Ties | None:
    """Return the ties next to the `cameras.json` of a run, or None if there are none."""
    beside = [path.with_name("ties.csv") for path in paths if path.name == _OF_RUN]
    path = next((path for path in beside if path in paths), None)
    if path is None:
        return None
    place = {name: index for index, name in enumerate(names)}
    found = [tie for tie in read_measured_ties(path) if tie.photo in place]
    count, unknown = len(found), (np.nan, np.nan)
    roles = [TieRole.CHECK if tie.is_check else TieRole.CONTROL for tie in found]
    return Ties(
        photo_names=tuple(names),
        photo=np.array([place[tie.photo] for tie in found], dtype=np.int32),
        wall=np.full(count, -1, dtype=np.int32),
        pixels_photo=from_opencv(np.array([tie.pixel for tie in found]).reshape(-1, 2)),
        points_world=UNITS_M[params.unit]
        * np.array([tie.position for tie in found]).reshape(-1, 3),
        sigma_px=np.array([tie.sigma_px or 0.0 for tie in found], dtype=np.float64),
        # The file does not contain the standard deviations.
        sigma_m=np.zeros(count),
        role=np.array(roles, dtype=np.uint8),
        residual_px=np.array([tie.residual_px or unknown for tie in found]).reshape(-1, 2),
    )


def _camera(photo: Photo, given: GivenByName, unit_m: float, notes: dict[str, list[str]]) -> Camera:
    found = given.of_photo(photo.name, photo.folder)
    if found is None:
        return Camera(photo=photo.name, status="the camera files do not contain it")
    if found.lens is None or found.rotation is None or found.translation is None:
        return Camera(photo=photo.name, status=found.reason)
    lens, note = found.lens, found.note
    if isinstance(lens, CentredLens):
        nearest, worst_px = lens.of_size(photo.width, photo.height)
        taken, note = lens_or_reason("its lens", nearest, worst_px, _EXPORT_OTHERWISE)
        if isinstance(taken, str):
            return Camera(photo=photo.name, status=taken)
        lens = taken
    if isinstance(lens, WideLens):
        return Camera(
            photo=photo.name,
            status="it is a fisheye or panorama photo: also connect the camera files to "
            "read.photos, which splits it into photos that can be used",
        )
    if note:
        notes.setdefault(note, []).append(photo.name)
    if (lens.width, lens.height) != (photo.width, photo.height):
        raise InputError(
            f"photo {photo.name} has {photo.width} x {photo.height} pixels, but its given camera "
            f"has {lens.width} x {lens.height}: use the photos that were oriented, at the same "
            "size and not rotated"
        )
    translation_m = unit_m * np.asarray(found.translation, dtype=np.float64)
    # The comparison is negated in order to reject NaN.
    if not np.abs(translation_m).max() < FARTHEST_M:
        raise InputError(
            f"photo {photo.name} was taken {np.abs(translation_m).max():.3g} m from the origin, "
            f"according to its given camera; expected less than {FARTHEST_M:g} m: check the unit"
        )
    scale = np.repeat([1.0, unit_m], 3)
    covariance = None if found.covariance is None else found.covariance * np.outer(scale, scale)
    return Camera(
        photo=photo.name,
        status="ok",
        intrinsics=lens,
        rotation_camera_from_world=found.rotation,
        translation_camera_from_world=translation_m,
        covariance=covariance,
        sigma_wall_m=found.sigma_wall_m,
    )


class GivenByName:
    """Given cameras, by photo name."""

    def __init__(self, given: Sequence[GivenCamera], photos: Sequence[Photo] = ()) -> None:
        """Index the cameras by photo name.

        Args:
            given: the cameras.
            photos: all photos; photos with the same file name need separate cameras.
        """
        self._by_name: dict[str, list[GivenCamera]] = {}
        for camera in given:
            self._by_name.setdefault(_file_name(camera.name).lower(), []).append(camera)
        self._n_named = Counter(_file_name(photo.name).lower() for photo in photos)

    def of_photo(self, name: str, folder: str = "") -> GivenCamera | None:
        """Return the camera of a photo by its name, with or without suffix, or None.

        A photo NAME_front.png may be a cube face of NAME, which is a fisheye photo or a panorama.
        If several cameras have the same photo name, the one whose folders match best is returned.
        If this is ambiguous, the result contains a reason instead of a pose.
        """
        found, face = self._named(_file_name(name)), face_in(_file_name(name))
        if not found and face is not None:
            whole = [
                camera for camera in self._of_stem(face[0]) if isinstance(camera.lens, WideLens)
            ]
            nearest = _nearest(whole, folder, is_only=True)
            return nearest.of_face(face[1]) if nearest is not None else None
        is_only = self._n_named[_file_name(name).lower()] <= 1
        return _nearest(found, folder, is_only=is_only)

    def _named(self, name: str) -> list[GivenCamera]:
        """Return the cameras with this file name or stem, in the same letter case if possible."""
        for wanted in (name, PurePath(name).stem):
            found = self._by_name.get(wanted.lower(), [])
            if found:
                return [one for one in found if _file_name(one.name) == wanted] or found
        return []

    def _of_stem(self, stem: str) -> list[GivenCamera]:
        """Return the cameras of photos with this stem and any suffix."""
        found = [
            camera
            for name, cameras in self._by_name.items()
            if PurePath(name).stem == stem.lower()
            for camera in cameras
        ]
        return [one for one in found if PurePath(_file_name(one.name)).stem == stem] or found


def _file_name(path: str) -> str:
    return path.rpartition("/")[2]


def _nearest(found: Sequence[GivenCamera], folder: str, *, is_only: bool) -> GivenCamera | None:
    """Return the camera whose folders match those of a photo best, or why there is none.

    Args:
        found: cameras with the file name of the photo.
        folder: folder of the photo.
        is_only: whether no other photo has this file name.
    """
    if not found:
        return None
    posed = [camera for camera in found if camera.rotation is not None] or list(found)
    own = {part.lower() for part in folder.split("/") if part}
    scores = [len(own & {part.lower() for part in camera.name.split("/")[:-1]}) for camera in posed]
    best = [camera for camera, score in zip(posed, scores, strict=True) if score == max(scores)]
    if len(best) == 1 and (is_only or max(scores) > 0 or not own):
        return best[0]
    names = first_few([camera.name for camera in best])
    if len(best) > 1:
        what = f"{len(best)} cameras with its name ({names})"
        unknown = "which of them belongs"
    else:
        what, unknown = f"only {names} for this file name", "whether it belongs"
    return GivenCamera(
        name=found[0].name,
        reason=f"the camera files contain {what}, and the folder names do not show {unknown} to "
        "this photo: use the same folder names for photos and cameras",
    )
