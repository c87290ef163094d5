"""`crack.dark-lines`: long lines that are darker than the surface on both sides."""

from __future__ import annotations

import numpy as np
from orthoflow.geometry import eight_bits
from orthoflow.products import Orthoimages, OrthoMask
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from pydantic import Field

from orthoflow_cracks.cracks import Cracks


class DarkLines(Method):
    """Join cells that are darker than their surroundings (black top-hat) into long lines."""

    id = "crack.dark-lines"
    result_version = 1
    determinism = "exact"
    citations = ("Serra 1982: Image Analysis and Mathematical Morphology (top-hat)",)

    class Params(MethodParams):
        """Criteria for cracks."""

        darker_grey: float = Field(
            25.0, gt=0, le=255, description="A crack is so much darker than its surroundings."
        )
        width_max_m: float = Field(0.02, gt=0, description="Wider dark strips are no cracks.")
        length_min_m: float = Field(0.2, gt=0, description="Shorter lines are no cracks.")
        vertex_step_m: float = Field(0.05, gt=0, description="Distance of a line's vertices.")

    class In(Ports):
        """The orthoimages."""

        orthoimages: Orthoimages

    class Out(Ports):
        """The cracks."""

        cracks: Cracks

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Search every orthoimage for cracks."""
        lines, walls, widths_m = [], [], []
        images = inputs.orthoimages.images
        for index, image in enumerate(images):
            ctx.progress(index / len(images), image.name)
            found = list(lines_of(image, params))
            lines += [vertices for vertices, _ in found]
            widths_m += [width_m for _, width_m in found]
            walls += len(found) * [image.wall]
            ctx.figure(
                f"cracks-{image.wall}",
                drawn(image, [vertices for vertices, _ in found]),
                f"The {len(found)} cracks of {image.name}; metres across and down.",
            )
        cracks = Cracks(
            vertices_world=np.concatenate([np.zeros((0, 3)), *lines]),
            line=np.repeat(np.arange(len(lines)), [len(line) for line in lines]).astype(np.int32),
            wall=np.array(walls, dtype=np.int32),
            width_m=np.array(widths_m, dtype=np.float64),
        )
        ctx.metric("n_cracks", len(cracks), "1")
        ctx.metric("length_m", cracks.length_m(), "m")
        return self.Out(cracks=cracks)


def lines_of(image, params):
    """Yield the vertices (m, 3) and the width of every crack in an orthoimage, in metres."""
    import cv2

    frame = image.frame
    shown = np.isin(image.mask, (OrthoMask.PAINTED, OrthoMask.FILLED))
    grey = eight_bits(image.rgb).mean(axis=2)
    # Cells without a colour must not look dark.
    grey = np.where(shown, grey, grey[shown].mean() if shown.any() else 0.0).astype(np.float32)
    width = 2 * max(1, round(params.width_max_m / frame.gsd_m / 2)) + 1
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    dark = cv2.morphologyEx(grey, cv2.MORPH_BLACKHAT, around) > params.darker_grey
    count, parts = cv2.connectedComponents((dark & shown).astype(np.uint8), connectivity=8)
    for part in range(1, count):
        rows, columns = np.nonzero(parts == part)
        cells = np.column_stack([columns, rows]) + 0.5
        along = _along(cells)
        length_m = float(np.ptp(along)) * frame.gsd_m
        if length_m < params.length_min_m:
            continue
        n_vertices = max(2, round(length_m / params.vertex_step_m) + 1)
        bins = np.rint((along - along.min()) / np.ptp(along) * (n_vertices - 1)).astype(int)
        kept = np.unique(bins)
        middle = np.array([cells[bins == number].mean(axis=0) for number in kept])
        yield frame.world_from_wall(middle), len(cells) * frame.gsd_m**2 / length_m


def drawn(image, lines):
    """Return a drawing of an orthoimage with lines, each given by its vertices (m, 3)."""
    from matplotlib.figure import Figure

    frame = image.frame
    sides_m = frame.width * frame.gsd_m, frame.height * frame.gsd_m
    drawing = Figure(figsize=(6.0, 6.0 * sides_m[1] / sides_m[0] + 0.4), layout="constrained")
    axes = drawing.add_subplot()
    axes.imshow(eight_bits(image.rgb), extent=(0.0, sides_m[0], sides_m[1], 0.0))
    for vertices in lines:
        across_m, down_m = frame.wall_from_world(vertices)[:, :2].T * frame.gsd_m
        axes.plot(across_m, down_m, color="crimson", linewidth=1.0)
    return drawing


def _along(cells):
    """Return the position of each cell along the longest axis of all cells."""
    centred = cells - cells.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    axis = axes[:, 1]
    return centred @ (axis if axis[np.abs(axis).argmax()] > 0 else -axis)
