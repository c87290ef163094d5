"""Many runs on a page that leads to the report of each."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.errors import OrthoflowError
from orthoflow.records.runs import REPORT_FILE
from orthoflow.records.unfinished import open_run
from orthoflow.report.browsing import RunSummary, differing_facts, key_metrics, told_apart
from orthoflow.report.combinations import baseline_cells
from orthoflow.report.pictures import thumbnail
from orthoflow.report.rendering import environment, write_whole

_PICTURE_PX: Final = 180
_PICTURES_MOST: Final = 200  # about 8 kB each
_KEYS_MOST: Final = 6


@dataclass(frozen=True, kw_only=True)
class _Row:
    """One run: where its report is, its first orthoimage, and in what it differs."""

    run: RunSummary
    link: str
    picture: str
    differs: str


def write_run_table(runs: Sequence[RunSummary], path: Path, *, among: Sequence[RunSummary]) -> None:
    """Write a page with a row per run.

    Args:
        runs: in the order of the rows.
        path: file to write.
        among: those that they were chosen from; in what they differ is told against all of these.

    Raises:
        StoreError: it cannot be written.
    """
    facts = differing_facts(among)
    known = dict.fromkeys(name for run in runs for name in run.metrics if "." not in name)
    names = {
        name: next(run.labels[name] for run in runs if name in run.labels)
        for name in told_apart(known, runs)
    }
    rows = [
        _Row(
            run=run,
            link=_link(run.folder, path),
            picture=_picture(run.folder) if index < _PICTURES_MOST else "",
            differs=", ".join(
                f"{name}={json.dumps(value, ensure_ascii=False)}"
                for name, value in facts[run.folder].items()
            ),
        )
        for index, run in enumerate(runs)
    ]
    page = (
        environment()
        .get_template("runs.html.j2")
        .render(
            title=f"{len(runs)} runs",
            rows=rows,
            names=names,
            key_names=set(told_apart(key_metrics(runs, most=_KEYS_MOST), runs)),
            reasons={str(run.folder): run.reason for run in runs if run.reason},
        )
    )
    write_whole(path, page)


def _link(folder: Path, path: Path) -> str:
    report = folder / REPORT_FILE
    return Path(os.path.relpath(report, path.parent)).as_posix() if report.is_file() else ""


def _picture(folder: Path) -> str:
    """The first orthoimage of a run; none where its record cannot be read."""
    try:
        run = open_run(folder)
        made = {cell.address for cell in baseline_cells(run)}
        return thumbnail(run, made, longest_side_px=_PICTURE_PX)
    except (OrthoflowError, OSError, KeyError, ValueError):
        return ""
