"""Signatures: who vouches for a record, in a file beside it and outside its seal."""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from orthoflow_provenance.document import UnsafeFileError, canonical_json
from orthoflow_provenance.paths import open_below
from orthoflow_provenance.record import open_record

from orthoflow.errors import ArgumentError, InputError, PluginError, RecordError
from orthoflow.records.run_files import creating
from orthoflow.records.runs import find_record, record_errors

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import (
        Ed25519PrivateKey,
        Ed25519PublicKey,
    )

SIGNATURE_SUFFIX: Final = ".sig"
_FORMAT: Final = "orthoflow-signature"
_VERSION: Final = "1.0"
# Keys and signatures are a few hundred bytes.
_LARGEST_BYTES: Final = 64 << 10


@dataclass(frozen=True, kw_only=True)
class Signature:
    """What a signature file says; nothing of it is true before it was checked.

    Attributes:
        content_sha256: content digest of the record that was signed.
        public_key: of the signer, as OpenSSH writes it: `ssh-ed25519 ...`.
        signature: 64 bytes.
    """

    content_sha256: str
    public_key: str
    signature: bytes

    @property
    def fingerprint(self) -> str:
        """Name of the key, as `ssh-keygen -l` gives it."""
        return _fingerprint(self.public_key)


def sign_record(path: Path, key_file: Path, password: Callable[[], str]) -> Signature:
    """Sign the seal of a record that was verified, into a file beside it.

    Args:
        path: the record file.
        key_file: private Ed25519 key, OpenSSH or PEM.
        password: asked for when the key is protected.

    Raises:
        InputError: the file is no such key, or the password does not open it.
        ArgumentError: a signature of another key lies beside the record.
        RecordError: the record is damaged.
        StoreError: the disk refuses.
        PluginError: the library cryptography is missing.
    """
    key = _private_key(key_file, password)
    earlier = read_signature(path)
    public_key = _openssh(key.public_key())
    if earlier is not None and earlier.public_key != public_key:
        raise ArgumentError(
            f"beside {path} there is a signature already, said to be of the key "
            f"{earlier.fingerprint}: remove {path.name}{SIGNATURE_SUFFIX} to sign with another"
        )
    content_sha256 = _content_sha256(path)
    made = Signature(
        content_sha256=content_sha256,
        public_key=public_key,
        signature=key.sign(_message(content_sha256)),
    )
    content = {
        "format": _FORMAT,
        "format_version": _VERSION,
        "content_sha256": made.content_sha256,
        "public_key": made.public_key,
        "signature": base64.b64encode(made.signature).decode("ascii"),
    }
    with creating(path.parent, f"{path.name}{SIGNATURE_SUFFIX}") as stream:
        stream.write(f"{json.dumps(content, indent=1)}\n".encode())
    return made


def read_signature(record: Path) -> Signature | None:
    """Read the signature beside a record, unchecked; None when there is none.

    Raises:
        RecordError: what stands there is no signature.
    """
    name = f"{record.name}{SIGNATURE_SUFFIX}"
    if not os.path.lexists(record.with_name(name)):
        return None
    try:
        with open_below(record.parent, name) as stream:
            return _parsed(stream.read(_LARGEST_BYTES))
    except (UnsafeFileError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise RecordError(f"{name} is no signature, or damaged: {error}") from error


def check_signature(record: Path, signer: Path) -> Signature:
    """Give the signature of a record that was verified, if it is that of a signer.

    Args:
        record: the record file.
        signer: the public Ed25519 key that it must be signed with, OpenSSH or PEM.

    Raises:
        RecordError: it is missing, another's, or does not fit the record.
        InputError: the file is no such key.
        PluginError: the library cryptography is missing.
    """
    key = _public_key(signer)
    found = read_signature(record)
    if found is None:
        raise RecordError(
            f"{record.name} is not signed: there is no {record.name}{SIGNATURE_SUFFIX} beside it"
        )
    wanted = _openssh(key)
    if found.public_key != wanted:
        raise RecordError(
            f"the signature beside {record.name} is said to be of the key {found.fingerprint}, "
            f"not of {_fingerprint(wanted)} in {signer}"
        )
    from cryptography.exceptions import InvalidSignature  # noqa: PLC0415 - only those who sign

    try:
        key.verify(found.signature, _message(_content_sha256(record)))
    except InvalidSignature as error:
        raise RecordError(
            f"the signature beside {record.name} does not fit it: it is another record's, or "
            "was changed"
        ) from error
    return found


def _parsed(text: bytes) -> Signature:
    content = json.loads(text)
    form, version = content["format"], content["format_version"]
    if form != _FORMAT or str(version).partition(".")[0] != _VERSION.partition(".")[0]:
        raise ValueError(f"this orthoflow reads {_FORMAT} {_VERSION}, got {form} {version}")
    return Signature(
        content_sha256=str(content["content_sha256"]),
        public_key=str(content["public_key"]),
        signature=base64.b64decode(content["signature"], validate=True),
    )


def _message(content_sha256: str) -> bytes:
    text = canonical_json({"what": "orthoflow/signature", "v": 1, "content_sha256": content_sha256})
    return text.encode("utf-8")


def _content_sha256(record: Path) -> str:
    path = find_record(record)
    with record_errors(path), open_record(path) as opened:
        return opened.content_sha256


def _fingerprint(public_key: str) -> str:
    try:
        blob = base64.b64decode(public_key.split()[1], validate=True)
    except (IndexError, binascii.Error):
        return "of no known form"
    return f"SHA256:{base64.b64encode(hashlib.sha256(blob).digest()).decode('ascii').rstrip('=')}"


def _openssh(key: Ed25519PublicKey) -> str:
    from cryptography.hazmat.primitives.serialization import (  # noqa: PLC0415 - as above
        Encoding,
        PublicFormat,
    )

    return key.public_bytes(Encoding.OpenSSH, PublicFormat.OpenSSH).decode("ascii")


def _private_key(path: Path, password: Callable[[], str]) -> Ed25519PrivateKey:
    _need_library()
    from cryptography.exceptions import UnsupportedAlgorithm  # noqa: PLC0415 - as above
    from cryptography.hazmat.primitives.asymmetric import ed25519  # noqa: PLC0415
    from cryptography.hazmat.primitives.serialization import (  # noqa: PLC0415
        load_pem_private_key,
        load_ssh_private_key,
    )

    data = _key_bytes(path)
    if data.startswith((b"ssh-", b"-----BEGIN PUBLIC")):
        raise InputError(
            f"{path} is the public half of a key, by which others check: sign with the private one"
            f", {path.with_suffix('')}"
        )
    load = load_ssh_private_key if b"OPENSSH PRIVATE KEY" in data else load_pem_private_key
    try:
        try:
            key = load(data, password=None)
        except TypeError:
            # Protected; an empty password would be taken for none.
            key = load(data, password=password().encode("utf-8") or b"\0")
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise InputError(
            f"{path} is no private key in OpenSSH or PEM format, or the password is another one: "
            f"{error}"
        ) from error
    if not isinstance(key, ed25519.Ed25519PrivateKey):
        raise InputError(f"{path} must be an Ed25519 key; `ssh-keygen -t ed25519` makes one")
    return key


def _public_key(path: Path) -> Ed25519PublicKey:
    _need_library()
    from cryptography.exceptions import UnsupportedAlgorithm  # noqa: PLC0415 - as above
    from cryptography.hazmat.primitives.asymmetric import ed25519  # noqa: PLC0415
    from cryptography.hazmat.primitives.serialization import (  # noqa: PLC0415
        load_pem_public_key,
        load_ssh_public_key,
    )

    data = _key_bytes(path)
    load = load_pem_public_key if data.lstrip().startswith(b"-----") else load_ssh_public_key
    try:
        key = load(data)
    except (ValueError, UnsupportedAlgorithm) as error:
        raise InputError(
            f"{path} is no public key in OpenSSH or PEM format: {error}; the signer's file ends "
            "with .pub"
        ) from error
    if not isinstance(key, ed25519.Ed25519PublicKey):
        raise InputError(f"{path} must be an Ed25519 key, as records are signed with these")
    return key


def _key_bytes(path: Path) -> bytes:
    try:
        if not path.is_file():
            raise InputError(f"there is no key file {path}")
        with path.open("rb") as stream:
            return stream.read(_LARGEST_BYTES)
    except OSError as error:
        raise InputError(f"the key file {path} cannot be read: {error.strerror}") from error


def _need_library() -> None:
    try:
        import cryptography  # noqa: F401, PLC0415 - asked for before anything is read
    except ImportError as error:
        raise PluginError(
            "signatures need the library cryptography, which is missing or fails to import: "
            "python -m pip install 'orthoflow-tls[sign]'"
        ) from error
