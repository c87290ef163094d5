"""`read.ties`: points measured by hand in photos."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from pydantic import Field

from orthoflow.errors import InputError
from orthoflow.files.points.units import UNITS_M
from orthoflow.files.survey_points import MeasuredTie, read_measured_ties
from orthoflow.geometry.cameras import from_opencv
from orthoflow.products import InputFiles, Photo, Photos, TieRole, Ties
from orthoflow.sdk import Method, MethodParams, MetricSpec, Ports, StepContext
from orthoflow_plugins.read.scan import Unit

_MOST_PROBLEMS = 20


class ReadTies(Method):
    """Read ties measured by hand (`photo,u_px,v_px,x,y,z[,sigma_px]`), or `ties.csv` of a run.

    World coordinates are those of the scan. Pixel coordinates are as in `ties.csv` and
    `cameras.json` (OpenCV): the centre of the first pixel of a photo is at (0, 0), and the EXIF
    orientation is not applied.
    """

    id = "read.ties"
    determinism = "exact"
    metrics = (
        MetricSpec("n_ties", label="ties"),
        MetricSpec("n_photos_tied", label="photos with ties"),
    )
    citations: ClassVar[tuple[str, ...]] = ()

    class Params(MethodParams):
        """Parameters that are not in the files."""

        unit: Unit = Field(
            "m", description="Unit of x, y, z in the files; ties are converted to metres."
        )
        sigma_px: float = Field(
            1.0,
            gt=0,
            description="Standard deviation of each pixel coordinate if the files contain none.",
        )
        sigma_m: float = Field(
            0.002,
            ge=0,
            description="Standard deviation of each world coordinate in metres, which results from "
            "the survey or from picking the point in the scan.",
        )

    class In(Ports):
        """The files, and the photos in which the ties were measured."""

        files: InputFiles
        photos: Photos

    class Out(Ports):
        """The ties of all files."""

        ties: Ties

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Read all files."""
        if not inputs.files.paths:
            raise InputError(f"the input {inputs.files.name} has no files: expected ties")
        ctx.progress(0.0, inputs.files.name)
        found = [tie for path in inputs.files.paths for tie in read_measured_ties(path)]
        photos = {photo.name: photo for photo in inputs.photos.photos}
        wrong = [tie for tie in found if not _is_in_photo(tie, photos)]
        if wrong:
            left_out = len(wrong) - _MOST_PROBLEMS
            more = [f"... and {left_out} more"] if left_out > 0 else []
            # Finding similar names is slow, so this is only done for the ties in the message.
            shown = [_problem(tie, photos) for tie in wrong[:_MOST_PROBLEMS]]
            raise InputError("\n".join(shown + more))
        ties = _ties(found, tuple(photos), params)
        per_photo = np.bincount(ties.photo, minlength=len(photos))
        ctx.metric("n_ties", len(found), "1")
        ctx.metric("n_photos_tied", int((per_photo > 0).sum()), "1")
        for name, count in zip(photos, per_photo.tolist(), strict=True):
            if count:
                ctx.log(f"{name}: {count} ties measured by hand")
        return self.Out(ties=ties)


def _is_in_photo(tie: MeasuredTie, photos: Mapping[str, Photo]) -> bool:
    photo = photos.get(tie.photo)
    if photo is None:
        return False
    u, v = tie.pixel
    return -0.5 <= u <= photo.width - 0.5 and -0.5 <= v <= photo.height - 0.5


def _problem(tie: MeasuredTie, photos: Mapping[str, Photo]) -> str:
    """Return why a tie is not in any photo."""
    photo = photos.get(tie.photo)
    if photo is None:
        near = difflib.get_close_matches(tie.photo, photos, n=1)
        hint = f" (did you mean {near[0]}?)" if near else ""
        return f"{tie.where}: there is no photo {tie.photo} among those given{hint}"
    u, v = tie.pixel
    return (
        f"{tie.where}: (u {u:g}, v {v:g}) is outside photo {tie.photo}, which is "
        f"{photo.width} x {photo.height} pixels as it is stored"
    )


def _ties(found: Sequence[MeasuredTie], names: tuple[str, ...], params: ReadTies.Params) -> Ties:
    place = {name: index for index, name in enumerate(names)}
    count, unit_m = len(found), UNITS_M[params.unit]
    return Ties(
        photo_names=names,
        photo=np.array([place[tie.photo] for tie in found], dtype=np.int32),
        wall=np.full(count, -1, dtype=np.int32),
        pixels_photo=from_opencv(np.array([tie.pixel for tie in found], dtype=np.float64)),
        points_world=unit_m * np.array([tie.position for tie in found], dtype=np.float64),
        sigma_px=np.array([tie.sigma_px or params.sigma_px for tie in found], dtype=np.float64),
        sigma_m=np.full(count, params.sigma_m),
        role=np.full(count, TieRole.CONTROL, dtype=np.uint8),
        residual_px=np.full((count, 2), np.nan),
        by_hand=np.ones(count, dtype=np.uint8),
    )
