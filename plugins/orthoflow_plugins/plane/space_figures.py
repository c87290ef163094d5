"""Pictures of a 3D accumulator before any plane was taken from it: best votes, and sections."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthoflow.geometry import omega_phi_deg
from orthoflow.products import Planes
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.space_directions import Directions

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# What markiewicz2015 cuts its accumulator at, Figure 13; degrees.
SECTIONS_DEG: Final = (0.0, 45.0, 90.0)
# A direction stands for another one that is nearer than this, in steps between directions.
_STANDS_FOR_STEPS: Final = 1.5


@dataclass(frozen=True, kw_only=True)
class SpacePicture:
    """What an accumulator held.

    Attributes:
        best: (o, p) best contrast of any distance, over omega 0..180 and phi -90..90 degrees; NaN
            where no direction of that phi was asked about.
        over_omega: (3, o, d) votes over omega and distance, for each phi of `SECTIONS_DEG`; NaN
            where no direction was asked about.
        over_phi: (3, p, d) votes over phi and distance, for each omega of `SECTIONS_DEG`.
        reach_m: distances run from minus this to this, from the middle of the scene's box.
    """

    best: NDArray[np.float64]
    over_omega: NDArray[np.float64]
    over_phi: NDArray[np.float64]
    reach_m: float


def pictured(
    directions: Directions,
    votes: NDArray[np.int32],
    scores: NDArray[np.float64],
    *,
    bin_m: float,
) -> SpacePicture:
    """Cut an accumulator.

    Args:
        directions: that it asks about.
        votes: (d, b) votes per direction and distance.
        scores: (d,) best contrast of each direction.
        bin_m: width of a bin of distances.
    """
    n_turns = len(directions.starts) - 1
    best = np.full((n_turns, n_turns + 1), np.nan)
    column = np.rint((directions.angles_rad[:, 1] + 0.5 * math.pi) / directions.step_rad)
    row = np.rint(directions.angles_rad[:, 0] / directions.step_rad)
    best[row.astype(int), column.astype(int)] = scores
    # Each direction stands for those of the same phi up to the next one.
    last_asked = np.where(np.isnan(best), 0, np.arange(n_turns)[:, None])
    best = np.take_along_axis(best, np.maximum.accumulate(last_asked, axis=0), axis=0)
    omegas = directions.step_rad * np.arange(n_turns, dtype=np.float64)
    phis = directions.step_rad * np.arange(n_turns + 1, dtype=np.float64) - 0.5 * math.pi
    cuts = np.radians(SECTIONS_DEG)
    # Distances beyond all points say nothing.
    n_bins = votes.shape[1]
    used = np.flatnonzero(votes.any(axis=0))
    beyond = int(min(used[0], n_bins - 1 - used[-1])) if len(used) else 0
    votes = votes[:, beyond : n_bins - beyond]
    return SpacePicture(
        best=best,
        over_omega=np.stack([_section(directions, votes, omegas, phi) for phi in cuts]),
        over_phi=np.stack([_section(directions, votes, omega, phis) for omega in cuts]),
        reach_m=0.5 * votes.shape[1] * bin_m,
    )


def _section(
    directions: Directions,
    votes: NDArray[np.int32],
    omega: ArrayLike,
    phi: ArrayLike,
) -> NDArray[np.float64]:
    """(n, b) votes for each of n directions, those of the nearest one that was asked about."""
    omegas, phis = np.broadcast_arrays(np.asarray(omega, dtype=float), np.asarray(phi, dtype=float))
    wanted = np.stack([np.cos(phis) * np.cos(omegas), np.cos(phis) * np.sin(omegas), np.sin(phis)])
    cosines = directions.normals @ wanted
    nearest = np.abs(cosines).argmax(axis=0)
    cosine = cosines[nearest, np.arange(len(nearest))]
    section: NDArray[np.float64] = votes[nearest].astype(np.float64)
    # On the other side of the hemisphere distances count the other way.
    section[cosine < 0.0] = section[cosine < 0.0, ::-1]
    section[np.abs(cosine) < math.cos(_STANDS_FOR_STEPS * directions.step_rad)] = np.nan
    return section


def draw_space(ctx: StepContext, picture: SpacePicture, planes: Planes) -> None:
    """Draw an accumulator's best votes with the planes found, and its sections.

    Args:
        ctx: takes the figures.
        picture: what it held.
        planes: the planes, world.
    """
    _draw_best(ctx, picture, planes)
    _draw_sections(ctx, picture)


def _draw_best(ctx: StepContext, picture: SpacePicture, planes: Planes) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.imshow(
        np.sqrt(np.maximum(picture.best.T, 0.0)),
        origin="lower",
        aspect="auto",
        cmap="gray",
        extent=(0.0, 180.0, -90.0, 90.0),
    )
    for normal in planes.normal:
        omega_deg, phi_deg = omega_phi_deg(normal, planes.up)
        if omega_deg >= 180.0:
            omega_deg, phi_deg = omega_deg - 180.0, -phi_deg
        axes.plot(omega_deg, phi_deg, "o", fillstyle="none", markersize=9)
    axes.set_xlabel("omega [deg]")
    axes.set_ylabel("phi [deg]")
    ctx.figure(
        "accumulator",
        figure,
        "The best votes of any distance over the direction of the normal; circles mark the planes. "
        "Directions are even over the hemisphere: towards the poles one stands for several.",
    )


def _draw_sections(ctx: StepContext, picture: SpacePicture) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 6.4), layout="constrained")
    axes = figure.subplots(2, 3)
    for place, cut_deg in enumerate(SECTIONS_DEG):
        _draw_section(axes[0, place], picture.over_omega[place], (0.0, 180.0), picture.reach_m)
        _draw_section(axes[1, place], picture.over_phi[place], (-90.0, 90.0), picture.reach_m)
        axes[0, place].set_title(f"phi = {cut_deg:.0f} deg", fontsize=9)
        axes[1, place].set_title(f"omega = {cut_deg:.0f} deg", fontsize=9)
        axes[0, place].set_xlabel("omega [deg]", fontsize=8)
        axes[1, place].set_xlabel("phi [deg]", fontsize=8)
    for row in axes:
        row[0].set_ylabel("distance from the middle [m]", fontsize=8)
    ctx.figure(
        "accumulator-sections",
        figure,
        "Votes over direction and distance before any plane was taken, in sections of one phi "
        "(above) and of one omega (below); the brighter the more, by the square root.",
    )


def _draw_section(
    axes: Axes, section: NDArray[np.float64], span_deg: tuple[float, float], reach_m: float
) -> None:
    axes.imshow(
        np.sqrt(section.T),
        origin="lower",
        aspect="auto",
        cmap="gray",
        extent=(*span_deg, -reach_m, reach_m),
    )
    axes.tick_params(labelsize=7)
