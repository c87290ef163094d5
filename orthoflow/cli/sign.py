"""`orthoflow sign`: sign the seal of a record."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from orthoflow.cli.commands import EXIT_GOOD, Command
from orthoflow.cli.tables import echo
from orthoflow.errors import ArgumentError, RecordError
from orthoflow.untrusted_text import shown


@click.command(cls=Command)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.option(
    "--key",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Your private Ed25519 key in OpenSSH format; you are prompted for its passphrase.",
)
def sign(run: Path, key: Path) -> int:
    """Sign the record of RUN, a run folder or its run.h5, with your key.

    The signature is written to run.h5.sig next to the record, which is not changed. Only a record
    that passes verification is signed. `orthoflow verify RUN --signer FILE` checks the signature
    with your public key.
    """
    from orthoflow.records.seals import SIGNATURE_SUFFIX
    from orthoflow.records.verify import sign_record, verify_run

    verification = verify_run(run)
    if verification.findings:
        raise RecordError(f"{verification.wrong}, so it is not signed: {verification.findings[0]}")
    path = verification.path
    made = sign_record(path, key, lambda: ask_passphrase(key))
    echo(f"signed: {path}{SIGNATURE_SUFFIX}, with the key {made.fingerprint}")
    return EXIT_GOOD


def ask_passphrase(key: Path) -> str:
    """Prompt for the passphrase of a private key on the terminal.

    Raises:
        ArgumentError: there is no terminal.
    """
    if not sys.stdin.isatty():
        raise ArgumentError(
            f"the key {key} has a passphrase, but there is no terminal to prompt for it: "
            "sign on a terminal, or with another key"
        )
    return click.prompt(shown(f"passphrase of {key}"), hide_input=True, err=True)
