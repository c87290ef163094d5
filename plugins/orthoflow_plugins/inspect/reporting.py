"""What an inspection tells of itself: the first wall by plain names, the others by longer ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from orthoflow.products import Finding
from orthoflow.sdk import StepContext

# What a comparison asks of every wall; the record has the rest.
_OF_EACH_WALL: Final = ("rmse_u_mm", "rmse_v_mm", "completeness")


def report(findings: Sequence[Finding], main: int, ctx: StepContext) -> None:
    """Report the main wall by plain names, all walls with `all_`, the rest as it is called.

    Displacements and completeness of the other walls are reported too, with `wall_1_` and so on.

    Args:
        findings: of walls, and of all together (wall -1).
        main: the wall whose numbers bear plain names.
        ctx: where they go.
    """
    per_wall = {finding.name for finding in findings if finding.wall >= 0}
    for finding in findings:
        if finding.wall == main:
            ctx.metric(finding.name, finding.value, finding.unit)
        elif finding.wall >= 0 and finding.name in _OF_EACH_WALL:
            ctx.metric(f"wall_{finding.wall}_{finding.name}", finding.value, finding.unit)
        elif finding.wall < 0 and finding.name in per_wall:
            ctx.metric(f"all_{finding.name}", finding.value, finding.unit)
        elif finding.wall < 0 and "[" not in finding.name:
            ctx.metric(finding.name, finding.value, finding.unit)
