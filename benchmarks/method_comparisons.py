"""The tables of docs/results.md: the shipped comparisons run, and printed as Markdown.

    python benchmarks/method_comparisons.py runs/comparisons
    python benchmarks/method_comparisons.py runs/comparisons --recipe plane-methods

Each recipe runs into `FOLDER/<recipe>` on its simulated room, as `orthoflow run <recipe>.yaml` does
it, unless that folder holds a finished run; a single report of all of them goes to
`FOLDER/report.html`. Best values are bold where a metric has a good side. Times are wall times on
the machine that ran it, compiling included, so they say which method is expensive, not how fast it
is: docs/performance.md measures that.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from orthoflow.records import Run, open_run
from orthoflow.report import write_report
from orthoflow.report.comparisons import ComparisonTable, Row, comparison_table
from orthoflow.report.rankings import Mark, Value

RECIPES = ("plane-methods", "orient-methods", "ortho-methods")
# Metrics of each table and what stands over them; the record has many more.
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
        "plane.detection_s": "detection / s",
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
    },
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recipe", action="append", choices=RECIPES)
    options = parser.parse_args()
    runs = [finished_run(options.folder, recipe) for recipe in options.recipe or RECIPES]
    for run in runs:
        print(f"\n### {run.record.name}, run {run.record.run_id}\n")
        table = comparison_table([run])
        if table is None:
            raise SystemExit(f"{run.path} compares nothing")
        print("\n".join(markdown(table, COLUMNS.get(run.record.name, {}))))
    write_report(runs, options.folder / "report.html")


def finished_run(folder: Path, recipe: str) -> Run:
    """Run a recipe, or take the run that is there."""
    target = folder / recipe
    if not (target / "run.h5").is_file():
        command = [sys.executable, "-m", "orthoflow", "run", f"{recipe}.yaml", "-o", str(target)]
        # Failed cells are rows of the table, so the exit code is no reason to stop.
        subprocess.run([*command, "--store", str(folder / "store")], check=False)
    return open_run(target)


def markdown(table: ComparisonTable, names: dict[str, str]) -> list[str]:
    """Print the wanted columns, all of them when none is named."""
    keys = [f"{column.step}.{column.metric}" for column in table.columns]
    wanted = [key for key in names if key in keys] or keys
    header = [*table.steps, *(names.get(key, key) for key in wanted), "time / s", "memory / MiB"]
    lines = [_line(header), _line(["---"] * len(table.steps) + ["---:"] * (len(wanted) + 2))]
    return lines + [_line(_places(row, [keys.index(key) for key in wanted])) for row in table.rows]


def _places(row: Row, columns: Sequence[int]) -> list[str]:
    if row.failure:
        return [*row.variants, f"failed: {row.failure}"]
    told = [row.values[index] for index in columns]
    return [*row.variants, *(_printed(value) for value in (*told, row.time, row.memory))]


def _printed(value: Value) -> str:
    if not value.text:
        return "-"
    return f"**{value.text}**" if value.mark is Mark.BEST else value.text


def _line(places: Sequence[str]) -> str:
    return f"| {' | '.join(places)} |"


if __name__ == "__main__":
    main()
