"""Run the shipped comparisons, each in one drawn room, and print their tables as Markdown.

    python benchmarks/method_comparisons.py runs/comparisons
    python benchmarks/method_comparisons.py runs/comparisons --recipe plane-methods
    # the variants of markiewicz2015, as in the header of orient-methods.yaml:
    python benchmarks/method_comparisons.py runs/variants --recipe variant1 --recipe variant2

Each recipe runs with its simulated room into `FOLDER/<recipe>`, like `orthoflow run <recipe>.yaml`,
unless that folder contains a finished run. One report of all recipes is written to
`FOLDER/report.html`. For metrics with repeats, the best value and all values that do not differ
from it significantly are bold; values of single runs are not. docs/choosing.md compares methods
over many rooms. Processor seconds exclude loading and compiling; docs/performance.md has times.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from orthoflow.records.open import open_run
from orthoflow.records.runs import Run, cell_metrics
from orthoflow.report import write_report
from orthoflow.report.combinations import Combination, combinations_of
from orthoflow.report.rankings import Mark, Value, number, number_with_spread, rank

RECIPES = ("plane-methods", "orient-methods", "ortho-methods")
COARSE = {"room.scan_step_m": "0.004", "room.photo_gsd_m": "0.003", "wall.gsd_m": "0.006"}
# Settings of orient-methods.yaml.
VARIANTS = {
    "variant1": {
        **COARSE,
        "room.photo_layout": "variant1",
        "room.panorama_step_m": "0.0052",
        "wall.n_walls_max": "4",
        "wall.constraint": "vertical",
    },
    "variant2": {**COARSE, "room.photo_layout": "variant2", "room.calibrated": "false"},
}
# Metrics of each table and their column headings; the record has many more metrics.
COLUMNS: dict[str, dict[str, str]] = {
    "plane-methods": {
        "check.plane_angle_deg": "angle to truth / deg",
        "check.plane_offset_mm": "offset / mm",
        "plane.raw_angle_deg": "raw angle / deg",
        "plane.raw_offset_mm": "raw offset / mm",
        "check.label_precision": "precision",
        "check.label_recall": "recall",
        "check.label_iou_mean": "IoU, all planes",
        "check.true_planes_found": "planes found",
    },
    "orient-methods": {
        "orient.n_oriented": "photos oriented",
        "check.match_wrong_share": "wrong matches",
        "check.tie_wrong_share": "wrong ties kept",
        "orient.control_rmse_px_median": "control RMSE / px",
        "orient.check_rmse_px_median": "check RMSE / px",
        "orient.check_rmse_mm_median": "check RMSE / mm",
        "check.pose_wall_rms_mm": "true error of a pose / mm",
        "check.pose_error_over_sigma": "true over stated error",
        "check.rmse_u_mm": "orthoimage u / mm",
        "check.rmse_v_mm": "orthoimage v / mm",
        "check.nmad_u_mm": "typical u / mm",
        "check.nmad_v_mm": "typical v / mm",
        "check.completeness_seen_by_both": "painted",
        "orient.cpu_s": "processor / s",
    },
    "ortho-methods": {
        "check.rmse_u_mm": "orthoimage u / mm",
        "check.rmse_v_mm": "orthoimage v / mm",
        "check.completeness": "painted",
        "check.colour_rmse_grey": "colour error / grey levels",
        "surf.rmse_x_mm": "SURF x / mm",
        "surf.rmse_y_mm": "SURF y / mm",
        "surf.edge_width_cells": "edge width / cells",
        "points.rms_mm": "check points / mm",
        "points.flat_rms_mm": "flat points / mm",
        "points.vertical_edge_rms_mm": "vertical edges / mm",
        "ortho.cpu_s": "processor / s",
    },
}
# Several walls have separate metrics.
COLUMNS["variant1"] = {
    "orient.n_oriented": "photos oriented",
    "check.match_wrong_share": "wrong matches",
    "check.match_wrong_share_own_wall": "with the own wall",
    "check.tie_wrong_share": "wrong ties kept",
    "orient.check_rmse_px_median": "check RMSE / px",
    "orient.check_rmse_mm_median": "check RMSE / mm",
    "check.pose_wall_rms_mm": "true error of a pose / mm",
    "check.pose_error_over_sigma": "true over stated error",
    "check.rmse_u_mm": "wall 0, u / mm",
    "check.wall_1_rmse_u_mm": "wall 1, u / mm",
    "check.wall_2_rmse_u_mm": "wall 2, u / mm",
    "check.wall_3_rmse_u_mm": "wall 3, u / mm",
    "check.all_rmse_u_mm": "all, u / mm",
    "check.all_rmse_v_mm": "all, v / mm",
    "check.all_completeness_seen_by_both": "painted",
}
COLUMNS["variant2"] = COLUMNS["orient-methods"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recipe", action="append", choices=[*RECIPES, *VARIANTS])
    options = parser.parse_args()
    recipes = options.recipe or list(RECIPES)
    runs = [finished_run(options.folder, recipe) for recipe in recipes]
    for recipe, run in zip(recipes, runs, strict=True):
        print(f"\n### {recipe}, run {run.record.run_id}\n")
        print("\n".join(markdown(combinations_of(run), COLUMNS[recipe])))
    write_report(runs, options.folder / "report.html")


def finished_run(folder: Path, recipe: str) -> Run:
    """Run a recipe, or open its existing run."""
    target = folder / recipe
    if not (target / "run.h5").is_file():
        workflow = "orient-methods" if recipe in VARIANTS else recipe
        command = [sys.executable, "-m", "orthoflow", "run", f"{workflow}.yaml", "-o", str(target)]
        for name, value in VARIANTS.get(recipe, {}).items():
            command += ["--set", f"{name}={value}"]
        # Failed cells are shown in the table, so the exit code is ignored.
        subprocess.run([*command, "--store", str(folder / "store")], check=False)
    return open_run(target)


def markdown(combinations: Sequence[Combination], names: Mapping[str, str]) -> list[str]:
    """Print a table with a row per combination and a column per metric, best values in bold."""
    steps = tuple(dict.fromkeys(step for one in combinations for step in one.assignment))
    declared = {
        f"{row.step}.{row.metric}": (row.better, row.unit)
        for one in combinations
        for cell in one.cells
        for row in cell_metrics(cell)
    }
    columns = [
        rank([value_of(one, key) for one in combinations], *declared.get(key, ("", "1")))
        for key in names
    ]
    header = [*steps, *names.values()]
    lines = [line(header), line(["---"] * len(steps) + ["---:"] * len(names))]
    for index, one in enumerate(combinations):
        variants = [one.assignment.get(step, "-") for step in steps]
        if one.failure is not None:
            reason = one.failure.error_message.partition(":")[0]
            lines.append(line([*variants, f"failed: {reason}"]))
        else:
            lines.append(line([*variants, *(printed(column[index]) for column in columns)]))
    return lines


def value_of(one: Combination, key: str) -> Value:
    measured = one.measured(*key.split("."))
    if measured is None:
        return Value()
    if measured.n_repeats > 1:
        text = number_with_spread(measured.value, measured.spread)
    else:
        text = number(measured.value, significant=3)
    return Value(text=text, sort=measured.value, spread=measured.spread)


def printed(value: Value) -> str:
    if not value.text:
        return "-"
    return f"**{value.text}**" if value.mark in (Mark.BEST, Mark.NEAR) else value.text


def line(places: Sequence[str]) -> str:
    return f"| {' | '.join(places)} |"


if __name__ == "__main__":
    main()
