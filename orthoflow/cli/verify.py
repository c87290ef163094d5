"""`orthoflow verify`: check that a record is whole and unchanged."""

from __future__ import annotations

from pathlib import Path

import click

from orthoflow.cli.failures import EXIT_GOOD, EXIT_RECORD_DIFFERS, say_error
from orthoflow.cli.options import Command, json_option
from orthoflow.cli.tables import counted, echo_json


@click.command(cls=Command)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@json_option
def verify(run: Path, *, as_json: bool) -> int:
    """Check that the record of RUN, a run folder or its run.h5, is whole and unchanged.

    Recomputes the seal, the digest of every product in the record, every cache key and the
    digest of the workflow. Ends with 3 when something differs.
    """
    from orthoflow.records import verify_run

    verification = verify_run(run)
    findings = verification.findings
    if as_json:
        echo_json(
            {
                "record": str(verification.path),
                "ok": not findings,
                "products": verification.n_products,
                "findings": list(findings),
            }
        )
    elif not findings:
        click.echo(f"verified: {counted(verification.n_products, 'product')}, seal ok")
    else:
        for finding in findings:
            click.echo(finding)
        say_error(f"error: {verification.path} is not as it was written, see above")
    return EXIT_RECORD_DIFFERS if findings else EXIT_GOOD
