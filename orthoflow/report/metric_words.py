"""What each metric is, in words, alike on cards, in tables and in the reference of metrics.

A name is taken apart from the left (`all_`, `wall_3_`, `floor_`), what is left is looked up. A
metric that nobody described keeps its name.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from typing import Final

from orthoflow.records import COSTS
from orthoflow.records.metrics import MetricRow

# What stands before a name, and what is said behind the words of the rest.
_BEFORE: Final[tuple[tuple[re.Pattern[str], str], ...]] = (
    (re.compile(r"all_(?=.)"), "all walls"),
    (re.compile(r"wall_(?P<what>\d+)_(?=.)"), "wall {what}"),
    (re.compile(r"worst_(?=plane_)"), "worst plane"),
    (re.compile(r"raw_(?=.)"), "as voted, before the fit"),
    (re.compile(r"surf_(?=.)"), "by SURF"),
    (re.compile(r"floor_(?=.)"), "floor: what intensity alone shows of itself"),
)
# Classes of check points stand before the names of their numbers.
_CLASS: Final = re.compile(
    r"(?P<what>[a-z_]+?)_(?=n_found|rms_mm|sd_mm|mean_shift|n_outliers|rms_after|rmse_[xy]|"
    r"mean_[xy]|nmad_[xy]|max_[xy]|beyond_|p95_mm)"
)

WORDS: Final[Mapping[str, str]] = {
    # How good the products are.
    "rmse_u_mm": "error along u (right), RMS",
    "rmse_v_mm": "error along v (down), RMS",
    "nmad_u_mm": "typical error along u (NMAD)",
    "nmad_v_mm": "typical error along v (NMAD)",
    "mean_u_mm": "shift along u, mean",
    "mean_v_mm": "shift along v, mean",
    "p99_u_mm": "error along u, 99 % are below",
    "p99_v_mm": "error along v, 99 % are below",
    "step_rmse_u_mm": "error along u beside depth steps, RMS",
    "step_rmse_v_mm": "error along v beside depth steps, RMS",
    "patch_rmse_u_mm": "error along u as patches show it, RMS",
    "patch_rmse_v_mm": "error along v as patches show it, RMS",
    "patch_mean_u_mm": "shift along u as patches show it",
    "patch_mean_v_mm": "shift along v as patches show it",
    "n_patches": "patches compared with the truth",
    "n_points_left_out": "points of the files that are not used",
    "n_left_out_*": "points of the files that are not used, by reason",
    "noise_mm": "noise of the scan across its surfaces",
    "tolerance_m": "distance to a plane within which points belong to it",
    "fit_tolerance_m": "distance to a plane within which points decide its fit",
    "displaced_share": "cells displaced by more than one",
    "completeness": "painted or filled, of the scanned surface",
    "completeness_filled": "painted or filled, of the surface that is seen at all",
    "completeness_seen_by_both": "painted, of what a station and a photo see",
    "unseen_painted_share": "painted cells that no photo sees",
    "depth_rmse_mm": "error of the depth, RMS",
    "depth_step_rmse_mm": "error of the depth beside steps, RMS",
    "depth_median_mm": "shift of the depth, median",
    "depth_nmad_mm": "typical error of the depth (NMAD)",
    "depth_within_3sigma": "depths within three stated sigmas",
    "colour_rmse_grey": "error of the colour, RMS",
    "filled_colour_rmse_grey": "error of the colour of filled cells, RMS",
    "step_colour_rmse_grey": "error of the colour beside depth steps, RMS",
    "gross_colour_share": "cells of a grossly wrong colour",
    "ghost_colour_share": "cells with the colour of what stands before them",
    "ghost_share": "share of the cells painted through what hides them",
    "n_ghost_cells": "cells painted through what hides them",
    "n_traced": "cells traced back to their photo",
    "within_1_sigma_share": "cells whose error is within what the orthoimage states",
    "within_2_sigma_share": "cells whose error is within twice what the orthoimage states",
    "expected_mm_median": "expected error of a place in the orthoimages, median",
    "expected_mm_p95": "expected error of a place in the orthoimages, 95 % below",
    "far_source_share": "cells painted from far beside their place",
    "painted_share": "cells painted",
    "outvoted_share": "cells whose colour the other photos outvote",
    "contradicted_share": "cells where photos disagree and none is in the majority",
    "filled_share": "cells filled from neighbours",
    "none_share": "cells that show nothing",
    "no_surface_share": "cells without a surface",
    "void_share": "cells without a depth",
    "occluded_share": "cells hidden from the photo",
    "coloured_share": "points that got a colour",
    "stretch_share": "cells smeared over steep relief",
    "smear_share": "cells smeared along edges",
    "n_edges": "edges whose sharpness was measured",
    "edge_width_cells": "width of an edge",
    "mtf50_per_cell": "sharpness (MTF50)",
    # Orientation.
    "n_photos": "photos",
    "n_oriented": "photos oriented",
    "n_refused": "photos refused",
    "n_misoriented": "photos called ok that are not",
    "n_control": "ties that hold the photos",
    "n_check": "ties that only check",
    "control_rmse_px_median": "ties that hold, RMS per axis, median photo",
    "control_rmse_px_worst": "ties that hold, RMS per axis, worst photo",
    "check_rmse_px_median": "ties that only check, RMS per axis, median photo",
    "check_rmse_px_worst": "ties that only check, RMS per axis, worst photo",
    "check_rmse_mm_median": "ties that only check, RMS per axis on the wall, median photo",
    "check_rmse_mm_worst": "ties that only check, RMS per axis on the wall, worst photo",
    "sigma_wall_mm_median": "expected error of the orientation on the wall, median photo",
    "sigma_wall_mm_worst": "expected error of the orientation on the wall, worst photo",
    "sigma0": "sigma of unit weight",
    "redundancy": "redundancy of the adjustment",
    "n_photo_points": "points seen in several photos",
    "photo_tie_rmse_px": "ties between photos, RMS",
    "pose_wall_rms_mm": "true error of the photos on the wall, RMS",
    "pose_wall_median_mm": "true error on the wall, median photo",
    "pose_wall_max_mm": "true error on the wall, worst photo",
    "pose_centre_median_mm": "error of where photos were taken, median",
    "pose_centre_max_mm": "error of where photos were taken, worst",
    "pose_rotation_median_deg": "error of the direction of photos, median",
    "pose_rotation_max_deg": "error of the direction of photos, worst",
    "pose_error_over_sigma": "true error over the stated one",
    # Ties.
    "n_ties": "ties",
    "n_rejected": "ties rejected",
    "rejected_share": "share of the ties that is rejected",
    "n_photos_tied": "photos with ties",
    "n_photos_matched": "photos that were recognised",
    "ties_per_photo_median": "ties per photo, median",
    "n_wall_key_points": "key points of the walls",
    "n_by_hand": "ties measured by hand",
    "held_out_rmse_px_median": "ties left out of the fit, RMS per axis, median photo",
    "held_out_rmse_px_worst": "ties left out of the fit, RMS per axis, worst photo",
    "sigma_px_median": "stated sigma of a tie per axis, median",
    "match_wrong_share": "matches that are wrong",
    "match_wrong_share_own_wall": "matches with the photo's own wall that are wrong",
    "n_ties_kept": "ties that the orientation kept",
    "tie_wrong_share": "kept ties that are wrong",
    "tie_error_median_cells": "error of a kept tie, median",
    # Planes.
    "n_planes": "planes found",
    "plane_angle_deg": "direction of the main plane, error",
    "plane_offset_mm": "position of the main plane, error",
    "plane_corner_max_mm": "largest error of the main plane at its corners",
    "rms_mm": "points to the first plane, RMS",
    "fit_rms_mm": "points to the first plane, RMS of those fitted",
    "omega_deg": "direction of the first normal (omega)",
    "phi_deg": "inclination of the first normal (phi)",
    "offset_m": "offset of the first plane",
    "r_m": "distance of the first plane (r)",
    "angle_deg": "direction against the fitted plane",
    "offset_mm": "position against the fitted plane",
    "sigma_angle_deg": "stated sigma of the first plane's direction",
    "sigma_offset_mm": "stated sigma of the first plane's position",
    "n_independent": "independent points behind the stated sigmas",
    "thinning": "points per point that was looked at",
    "labelled_share": "points that lie on a plane",
    "first_share": "points that lie on the first plane",
    "detection_s": "time of the detection",
    "first_plane_s": "time until the first plane",
    "next_plane_s": "time of each further plane",
    "detection_cpu_s": "processor time of the detection",
    "first_plane_cpu_s": "processor time until the first plane",
    "next_plane_cpu_s": "processor time of each further plane",
    "skewness": "skewness of the distances to the first plane",
    "excess_kurtosis": "excess kurtosis of the distances to the first plane",
    "within_1_sigma": "distances to the first plane within one sigma",
    "within_2_sigma": "distances to the first plane within two sigmas",
    "within_3_sigma": "distances to the first plane within three sigmas",
    "thickness_mm": "thickness of the cloud on the first plane",
    "thickness_width_mm": "width that holds 95 % of the distances to the first plane",
    "thickness_scan_steps": "thickness over the scan step on the first plane",
    "thickest_mm": "thickness of the cloud where it is thickest",
    "own_tolerance_mm": "tolerance taken from the cloud",
    "n_regions": "regions grown",
    "neighbourhood_mm": "radius of a neighbourhood",
    "cell_mm": "side of a surface cell",
    "normal_scatter_deg": "scatter of the normals",
    "true_planes": "true planes",
    "n_true_planes": "true planes",
    "true_planes_found": "true planes that were found",
    "main_found": "the main wall was found (1) or not (0)",
    "label_precision": "labels of the main plane that are right (precision)",
    "label_recall": "points of the main plane that are labelled (recall)",
    "label_f1": "labels of the main plane (F1)",
    "label_iou": "labels of the main plane (overlap)",
    "label_precision_mean": "labels that are right, mean of the planes",
    "label_recall_mean": "points that are labelled, mean of the planes",
    "label_f1_mean": "labels (F1), mean of the planes",
    "label_iou_mean": "labels (overlap), mean of the planes",
    "n_planes_guessed": "planes whose side the photos were asked for",
    "n_planes_seen": "planes whose side photos decided",
    "n_planes_turned": "planes turned to the photos",
    # Clouds and rasters.
    "n_points": "points",
    "n_scans": "scans",
    "n_stations": "stations",
    "n_invalid": "points the scanner calls invalid",
    "n_not_finite": "points that are no numbers",
    "n_withheld": "points withheld",
    "extent_x_m": "extent along x of the world",
    "extent_y_m": "extent along y of the world",
    "extent_z_m": "extent along z of the world",
    "scan_step_mm": "step of the scan",
    "scan_step_median_mm": "step of the scan on the main wall, median",
    "scan_step_p90_mm": "step of the scan on the main wall, 90 % are below",
    "scans_apart_mm": "scans apart from each other",
    "n_calibrated": "photos with a calibration",
    "n_exif_focal": "photos with a focal length in EXIF",
    "n_measured": "check points measured in pictures",
    "megapixels": "megapixels in all",
    "photo_megapixels": "megapixels in all",
    "photo_gsd_mm": "size of a photo's pixel on the wall",
    "photo_obliquity_max_deg": "most oblique view of a photo",
    "main_wall_points": "points on the main wall",
    "outlier_share": "points that were spoilt on purpose",
    "n_walls": "walls",
    "area_m2": "area of the first wall's raster",
    "gsd_mm": "side of a cell",
    "n_points_inside": "points within the walls",
    "points_per_cell": "points per cell",
    "depth_noise_mm": "noise of the depths",
    "sigma_median_mm": "spread of the depths in a cell, median",
    "measured_share": "cells with a measured depth",
    "recovered_share": "cells recovered between measured ones",
    "void_behind_share": "cells whose points lie behind the buffer",
    "void_before_share": "cells behind what stands before the buffer",
    "void_hidden_share": "cells hidden by what stands between them and the scanner",
    "void_sparse_share": "cells beside scanned ones: gaps, shadows of relief, rims",
    "void_unseen_share": "cells of glass, or that no station sees",
    "void_*_share": "cells without a depth, by cause",
    "empty*_share": "cells without a depth, by cause",
    "intensity_cosine_power": "intensity over the angle, power",
    "intensity_range_power": "intensity over the distance, power",
    "intensity_scale_spread": "intensity between stations, spread",
    # Registration, laying photos onto walls, joining.
    "sigma0_mm": "sigma of a point's coordinate",
    "max_mm": "largest residual",
    "scale": "scale of the transformation",
    "scale_ppm": "scale, from 1",
    "left_out_rms_mm": "each point left out once, RMS",
    "projection_s": "time of the projection",
    "filling_s": "time of the filling",
    "occluders_s": "time of finding what hides",
    "decoding_s": "time of decoding photos",
    "painting_s": "time of painting",
    "n_layers": "photos laid onto walls",
    "obliquity_deg": "obliquity of the views",
    "n_orthoimages": "orthoimages",
    "n_sources": "photos used",
    "gain_min": "least brightening of a photo",
    "gain_max": "most brightening of a photo",
    "lens_loss_share": "light that a lens loses towards the corners, the most",
    "seam_share": "cells along seams",
    "seam_on_depth_edge_share": "seams that lie on depth edges",
    "seam_step_rms_grey": "step of brightness at seams, RMS",
    "seam_step_mean_delta_e": "step of colour at seams, mean",
    "seam_step_untouched_delta_e": "step of colour at seams before balancing, mean",
    "n_overlap_patches": "patches compared where photos overlap",
    "overlap_u_rms_cells": "photos apart along u where they overlap, RMS",
    "overlap_v_rms_cells": "photos apart along v where they overlap, RMS",
    "overlap_u_rms_mm": "photos apart along u where they overlap, RMS on the wall",
    "overlap_v_rms_mm": "photos apart along v where they overlap, RMS on the wall",
    # Openings.
    "n_openings": "openings found",
    "n_through": "openings looked through",
    "n_niche": "openings with a measured back",
    "n_no_data": "openings from which nothing came back",
    "openings_area_m2": "area of the openings",
    "openings_share": "share of the walls that is open",
    "side_sigma_mm": "stated error of a side, median",
    "image_side_share": "sides that a photo placed",
    "n_unbounded": "open areas that are no openings by rim or shape",
    "n_true_openings": "openings of the scene",
    "n_found_openings": "openings of the scene that were found",
    "n_false_openings": "outlines of no opening",
    "opening_iou_mean": "overlap with the true openings, mean",
    "opening_iou_min": "overlap with the true openings, least",
    "opening_depth_error_max_mm": "error of an opening's depth, largest",
    "side_rmse_mm": "error of sides, RMS",
    "side_rmse_cells": "error of sides, RMS",
    "side_mean_mm": "openings too large (+) or small, mean of sides",
    "side_max_mm": "error of sides, largest",
    "side_error_over_sigma": "error of sides over the stated one",
    "n_stray_sides": "sides with no true one near",
    # Inspection.
    "n_walls_inspected": "walls inspected",
    "n_key_points": "key points of the orthoimage",
    "n_key_points_intensity": "key points of the intensity",
    "matched_kept_share": "matches kept",
    "n_pairs": "pairs compared",
    "rmse_x_mm": "displacement along u (right), RMS",
    "rmse_y_mm": "displacement along v (down), RMS",
    "rmse_x_cells": "displacement along u (right), RMS",
    "rmse_y_cells": "displacement along v (down), RMS",
    "mean_x_mm": "displacement along u, mean",
    "mean_y_mm": "displacement along v, mean",
    "nmad_x_mm": "typical displacement along u (NMAD)",
    "nmad_y_mm": "typical displacement along v (NMAD)",
    "max_x_mm": "largest displacement along u",
    "max_y_mm": "largest displacement along v",
    "beyond_2rmse_x_share": "beyond twice the RMS along u",
    "beyond_2rmse_y_share": "beyond twice the RMS along v",
    "beyond_2rmse_any_share": "beyond twice the RMS along u or v",
    "p95_mm": "error, 95 % are below",
    "n_found": "check points found",
    "sd_mm": "check points, standard deviation",
    "mean_shift_mm": "check points, mean shift",
    "mean_shift_share": "mean shift over the RMS",
    "n_outliers_once": "outliers, rule applied once",
    "n_outliers_iterated": "outliers, rule applied again and again",
    "n_outliers_iterated_capped": "outliers, again and again to the cap",
    "rms_after_once_mm": "RMS without outliers, rule applied once",
    "rms_after_iterated_mm": "RMS without outliers, again and again",
    "rms_after_iterated_capped_mm": "RMS without outliers, to the cap",
    "n_3d": "check points compared in space",
    "rms_3d_mm": "check points in space, RMS",
    "max_3d_mm": "check points in space, largest error",
    "n_lengths": "lengths compared",
    "length_error_rms_share": "error of a length over it, RMS",
    "length_error_max_share": "error of a length over it, largest",
    # What the engine measures of every cell.
    "wall_s": "time",
    "cpu_s": "processor time",
    "compile_s": "time of loading and compiling",
    "peak_rss_mib": "memory",
    "stored_mib": "room in the store",
}


# Kinds whose metrics are described above, and names that say another thing in one of them, or in
# one method.
_KINDS: Final = frozenset(
    (
        *("colour", "face", "inspect", "match", "mosaic", "orient", "ortho", "plane", "raster"),
        *("read", "register", "segment", "simulate"),
    )
)
_OF_SOME: Final[Mapping[tuple[str, str], str]] = {
    ("inspect", "rms_mm"): "check points, RMS",
    ("inspect.checkpoints", "n_points"): "check points",
    ("inspect.truth", "completeness"): "painted, not filled, of the surface that is seen at all",
    ("mosaic", "occluded_share"): "cells hidden from every photo",
    ("ortho.pointcloud-direct", "void_share"): "cells that got no colour",
    ("plane", "scan_step_mm"): "step of the scan on the first plane, without relief",
    ("raster", "scan_step_mm"): "step of the scan on the first wall",
    ("read.checkpoints", "n_points"): "check points",
    ("read.scan", "scan_step_mm"): "distance of neighbours in the scan",
    ("read.scan", "thickness_mm"): "thickness of the cloud in pieces of about 10 cm",
    ("read.scan", "thickness_scan_steps"): "that thickness over the distance of neighbours",
    ("register", "n_pairs"): "pairs of points",
    ("register", "rms_mm"): "points to their places, RMS",
}


def words_of(name: str, method: str, declared: str = "") -> str:
    """Say what a metric of a method is: what a stranger calls it, or our words for our own kinds.

    Args:
        name: of the metric.
        method: that reported it.
        declared: what its record says that the method calls it; empty where it says nothing.

    >>> words_of("rms_mm", "plane.hough2d"), words_of("rms_mm", "register.similarity")
    ('points to the first plane, RMS', 'points to their places, RMS')
    >>> words_of("n_patches", "moisture.simple"), words_of("wall_s", "moisture.simple")
    ('n_patches', 'time')
    """
    if declared:
        return declared
    kind = method.partition(".")[0]
    if kind not in _KINDS and name not in COSTS:
        return name
    return metric_words(name, method)


def metric_words(name: str, method: str = "") -> str:
    """Say what a metric is; its own name where nobody described it.

    Args:
        name: of the metric.
        method: that reports it, or its kind; some say another thing by a name.

    >>> metric_words("rmse_u_mm")
    'error along u (right), RMS'
    >>> metric_words("wall_3_rmse_u_mm"), metric_words("all_n_edges")
    ('error along u (right), RMS; wall 3', 'edges whose sharpness was measured; all walls')
    >>> metric_words("vertical_edge_n_found"), metric_words("strangeness")
    ('check points found; vertical edge', 'strangeness')
    >>> metric_words("target_rms_mm", "inspect")
    'check points, RMS; target'
    """
    rest, behind = name, []
    owners = (method, method.partition(".")[0])
    while (words := _words_at(owners, rest)) is None:
        found = next(_prefixes(rest), None)
        if found is None:
            return name
        said, length = found
        behind.append(said)
        rest = rest[length:]
    return "; ".join([words, *behind])


def label_in_words(row: MetricRow) -> str:
    """Say what a metric is, with its unit; shares and counts (unit 1) stand alone."""
    words = words_of(row.metric, row.method, row.label)
    return words if row.unit == "1" else f"{words} / {row.unit}"


def is_described(name: str) -> bool:
    """Whether there are words for a metric, or for all that a declared pattern stands for.

    >>> is_described("rmse_[uv]_mm"), is_described("wall_[0-9]*_completeness"), is_described("odd")
    (True, True, False)
    """
    return all(metric_words(one) != one for one in spelt_out(name))


def spelt_out(pattern: str) -> list[str]:
    """Give the names that a declared pattern stands for; a `*` is one word or number.

    >>> spelt_out("rmse_[uv]_mm"), spelt_out("void_*_share")
    (['rmse_u_mm', 'rmse_v_mm'], ['void_*_share'])
    """
    if pattern in WORDS:
        return [pattern]
    plain = pattern.replace("[0-9]*", "1").replace("*", "some")
    found = re.search(r"\[([a-z0-9]+)\]", plain)
    if found is None:
        return [plain]
    return [
        name
        for letter in found[1]
        for name in spelt_out(plain[: found.start()] + letter + plain[found.end() :])
    ]


def _words_at(owners: tuple[str, ...], name: str) -> str | None:
    own = (_OF_SOME[owner, name] for owner in owners if (owner, name) in _OF_SOME)
    return next(own, None) or WORDS.get(name) or _by_pattern(name)


def _by_pattern(name: str) -> str | None:
    return next(
        (said for key, said in WORDS.items() if "*" in key and fnmatchcase(name, key)), None
    )


def _prefixes(name: str) -> Iterator[tuple[str, int]]:
    for pattern, said in (*_BEFORE, (_CLASS, "{what}")):
        if found := pattern.match(name):
            what = found.groupdict().get("what", "").replace("_", " ")
            yield said.format(what=what), found.end()
