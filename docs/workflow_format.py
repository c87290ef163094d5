"""The reference of the workflow format as Markdown, made of its models.

`python docs/workflow_format.py` writes `docs/workflow-format.md`.
"""

from __future__ import annotations

import inspect
import io
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from ruamel.yaml import YAML

from orthoflow.workflow.model import (
    CallSection,
    Comparison,
    DatasetSection,
    InputSection,
    ResourcesSection,
    StepSection,
    SweepSection,
    WorkflowFile,
)

ROOT = Path(__file__).resolve().parents[1]
REFERENCE = ROOT / "docs" / "workflow-format.md"
COMMAND = "python docs/workflow_format.py"

# Headings, in the order of a file, with the section below each.
SECTIONS: dict[str, type[BaseModel]] = {
    "The file": WorkflowFile,
    "`inputs.<name>`: an input": InputSection,
    "`datasets.<name>`: a dataset": DatasetSection,
    "`steps.<name>`: a step": StepSection,
    "`steps.<name>` or `steps.<name>.variants.<name>`: a method call": CallSection,
    "`params.<name>`: a sweep": SweepSection,
    "`resources`": ResourcesSection,
    "`compare`": Comparison,
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

`{COMMAND}` generates this page from `orthoflow/workflow/model.py`.

```yaml
{EXAMPLE}```

`orthoflow check FILE` reports all mistakes at once, each as `file:line:column: path: message`.
Names start with a lower-case letter and consist of at most 32 lower-case letters, digits, `-`
or `_`. Values follow the core schema of YAML 1.2, in which `.5e-1` is a number, but `1_000`,
`0b11` and `yes` are text.
"""


def reference() -> str:
    """The whole document."""
    parts = [HEAD]
    for heading, section in SECTIONS.items():
        parts.append(f"## {heading}\n\n{inspect.cleandoc(section.__doc__ or '')}\n")
        parts.append("\n".join(_table(section)) + "\n")
    return "\n".join(parts)


def all_keys() -> Iterator[tuple[str, type[BaseModel], str, FieldInfo]]:
    """Every key of every section, behind the section's heading."""
    for heading, section in SECTIONS.items():
        for name, info in section.model_fields.items():
            yield f"{heading}: {name}", section, info.alias or name, info


def _table(section: type[BaseModel]) -> Iterator[str]:
    yield "| key | example | meaning |"
    yield "|---|---|---|"
    for name, info in section.model_fields.items():
        if section is StepSection and name in CallSection.model_fields:
            continue  # in the table of the call
        key = info.alias or name
        example = written((info.examples or [""])[0])
        yield f"| `{key}` | `{example}` | {info.description} |"
    if section is DatasetSection:
        yield (
            "| `<input>` | `data/hall/*.jpg` | Files of the input with that name; they must "
            "exist. |"
        )


def written(example: Any) -> str:
    """An example as YAML in one line."""
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style, yaml.width, yaml.sort_base_mapping_type_on_output = True, 1000, False  # type: ignore[assignment]
    stream = io.StringIO()
    yaml.dump(example, stream)
    return stream.getvalue().removesuffix("...\n").strip()


def main() -> int:
    """Write the reference."""
    REFERENCE.write_text(reference(), encoding="utf-8")
    sys.stdout.write(f"wrote {REFERENCE.relative_to(ROOT)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
