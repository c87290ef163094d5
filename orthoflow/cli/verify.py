"""`orthoflow verify`: check that a record is complete and unchanged."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from orthoflow.cli.commands import EXIT_GOOD, EXIT_RECORD_DIFFERS, Command, echo_error, json_option
from orthoflow.cli.tables import counted, echo, echo_json

if TYPE_CHECKING:
    from orthoflow.records.verify import Verification


@click.command(cls=Command)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.option(
    "--signer",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Public key, in OpenSSH format, of the required signer.",
)
@click.option(
    "--strict",
    is_flag=True,
    help="Also fail for missing or unknown published files, a changed report, or an unchecked "
    "signature.",
)
@json_option
def verify(run: Path, signer: Path | None, *, strict: bool, as_json: bool) -> int:
    """Check that the record of RUN, a run folder or its run.h5, is complete and unchanged.

    Recomputes the seal of the file, the digest of every product and input file in the record, and
    every cache key; checks that redundant entries of the record agree, and that published files,
    report pages, figures and the files and metadata of a crate match it. Missing files, files that
    are not in the record, and a changed report in a run folder are only noted; with --strict they
    are errors. In a crate, a changed report is always an error. Files that cannot be checked, such
    as logs, are listed. With --signer, the record must be signed with that
    key. The exit code is 3 if something differs, or if RUN is not a record or has another version.
    """
    from orthoflow.records.verify import verify_run

    verification = verify_run(run, signer=signer)
    notes = verification.notes
    failing = notes if strict else ()
    findings = (*verification.findings, *(f"{note.code}: {note.text}" for note in failing))
    if as_json:
        echo_json(
            {
                "record": str(verification.path),
                "ok": not findings,
                "products": verification.n_products,
                "inputs": verification.n_inputs,
                "published": verification.n_published,
                "pages": verification.n_pages,
                "others": verification.n_others,
                "seal": verification.seal,
                "signed_with": verification.signed_with,
                "findings": list(findings),
                "not_checked": list(verification.unchecked),
                "notes": [note.text for note in notes if note not in failing],
            }
        )
        return EXIT_RECORD_DIFFERS if findings else EXIT_GOOD
    for note in notes:
        if note not in failing:
            echo(f"note: {note.text}")
    if verification.unchecked:
        echo(f"not checked: {', '.join(verification.unchecked)}")
    if verification.seal:
        echo(f"seal: sha256:{verification.seal}")
    if not findings:
        echo(_summary(verification))
    else:
        for finding in findings:
            echo(finding)
        beside = (
            f"the seal of {verification.path} is intact, but files next to it have been changed"
        )
        echo_error(f"error: {verification.wrong or beside} (see above)")
    return EXIT_RECORD_DIFFERS if findings else EXIT_GOOD


def _summary(verification: Verification) -> str:
    signed = f", signed with {verification.signed_with}" if verification.signed_with else ""
    return (
        f"verified: seal ok, {counted(verification.n_products, 'product')} "
        f"({verification.n_named} more by digest only), "
        f"{counted(verification.n_inputs, 'input file')}, "
        f"{counted(verification.n_published, 'published file')}, "
        f"{counted(verification.n_pages, 'report page')}, "
        f"{counted(verification.n_others, 'other file')} unchanged{signed}"
    )
