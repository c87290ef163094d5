"""The reference of the workflow format as Markdown, made of its declaration.

`python tests/workflow_format.py` writes `docs/workflow-format.md`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from orthoflow.workflow.format import (
    CALL,
    COMPARISON,
    DATASET,
    FILE,
    INPUT,
    SHARE,
    STEP,
    SWEPT,
)
from orthoflow.workflow.shapes import Key, Section

ROOT = Path(__file__).resolve().parents[1]
REFERENCE = ROOT / "docs" / "workflow-format.md"
COMMAND = "python tests/workflow_format.py"

# Headings, in the order of a file, with the section below each.
SECTIONS: dict[str, Section] = {
    "The file": FILE,
    "`inputs.<name>`: an input": INPUT,
    "`datasets.<name>`: a dataset": DATASET,
    "`steps.<name>`: a step": STEP,
    "`steps.<name>.variants.<name>`: a method call": CALL,
    "`params.<name>`: a sweep": SWEPT,
    "`resources`": SHARE,
    "`compare`": COMPARISON,
}

EXAMPLE = """\
orthoflow: 1
name: palace-room
seed: 1729
inputs:
  scan: {files: data/room.e57}
  checkpoints: {files: data/checkpoints.csv, optional: true}
steps:
  cloud: {use: read.scan, in: {files: inputs.scan}}
  plane:
    in: {cloud: cloud.cloud}
    variants:
      hough2d: {use: plane.hough2d, params: {cell_m: 0.02}}
      ransac: {use: plane.ransac, repeat: 10, timeout: 30min}
  wall: {use: raster.grid, in: {cloud: cloud.cloud, planes: plane.planes}, params: {gsd_m: 0.003}}
compare:
  baseline: {plane: hough2d}
  metrics: [plane.rms_mm, "*.wall_s"]
"""

HEAD = f"""\
# The workflow file

Every key that a workflow file may hold. Made of `orthoflow/workflow/format.py` by
`{COMMAND}`; the checks and `orthoflow schema` are made of the same declaration.

```yaml
{EXAMPLE}```

`orthoflow check FILE` names everything that is wrong in one pass, each as
`file:line:column: path: message`.
Names start with a lower-case letter and have at most 32 lower-case letters, digits, `-` or `_`.
"""


def reference() -> str:
    """The whole document."""
    parts = [HEAD]
    for heading, section in SECTIONS.items():
        parts.append(f"## {heading}\n\n{section.about}\n")
        parts.append("\n".join(_table(section)) + "\n")
    return "\n".join(parts)


def keys() -> Iterator[tuple[str, Key[Any]]]:
    """Every key of every section, behind the section's heading."""
    for heading, section in SECTIONS.items():
        for key in _all_keys(section):
            yield f"{heading}: {key.name}", key


def _table(section: Section) -> Iterator[str]:
    yield "| key | value | example | without it | meaning |"
    yield "|---|---|---|---|---|"
    for key in _all_keys(section):
        without = "refused" if key.missing else key.default
        cells = (f"`{key.name}`", key.shape.words, f"`{key.example}`", without, key.meaning)
        yield f"| {' | '.join(cells)} |"


def _all_keys(section: Section) -> tuple[Key[Any], ...]:
    return (*section.keys, *((section.others,) if section.others else ()))


def main() -> int:
    """Write the reference."""
    REFERENCE.write_text(reference(), encoding="utf-8")
    sys.stdout.write(f"wrote {REFERENCE.relative_to(ROOT)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
