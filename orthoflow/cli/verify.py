"""`orthoflow verify`: check that a record is whole and unchanged."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from orthoflow.cli.commands import Command
from orthoflow.cli.failures import EXIT_GOOD, EXIT_RECORD_DIFFERS, say_error
from orthoflow.cli.options import json_option
from orthoflow.cli.tables import counted, echo, echo_json

if TYPE_CHECKING:
    from orthoflow.records.verification import Verification


@click.command(cls=Command)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.option(
    "--signer",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="The public key, OpenSSH or PEM, that the record must be signed with.",
)
@json_option
def verify(run: Path, signer: Path | None, *, as_json: bool) -> int:
    """Check that the record of RUN, a run folder or its run.h5, is whole and unchanged.

    Recomputes the seal, the digest of every product and input file in the record, every cache
    key and the digest of the workflow, and compares the published files beside the record with
    theirs; one that is not there is noted. The report and its figures are not covered: `orthoflow
    report` makes them anew from the record; nor is what else lies in the folder, logs and the
    description of a crate, say. With --signer the record must be signed with that key.
    Ends with 3 when something differs, or RUN is no record or of a newer orthoflow.
    """
    from orthoflow.records.verification import verify_run

    verification = verify_run(run, signer=signer)
    findings = verification.findings
    if as_json:
        echo_json(
            {
                "record": str(verification.path),
                "ok": not findings,
                "products": verification.n_products,
                "inputs": verification.n_inputs,
                "published": verification.n_published,
                "seal": verification.seal,
                "signed_with": verification.signed_with,
                "findings": list(findings),
                "notes": list(verification.notes),
            }
        )
        return EXIT_RECORD_DIFFERS if findings else EXIT_GOOD
    for note in verification.notes:
        echo(f"note: {note}")
    if verification.seal:
        echo(f"seal: sha256:{verification.seal}")
    if not findings:
        echo(_summary(verification))
    else:
        for finding in findings:
            echo(finding)
        say_error(f"error: {verification.wrong}, see above")
    return EXIT_RECORD_DIFFERS if findings else EXIT_GOOD


def _summary(verification: Verification) -> str:
    parts = [counted(verification.n_products, "product")]
    if verification.n_named:
        parts[0] += f" ({verification.n_named} more by digest only)"
    if verification.n_inputs:
        parts.append(counted(verification.n_inputs, "input file"))
    parts.append("seal ok")
    if verification.n_published:
        parts.append(f"{counted(verification.n_published, 'published file')} unchanged")
    if verification.signed_with:
        parts.append(f"signed with {verification.signed_with}")
    return f"verified: {', '.join(parts)}"
