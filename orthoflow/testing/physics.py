"""Physical checks of results: planes after a motion, poses, and positions of cells."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import (
    Cameras,
    Layer,
    LayerMask,
    Layers,
    Orthoimage,
    Orthoimages,
    Planes,
    is_painted,
)
from orthoflow.testing.photographed import (
    PHOTOGRAPHING,
    TexturedWall,
    cloud_of,
    drawn_ties,
    places_of_cells,
    textured_wall,
    two_halves,
    wall_error_m,
    walls_of,
)
from orthoflow.testing.subjects import Subject, output_of, require

# With errors of 0.3 px and 1 mm at 2.5 m, a single tie is off by 1.3 mm on the wall, and the mean
# of a hundred ties by a tenth of that. The half-pixel error of a wrong pixel convention is 1.5 mm.
_POSE_LIMIT_M: Final = 0.0008
_CELL_SIZES_M: Final = (0.006, 0.01)
_SHIFT_LIMIT_CELLS: Final = 0.2
_PAINTED_SHARE: Final = 0.3
# Layers together show all cells of the example.
_JOINED_SHARE: Final = 0.97
# Seeds of the sets of ties whose errors are compared with the predicted ones.
_DRAWS: Final = (2, 3, 4)
# A plane farther than this from all true planes is not part of the room.
_SAME_PLANE_M: Final = 0.02
# A variance of zero is replaced by this value, so that the ratio of actual to predicted error
# becomes far too large.
_NO_VARIANCE: Final = 1e-30
# Limits of the ratio of actual to predicted RMS error. The RMS is accurate to one eighth; built-in
# methods have ratios of 0.82 to 0.93.
_STATED_LIMITS: Final = (0.1, 2.0)


def planes_follow_a_rigid_motion(subject: Subject) -> None:
    """If a room is rotated about the vertical and shifted, the planes found in it move with it.

    Tolerances are 0.02 deg and 1 mm, far above the noise of the fit (2 mm / sqrt(n)) and far below
    the errors of a method that depends on the direction of the axes or loses precision.
    """
    shift_m = np.array([634512.347, 486215.781, 112.193])
    for planes, truth in (*subject.turned_rooms, subject.planes_in_room(1, 191.7, shift_m)):
        require(len(planes) > 0, "no plane was found")
        match_planes(planes, truth)


def match_planes(found: Planes, truth: Planes) -> None:
    """Require that each plane found matches a true plane."""
    for index in range(len(found)):
        cosines = truth.normal @ found.normal[index]
        centres = truth.corners.mean(axis=1)
        gaps_m = np.abs(centres @ found.normal[index] - found.offset[index])
        angles_deg = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
        fits = (angles_deg < 0.02) & (gaps_m < 0.001)
        require(
            bool(fits.any()),
            f"plane {index} of a rotated and shifted room is {angles_deg.min():.3f} deg and "
            f"{1000 * gaps_m[np.argmin(angles_deg)]:.2f} mm from the nearest true plane",
        )


def stated_errors_of_planes_hold(subject: Subject) -> None:
    """In random rooms, errors of planes are 0.1 to 2 times those predicted by the covariances."""
    ratios: list[float] = []
    for found, truth in subject.turned_rooms:
        for index in range(len(found)):
            corners = truth.corners[np.argmax(truth.normal @ found.normal[index])]
            places = np.vstack([corners, corners.mean(axis=0)])
            off_m = places @ found.normal[index] - found.offset[index]
            # Planes that are not part of the room are ignored.
            if np.abs(off_m).max() < _SAME_PLANE_M:
                at = np.column_stack([places, -np.ones(len(places))])
                variances = np.einsum("ij,jk,ik->i", at, found.covariance[index], at)
                ratios += (np.abs(off_m) / np.sqrt(np.maximum(variances, _NO_VARIANCE))).tolist()
    _check_ratios(ratios, "distances of true corners from planes")


def stated_errors_of_poses_hold(subject: Subject) -> None:
    """With random ties, errors of poses are 0.1 to 2 times those predicted by the covariances."""
    ratios: list[float] = []
    for seed in _DRAWS:
        run = subject.run_on_photographs(ties=drawn_ties(seed))
        for camera in output_of(run, "cameras", Cameras).cameras:
            if camera.status == "ok" and camera.covariance is not None:
                found, true = camera.viewing(), PHOTOGRAPHING[camera.photo]
                turn = true.rotation @ found.rotation.T
                # The components of a small rotation vector are the entries of the matrix's
                # skew-symmetric part.
                turned = 0.5 * (turn - turn.T)[(2, 0, 1), (1, 2, 0)]
                error = np.concatenate([turned, true.translation - found.translation])
                covariance = camera.covariance + _NO_VARIANCE * np.eye(6)
                ratios.append(math.sqrt(error @ np.linalg.solve(covariance, error) / 6.0))
    if ratios:
        _check_ratios(ratios, "poses")


def _check_ratios(ratios: list[float], what: str) -> None:
    require(ratios, "no plane of a random room was found")
    factor = math.sqrt(float(np.mean(np.square(ratios))))
    low, high = _STATED_LIMITS
    require(
        low <= factor <= high,
        f"{what} are {factor:.3g} times the standard deviations from the covariances (allowed: "
        f"{low:.2g} to {high:g} times, RMS over {len(ratios)}): return covariances that "
        "correspond to your fit and the noise of the points",
    )


def poses_are_recovered(subject: Subject) -> None:
    """Two photos with noisy ties, some of them wrong, are oriented to 0.8 mm on the wall."""
    for camera in output_of(subject.run_on_photographs(), "cameras", Cameras).cameras:
        require(camera.status == "ok", f"{camera.photo} was not oriented: {camera.status}")
        true = PHOTOGRAPHING[camera.photo]
        error_m = wall_error_m(textured_wall(), camera.viewing(), true)
        require(
            error_m < _POSE_LIMIT_M,
            f"the pose of {camera.photo} is off by {1000 * error_m:.2f} mm on the wall; the "
            f"limit is {1000 * _POSE_LIMIT_M:.1f} mm",
        )


def cells_show_their_own_place(subject: Subject) -> None:
    """With two cell sizes, each coloured cell has the colour of its own position, to 0.2 cells."""
    for gsd_m in _CELL_SIZES_M:
        scene = textured_wall(gsd_m=gsd_m)
        run = subject.run_on_photographs(walls=walls_of(scene), cloud=cloud_of(scene))
        layers = output_of(run, "layers", Layers).layers
        require(layers, "no layer was made")
        for layer in layers:
            check_cells(scene, layer, layer.source, layer.mask == LayerMask.PAINTED)


def mosaics_show_cells_in_place(subject: Subject) -> None:
    """An orthoimage of two overlapping layers has the right colour in each cell."""
    for gsd_m in _CELL_SIZES_M:
        scene = textured_wall(gsd_m=gsd_m)
        run = subject.run_on_photographs(layers=two_halves(scene), walls=walls_of(scene))
        images = output_of(run, "orthoimages", Orthoimages).images
        require(images, "no orthoimage was made")
        for image in images:
            check_cells(scene, image, image.name, is_painted(image.mask), _JOINED_SHARE)


def check_cells(
    scene: TexturedWall,
    image: Layer | Orthoimage,
    name: str,
    painted: NDArray[np.bool_],
    min_share: float = _PAINTED_SHARE,
) -> None:
    """Require that an image covers a share of the wall and shows its texture where it is."""
    truth_grey = 255.0 * scene.grey(*places_of_cells(image.frame))
    where = f"{name} at {image.frame.gsd_m} m"
    share = float(painted.mean())
    require(share > min_share, f"{where}: only {share:.0%} of the wall is covered")
    gradient: list[NDArray[np.float64]] = list(np.gradient(truth_grey))
    down, across = gradient
    # Shown minus true = gradient * displacement; the displacement of each layer is the
    # least-squares solution.
    design = np.column_stack([across[painted], down[painted], np.ones(int(painted.sum()))])
    difference = image.rgb[..., 0][painted].astype(np.float64) - truth_grey[painted]
    shift_cells = np.linalg.solve(design.T @ design, design.T @ difference)[:2]
    require(
        bool(np.abs(shift_cells).max() < _SHIFT_LIMIT_CELLS),
        f"{where}: colours are shifted by {shift_cells[0]:+.2f} columns and "
        f"{shift_cells[1]:+.2f} rows",
    )
    off = float(np.median(np.abs(difference)))
    require(off < 16.0, f"{where}: half of the colours are wrong by {off:.0f} grey levels or more")
