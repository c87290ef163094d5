"""Draws the thickness of the cloud: per plane, over incidence, range, intensity, along a row."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from orthoflow.products import Planes
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.figure_margins import Margins, space_out
from orthoflow_plugins.plane.scan_rows import ScanRow
from orthoflow_plugins.plane.thickness import Materials, Thickness

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PLANES_MOST: Final = 12
_MARGINS: Final = Margins(left=0.7, right=0.1, bottom=0.45, top=0.1, across=0.45, down=0.5)
# The names of materials stand between panels.
_WITH_NAMES: Final = replace(_MARGINS, across=1.3)
_LABELS: Final = {
    "incidence_deg": "angle of incidence [deg]",
    "range_m": "range [m]",
    "intensity": "intensity [0..1]",
}


def draw_thickness(
    ctx: StepContext,
    planes: Planes,
    found: tuple[Thickness | None, ...],
    row: ScanRow | None,
    materials: Materials,
) -> None:
    """Draw what is known about the thickness; nothing where no plane has enough points."""
    from matplotlib.figure import Figure

    known = [(k, item) for k, item in enumerate(found) if item is not None][:_PLANES_MOST]
    if not known:
        return
    classes = [name for name in _LABELS if any(item.over.get(name) for _, item in known)]
    named = any(item.over.get("material") for _, item in known)
    n_rows, n_columns = 1 if row is None else 2, 1 + len(classes) + int(named)
    figure = Figure(figsize=(3.4 * n_columns, 2.9 * n_rows))
    grid = figure.add_gridspec(n_rows, n_columns)
    across = _WITH_NAMES if named else _MARGINS
    space_out(figure, across, n_rows=n_rows, n_columns=n_columns)
    _draw_planes(figure.add_subplot(grid[0, 0]), planes, known)
    for place, name in enumerate(classes):
        axes = figure.add_subplot(grid[0, 1 + place])
        for k, item in known[:4]:
            spreads = item.over.get(name, ())
            middles = [0.5 * (spread.low + spread.high) for spread in spreads]
            sigmas_mm = [1000.0 * spread.sigma_m for spread in spreads]
            axes.plot(middles, sigmas_mm, "o-", markersize=3, label=planes.names[k])
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel(_LABELS[name], fontsize=8)
        axes.tick_params(labelsize=7)
        if place == 0:
            axes.legend(fontsize=7)
    if named:
        _draw_materials(figure.add_subplot(grid[0, -1]), planes, known)
    if row is not None:
        axes = figure.add_subplot(grid[1, :])
        axes.plot(row.along_m, 1000.0 * row.distance_m, ".", markersize=2, color="#333333")
        if row.intensity is not None:
            for name, (low, high) in materials.items():
                mine = (row.intensity >= low) & (row.intensity <= high)
                distance_mm = 1000.0 * row.distance_m[mine]
                axes.plot(row.along_m[mine], distance_mm, ".", markersize=2, label=name)
            if materials:
                axes.legend(fontsize=7, markerscale=3)
        axes.set_xlabel(
            f"along {planes.names[0]} [m], row {row.row} of scan {row.scan}", fontsize=8
        )
        axes.set_ylabel("distance [mm]", fontsize=8)
        axes.tick_params(labelsize=7)
    ctx.figure(
        "thickness",
        figure,
        "Thickness of the cloud, one standard deviation in millimetres: on each plane beside the "
        "scan step there, by class and by material. Below, one row of the scan on the first plane.",
    )


def _draw_materials(axes: Axes, planes: Planes, known: list[tuple[int, Thickness]]) -> None:
    """Thickness of each material on the first planes."""
    bars = [
        (f"{spread.name}, {planes.names[k]}", 1000.0 * spread.sigma_m)
        for k, item in known[:4]
        for spread in item.over.get("material", ())
    ]
    places = range(len(bars))
    axes.barh(places, [sigma_mm for _, sigma_mm in bars], color="#d2b89d")
    axes.set_yticks(places, [text for text, _ in bars], fontsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("thickness by material [mm]", fontsize=8)
    axes.tick_params(labelsize=7)


def _draw_planes(axes: Axes, planes: Planes, known: list[tuple[int, Thickness]]) -> None:
    places = range(len(known))
    axes.barh(places, [1000.0 * item.sigma_m for _, item in known], color="#9db8d2")
    steps_mm = [1000.0 * item.scan_step_m for _, item in known]
    axes.plot(steps_mm, places, "|", color="#b03a2e", label="scan step")
    axes.set_yticks(places, [planes.names[k] for k, _ in known], fontsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("thickness [mm]", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.legend(fontsize=7)
