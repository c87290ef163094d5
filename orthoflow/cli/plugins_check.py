"""`orthoflow plugins check`: run the conformance suite on one installed method."""

from __future__ import annotations

from pathlib import Path

import click

from orthoflow.cli.failures import EXIT_CELL_FAILED, EXIT_GOOD
from orthoflow.cli.options import Command, json_option
from orthoflow.cli.tables import counted, echo_json


@click.command("check", cls=Command)
@click.argument("method_id", metavar="ID")
@click.option(
    "--golden",
    type=click.Path(path_type=Path, dir_okay=False),
    help="File of golden digests; a method that it lacks is added.",
)
@json_option
def plugins_check(method_id: str, *, as_json: bool, golden: Path | None) -> int:
    """Run every conformance check that applies to the method ID, and say which rules it breaks.

    Ends with 1 when a rule is broken, with 4 when the method cannot be loaded.
    """
    from orthoflow.testing import conformance_cases

    results: list[dict[str, str]] = []
    for case in conformance_cases(method_id, golden=golden):
        problem = case.problem()
        state = "broken" if problem else "kept"
        results.append(
            {"check": case.check.name, "state": state, "rule": case.check.rule, "problem": problem}
        )
        if not as_json:
            click.echo(f"{state:7} {case.check.name}: {problem or case.check.rule}")
    n_broken = sum(result["state"] == "broken" for result in results)
    if as_json:
        echo_json({"method": method_id, "checks": results})
    else:
        kept = f"{method_id} keeps {counted(len(results) - n_broken, 'rule')}"
        click.echo(f"\n{kept}, breaks {n_broken}" if n_broken else f"\n{kept}")
    return EXIT_CELL_FAILED if n_broken else EXIT_GOOD
