"""Make the reference records: small runs of toy methods, which every later version must read.

    python provenance/reference/make.py embedded     # or studio, comparison

The methods are those of tests/workshop. Values that depend on the machine or the time (environment,
times and run ids) are replaced by constants, so that a new record differs only if the format or the
digest of the unreleased code differs.
"""

from __future__ import annotations

import dataclasses
import sys
import tempfile
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]
HERE: Final = Path(__file__).resolve().parent
MINUTE: Final = "2026-01-02T03:04:"


# For each record: its workflow, the settings, and whether the record contains all products and
# inputs.
RECORDS: Final = {
    "studio": ("studio", ("paint.grey=131",), False),
    "comparison": ("comparison", (), False),
    "embedded": ("studio", ("paint.grey=131",), True),
}


def make(name: str) -> Path:
    """Run the workflow of a record, and write the record to the same folder."""
    from orthoflow_provenance.document import RecordedEnvironment
    from orthoflow_provenance.record import write_record

    from orthoflow.catalog.discovery import discover_catalog
    from orthoflow.engine.plan import RunOptions, plan_run
    from orthoflow.engine.scheduler import execute
    from orthoflow.engine.store import Store
    from orthoflow.records.write import build_record
    from orthoflow.workflow.document import load_workflow
    from orthoflow.workflow.expand import expand_cells

    catalog = discover_catalog()
    recipe, sets, embed = RECORDS[name]
    workflow = load_workflow(HERE / f"{recipe}.yaml", catalog, sets=sets)
    environment = RecordedEnvironment(
        id=f"sha256:{'0' * 63}1",
        python="3.11.0",
        os="Linux",
        cpu="reference",
        cores=1,
        threads=1,
        git_commit="",
        packages={"orthoflow-tls": "0.1.0", "workshop": "1.0"},
    )
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder) / "store")
        cells = expand_cells(workflow, catalog)
        plan = plan_run(cells, workflow, catalog, store, RunOptions(executor="inline"))
        outcome = execute(plan, Path(folder) / "run", store, run_id=f"reference-{name}")
        record = build_record(outcome, plan, workflow, store, embed=embed)
        record = dataclasses.replace(
            record,
            started=f"{MINUTE}05.000Z",
            ended=f"{MINUTE}09.000Z",
            environments=(environment,),
            cells=tuple(
                dataclasses.replace(
                    cell,
                    started=f"{MINUTE}06.000Z",
                    ended=f"{MINUTE}07.500Z",
                    wall_s=1.5,
                    cpu_s=1.25,
                    peak_rss_mib=64.0,
                    environment=environment.id,
                    log="",
                )
                if cell.status != "skipped"
                else cell
                for cell in record.cells
            ),
        )
        target = HERE / f"{name}.h5"
        files = {file.sha256: HERE / file.name for item in record.inputs for file in item.files}
        write_record(target, record, store.product_file, embed=embed, input_file=files.get)
    return target


if __name__ == "__main__":
    sys.path[:0] = [str(ROOT / part) for part in ("", "plugins", "provenance", "tests/workshop")]
    for path in map(make, sys.argv[1:]):
        sys.stdout.write(f"{path.name}: {path.stat().st_size} bytes\n")
