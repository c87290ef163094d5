"""`colour.photos`: colour a cloud from photos."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.files.clouds.photo_colours import (
    UNSEEN_GREY,
    PointColours,
    colour_points,
)
from orthoflow.products import Cameras, Photos, PointCloud
from orthoflow.sdk import Method, MethodParams, MetricSpec, Ports, StepContext


class ColourPhotos(Method):
    """Assign each point the colour of the photo that shows it best.

    A point is visible unless a nearer point of the cloud hides it; outliers are ignored (as in the
    depth buffer of `ortho.dsm-backward`). If several photos show a point, the photo with the most
    pixels per metre is used, with a lower weight near the border of a photo. The colour is
    interpolated between four pixels. With this method, direct orthoimages
    (`ortho.pointcloud-direct`) can be computed from the same photos as those of other methods, even
    if the cloud has no colours.
    """

    id: ClassVar[str] = "colour.photos"
    result_version: ClassVar[int] = 2
    determinism = "loose"
    metrics = (
        MetricSpec("coloured_share", label="share of points with a colour"),
        MetricSpec("n_photos", label="photos"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        (
            "Skarlatos, Kiparissi, Theodoridou 2012, Direct orthophoto generation from color "
            "point clouds of complex scenes"
        ),
    )

    class Params(MethodParams):
        """Colour of the points that no photo shows."""

        unseen: Literal["drop", "grey"] = Field(
            "drop",
            description="Treatment of points that no photo shows. drop: remove them; grey: "
            "colour them medium grey.",
        )

    class In(Ports):
        """The cloud, the photos and their orientations."""

        cloud: PointCloud
        photos: Photos
        cameras: Cameras

    class Out(Ports):
        """The cloud with colours."""

        cloud: PointCloud

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Process the photos one by one, keeping the best colour of each point."""
        inputs.cloud.require_points(2)
        oriented = {camera.photo: camera for camera in inputs.cameras.cameras}
        chosen = [
            (photo, oriented[photo.name].viewing())
            for photo in inputs.photos.photos
            if photo.name in oriented and oriented[photo.name].status == "ok"
        ]
        if not chosen:
            raise MethodError(
                "none of the photos is oriented: connect cameras of these photos (colour.photos)"
            )
        cloud = inputs.cloud
        colours = PointColours(
            rgb=np.full((len(cloud), 3), UNSEEN_GREY, dtype=np.uint8),
            best=np.zeros(len(cloud), dtype=np.float32),
        )
        colour_points(
            cloud,
            chosen,
            colours,
            threads=ctx.cores,
            progress=ctx.progress,
        )
        seen = colours.best > 0.0
        n_seen = int(np.count_nonzero(seen))
        ctx.metric("n_photos", len(chosen), "1")
        ctx.metric("coloured_share", n_seen / max(1, len(cloud)), "1")
        if n_seen == 0:
            raise MethodError(
                "no photo shows a point of the cloud: the cloud and the cameras must use the "
                "same coordinate system (colour.photos)"
            )
        coloured = replace(cloud, rgb=colours.rgb, has_rgb=None)
        return self.Out(cloud=coloured.selected(seen) if params.unseen == "drop" else coloured)
