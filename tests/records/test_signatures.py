"""Signatures of records: the signer is recognised, and a change is detected."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
)

from orthoflow.cli import sign
from tests import hostile_records as hostile
from tests.studios import Studio, open_studio, said

PASSWORD = "correct horse"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """A run, and keys of two people."""
    with pytest.MonkeyPatch.context() as patch:
        studio = open_studio(tmp_path_factory.mktemp("signatures"), patch)
        studio.run("first")
        jane = Ed25519PrivateKey.generate()
        keys = {"jane": jane, "jane-protected": jane, "joe": Ed25519PrivateKey.generate()}
        for name, key in {**keys, "other": ec.generate_private_key(ec.SECP256R1())}.items():
            is_open = name != "jane-protected"
            protection = NoEncryption() if is_open else BestAvailableEncryption(PASSWORD.encode())
            content = key.private_bytes(Encoding.PEM, PrivateFormat.OpenSSH, protection)
            (studio.folder / name).write_bytes(content)
            public = key.public_key().public_bytes(Encoding.OpenSSH, PublicFormat.OpenSSH)
            (studio.folder / f"{name}.pub").write_bytes(public + b" jane@example.org\n")
        yield studio


@pytest.fixture
def run(finished: Studio, tmp_path: Path) -> Path:
    shutil.copytree(finished.folder / "first", tmp_path / "run")
    return tmp_path / "run"


def verified(finished: Studio, run: Path, code: int) -> str:
    """Verify a run with the key of Jane."""
    return finished("verify", run, "--signer", "jane.pub", code=code).output


def test_a_signed_record_verifies_with_the_key_of_its_signer_and_no_other(
    finished: Studio, run: Path, tmp_path: Path
) -> None:
    before = (run / "run.h5").read_bytes()
    output = verified(finished, run, 3)
    assert "run.h5 is not signed: there is no run.h5.sig next to it" in output
    assert "run.h5 is intact, but its signature is not from the given signer" in output
    for _ in range(2):  # signed again with the same key it stays signed
        assert f"signed: {run / 'run.h5'}.sig, with the key SHA256:" in said(
            "sign", run, "--key", "jane"
        )
        output = verified(finished, run, 0)
    assert (run / "run.h5").read_bytes() == before
    assert "was not checked" not in output
    verdict = finished.json("verify", run, "--signer", "jane.pub")
    assert verdict["signed_with"] == output.rpartition("signed with ")[2].strip()
    # A crate takes the signature along; another record has another seal.
    assert finished("export", run, "--to", "ro-crate", "-o", tmp_path / "crate").exit_code == 0
    verified(finished, tmp_path / "crate", 0)
    whole = tmp_path / "all"
    assert finished("export", run, "--to", "ro-crate", "--embed", "-o", whole).exit_code == 0
    assert not (whole / "run.h5.sig").exists()
    # A record is signed by one person.
    signature = (run / "run.h5.sig").read_text()
    assert ": remove run.h5.sig to sign it with another key" in said(
        "sign", run, "--key", "joe", code=2
    )
    assert (run / "run.h5.sig").read_text() == signature
    (run / "run.h5.sig").unlink()
    assert finished("sign", run, "--key", "joe").exit_code == 0
    # Nobody has checked that it is joe's: it may be what is left of another record.
    output = verified(finished, run, 3)
    assert "the signature of run.h5 was made with the key SHA256:" in output
    assert ", not with SHA256:" in output
    # Who says to be jane has not her key.
    forged = json.loads((run / "run.h5.sig").read_text())
    forged["public_key"] = json.loads(signature)["public_key"]
    (run / "run.h5.sig").write_text(json.dumps(forged))
    assert "the signature does not match run.h5" in verified(finished, run, 3)


def test_the_password_of_a_key_is_asked_for(
    finished: Studio, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = "jane-protected"
    monkeypatch.setattr("orthoflow.cli.sign.ask_passphrase", lambda _: "wrong")
    assert "or the password is wrong" in said("sign", run, "--key", key, code=2)
    monkeypatch.undo()
    monkeypatch.chdir(finished.folder)
    # On a terminal, out of sight, and where messages go: stdout may be a file.
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True))
    asked: list[dict[str, bool]] = []
    monkeypatch.setattr("click.prompt", lambda _, **how: (asked.append(how), PASSWORD)[1])
    assert sign.ask_passphrase(Path(key)) == PASSWORD
    assert asked == [{"hide_input": True, "err": True}]
    monkeypatch.setattr("orthoflow.cli.sign.ask_passphrase", lambda _: PASSWORD)
    assert finished("sign", run, "--key", key).exit_code == 0
    verified(finished, run, 0)


def test_without_the_library_the_commands_say_so_and_others_do_without(
    finished: Studio, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finished("sign", run, "--key", "jane")
    monkeypatch.setitem(sys.modules, "cryptography.exceptions", None)
    for command in (("sign", run, "--key", "jane"), ("verify", run, "--signer", "jane.pub")):
        assert "python -m pip install 'orthoflow-tls[sign]'" in said(*command, code=4)
    assert "there is a signature" in said("verify", run)


def test_a_signature_of_something_else_does_not_fit(finished: Studio, run: Path) -> None:
    finished("sign", run, "--key", "jane")
    hostile.reseal(run / "run.h5", lambda record: record.cell("paint").update(log="nothing wrong"))
    assert finished("verify", run).exit_code == 0
    assert "does not match run.h5: it belongs to another record" in verified(finished, run, 3)
    path = run / "run.h5.sig"
    for content in ("[" * 60_000, '{"format": "orthoflow-signature"}', "link"):
        path.unlink()
        if content == "link":
            path.symlink_to("/dev/zero")
        else:
            path.write_text(content)
        # A finding only where a signature is asked for.
        assert "note: run.h5.sig is not a signature, or is damaged" in said("verify", run)
        assert "\nrun.h5.sig is not a signature, or is damaged" in verified(finished, run, 3)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("sign", "--key", "nothing"), "there is no key file nothing"),
        (("sign", "--key", "jane.pub"), "jane.pub is not a private key in OpenSSH format"),
        (("sign", "--key", "other"), "other must be an Ed25519 key; create one with `ssh-keygen"),
        (("sign", "--key", "jane-protected"), "has a passphrase, but there is no term"),
        (("verify", "--signer", "jane"), "jane is not a public key in OpenSSH format"),
        (("verify", "--signer", "other.pub"), "other.pub must be an Ed25519 key"),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value),
)
def test_keys_that_cannot_be_used_are_refused(
    finished: Studio, run: Path, arguments: tuple[str, ...], sentence: str
) -> None:
    done = finished(arguments[0], run, *arguments[1:])
    assert (done.exit_code, done.output.count("\n")) == (2, 1), done.output
    assert done.output.startswith("error: ")
    assert sentence in done.output
    assert not (run / "run.h5.sig").exists()


def test_only_a_run_that_verifies_is_signed(finished: Studio, run: Path) -> None:
    (run / "products" / "metrics.csv").write_text("changed")
    assert "so it is not signed: products/metrics.csv: changed" in said(
        "sign", run, "--key", "jane", code=3
    )
    assert not (run / "run.h5.sig").exists()
