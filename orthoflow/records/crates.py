"""A run as a Provenance Run Crate: a folder that workflow archives and their tools understand."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Final

from orthoflow.engine.durability import writing_to
from orthoflow.engine.run_folder import RECORD_FILE
from orthoflow.records.crate_entities import RESOLVED_FILE, WORKFLOW_FILE, environment_file
from orthoflow.records.crate_graph import METADATA_FILE, crate_metadata
from orthoflow.records.published import METRICS_FILE, PRODUCTS_FOLDER
from orthoflow.records.runs import REPORT_FILE, Run

NO_LICENSE: Final = "not stated: ask who made these results"


def write_crate(
    run: Run, folder: Path, *, license_text: str = NO_LICENSE, record: Run | None = None
) -> tuple[Path, ...]:
    """Write a run as an RO-Crate: record, report, products, workflow and their description.

    Input files are named by their digests, not copied: they may be large, and others' property.
    An embedded record has them, see `write_embedded`.

    Args:
        run: the run.
        folder: existing folder, empty but for `record`.
        license_text: URL or name of the license of the results.
        record: the run with another record, which lies in the folder already.

    Returns:
        The files, the description first.

    Raises:
        StoreError: the disk refuses.
    """
    with writing_to(folder):
        texts = {
            WORKFLOW_FILE: run.record.workflow_source,
            RESOLVED_FILE: run.record.workflow_resolved,
            **{
                environment_file(environment): "".join(
                    f"{name}=={version}\n" for name, version in environment.packages.items()
                )
                for environment in run.record.environments
            },
        }
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8", newline="")
        names = [*texts, *_copy_files(run, folder, record or run)]
        crate = crate_metadata((record or run).record, names, license_text=license_text)
        path = folder / METADATA_FILE
        path.write_text(json.dumps(crate, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return (path, *(folder / name for name in names))


def _copy_files(run: Run, folder: Path, record: Run) -> list[str]:
    """Copy record, report and published files; give their paths in the crate."""
    sources = {RECORD_FILE: record.path}
    report = run.folder / REPORT_FILE
    if report.is_file():
        sources[REPORT_FILE] = report
    metrics = run.products_folder / METRICS_FILE
    published = [file for files in run.files.values() for file in files]
    for file in (*published, *([metrics] if metrics.is_file() else [])):
        sources[f"{PRODUCTS_FOLDER}/{file.relative_to(run.products_folder).as_posix()}"] = file
    for name, source in sources.items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source != target:
            shutil.copyfile(source, target)
    return list(sources)
