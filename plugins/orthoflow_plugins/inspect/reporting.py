"""What an inspection tells of itself: the first wall by plain names, all walls by longer ones."""

from __future__ import annotations

from collections.abc import Sequence

from orthoflow.products import Finding
from orthoflow.sdk import StepContext


def report(findings: Sequence[Finding], main: int, ctx: StepContext) -> None:
    """Report the main wall by plain names, all walls with `all_`, the rest as it is called.

    Args:
        findings: of walls, and of all together (wall -1).
        main: the wall whose numbers bear plain names.
        ctx: where they go.
    """
    per_wall = {finding.name for finding in findings if finding.wall >= 0}
    for finding in findings:
        if finding.wall == main:
            ctx.metric(finding.name, finding.value, finding.unit)
        elif finding.wall < 0 and finding.name in per_wall:
            ctx.metric(f"all_{finding.name}", finding.value, finding.unit)
        elif finding.wall < 0 and "[" not in finding.name:
            ctx.metric(finding.name, finding.value, finding.unit)
