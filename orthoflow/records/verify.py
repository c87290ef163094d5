"""Verification of a record and its files, and signatures of records."""

from __future__ import annotations

import base64
import binascii
import hashlib
import os
import re
import shlex
from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from orthoflow_provenance.document import (
    PublishedFile,
    RecordedCell,
    RecordedFigure,
    RunRecord,
    UnsafeFileError,
    canonical_json,
    shared_fields,
)
from orthoflow_provenance.paths import files_below, open_below
from orthoflow_provenance.record import OpenRecord, open_record
from orthoflow_provenance.verify import verify_record
from pydantic import BaseModel, ValidationError

from orthoflow.engine.journal import RECORD_FILE
from orthoflow.errors import ArgumentError, InputError, PluginError, RecordError
from orthoflow.files.images import decode_image
from orthoflow.geometry.threads import in_order
from orthoflow.products import Inspection
from orthoflow.products.product import Payload
from orthoflow.records.runs import (
    FIGURES_FOLDER,
    LARGEST_PAGE_BYTES,
    METADATA_FILE,
    PAGES_FOLDER,
    PRODUCTS_FOLDER,
    REPORT_FILE,
    PublishedState,
    Run,
    crate_texts,
    creating,
    figure_files,
    find_record,
    published_state,
    read_run,
    record_errors,
)
from orthoflow.records.seals import PAGE_MARK, SIGNATURE_SUFFIX
from orthoflow.untrusted_text import first_few, parse_json
from orthoflow.version import __version__

# The files of keys and signatures contain only a few hundred bytes.
_LARGEST_BYTES: Final = 64 << 10
_LARGEST_METADATA: Final = 1 << 28


class Signature(BaseModel):
    """The content of a signature file, which must not be trusted before it is checked.

    Attributes:
        content_sha256: content digest of the signed record.
        public_key: key of the signer in OpenSSH format: `ssh-ed25519 ...`.
        signature: 64 bytes in base64.
    """

    format: Literal["orthoflow-signature"] = "orthoflow-signature"
    format_version: Literal["1.0"] = "1.0"
    content_sha256: str
    public_key: str
    signature: str

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the key, in the format of `ssh-keygen -l`."""
        return _fingerprint(self.public_key)


def sign_record(path: Path, key_file: Path, password: Callable[[], str]) -> Signature:
    """Sign the seal of a record that was verified, and write the signature next to the record.

    Args:
        path: the record file.
        key_file: private Ed25519 key in OpenSSH format.
        password: called if the key is protected by a password.

    Raises:
        InputError: `key_file` is not such a key, or the password is wrong.
        ArgumentError: the record already has a signature made with another key.
        RecordError: the record is damaged.
        StoreError: the disk cannot be written to.
        PluginError: the library cryptography is not installed.
    """
    key = _read_key(key_file, password)
    earlier = read_signature(path)
    public_key = _openssh(key.public_key())
    if earlier is not None and earlier.public_key != public_key:
        raise ArgumentError(
            f"{path} is already signed with the key {earlier.fingerprint}: remove "
            f"{path.name}{SIGNATURE_SUFFIX} to sign it with another key"
        )
    content_sha256 = read_run(path).content_sha256
    signature = base64.b64encode(key.sign(_message(content_sha256))).decode("ascii")
    made = Signature(content_sha256=content_sha256, public_key=public_key, signature=signature)
    with creating(path.parent, f"{path.name}{SIGNATURE_SUFFIX}") as stream:
        stream.write(made.model_dump_json(indent=1).encode() + b"\n")
    return made


def read_signature(record: Path) -> Signature | None:
    """Read the signature of a record without checking it; return None if there is none.

    Raises:
        RecordError: the signature file is invalid.
    """
    name = f"{record.name}{SIGNATURE_SUFFIX}"
    if not os.path.lexists(record.with_name(name)):
        return None
    try:
        with open_below(record.parent, name) as stream:
            return Signature.model_validate_json(stream.read(_LARGEST_BYTES), strict=True)
    except (UnsafeFileError, OSError, ValidationError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise RecordError(f"{name} is not a signature, or is damaged: {reason}") from error


def check_signature(record: Path, signer: Path) -> Signature:
    """Check the signature of a record whose seal was verified, and return it.

    Args:
        record: the record file.
        signer: file with the public Ed25519 key of the signer, in OpenSSH format.

    Raises:
        RecordError: the signature is missing, was made with another key, or does not match the
            record.
        InputError: `signer` is not such a key.
        PluginError: the library cryptography is not installed.
    """
    key = _read_key(signer)
    found = read_signature(record)
    if found is None:
        raise RecordError(
            f"{record.name} is not signed: there is no {record.name}{SIGNATURE_SUFFIX} next to it"
        )
    wanted = _openssh(key)
    if found.public_key != wanted:
        raise RecordError(
            f"the signature of {record.name} was made with the key {found.fingerprint}, "
            f"not with {_fingerprint(wanted)} in {signer}"
        )
    from cryptography.exceptions import InvalidSignature  # noqa: PLC0415 - only those who sign

    try:
        message = _message(read_run(record).content_sha256)
        key.verify(base64.b64decode(found.signature, validate=True), message)
    except (InvalidSignature, binascii.Error) as error:
        raise RecordError(
            f"the signature does not match {record.name}: it belongs to another record, or one of "
            "the two files has been changed"
        ) from error
    return found


def _message(content_sha256: str) -> bytes:
    text = canonical_json({"what": "orthoflow/signature", "v": 1, "content_sha256": content_sha256})
    return text.encode("utf-8")


def _fingerprint(public_key: str) -> str:
    try:
        blob = base64.b64decode(public_key.split()[1], validate=True)
    except (IndexError, binascii.Error):
        return "of unknown format"
    return f"SHA256:{base64.b64encode(hashlib.sha256(blob).digest()).decode('ascii').rstrip('=')}"


def _openssh(key: Any) -> str:
    from cryptography.hazmat.primitives import serialization  # noqa: PLC0415 - optional

    encoding, form = serialization.Encoding.OpenSSH, serialization.PublicFormat.OpenSSH
    return str(key.public_bytes(encoding, form), "ascii")


# The type is `Any` because cryptography is an optional library.
def _read_key(path: Path, password: Callable[[], str] | None = None) -> Any:
    """Read an Ed25519 key in OpenSSH format; the key is private if `password` is given."""
    try:
        from cryptography.exceptions import UnsupportedAlgorithm  # noqa: PLC0415 - optional
        from cryptography.hazmat.primitives import serialization  # noqa: PLC0415
        from cryptography.hazmat.primitives.asymmetric import ed25519  # noqa: PLC0415
    except ImportError as error:
        raise PluginError(
            "signatures need the library cryptography, which is missing or fails to import: "
            "python -m pip install 'orthoflow-tls[sign]'"
        ) from error
    if not path.is_file():
        raise InputError(f"there is no key file {path}")
    kind, hint = ("public", "") if password is None else ("private", " or the password is wrong")
    wanted = (ed25519.Ed25519PublicKey, ed25519.Ed25519PrivateKey)[password is not None]
    key: object
    try:
        with path.open("rb") as stream:
            data = stream.read(_LARGEST_BYTES)
        if password is None:
            key = serialization.load_ssh_public_key(data)
        else:
            try:
                key = serialization.load_ssh_private_key(data, None)
            except TypeError:
                # The key is protected by a password; an empty password would be treated as none.
                secret = password().encode("utf-8") or b"\0"
                key = serialization.load_ssh_private_key(data, secret)
    except (OSError, ValueError, TypeError, UnsupportedAlgorithm) as error:
        what = f"{path} is not a {kind} key in OpenSSH format,{hint}: {error}"
        raise InputError(what) from error
    if not isinstance(key, wanted):
        raise InputError(f"{path} must be an Ed25519 key; create one with `ssh-keygen -t ed25519`")
    return key


# These kinds of contradictions within a record may already have existed when it was written.
_OWN_FAULTS: Final = frozenset({"field", "name", "key", "reference"})
# This prefix precedes the name of a finding in metrics that repeat the findings of an inspection.
_OF_WALLS: Final = re.compile(r"(all|(wall|floor|ceiling)_\d+)_")
_WRONG: Final[dict[PublishedState, str]] = {
    "changed": "changed since it was published",
    "no file": "a link, a folder or a device in place of the published file, or it is unreadable",
}


@dataclass(frozen=True, kw_only=True)
class Note:
    """A remark about files next to a record, which does not make the record invalid.

    Attributes:
        code: `missing` for missing published files, `foreign` for files that the record does not
            list, `page` for a page that was changed or shows another record, or `signature` for a
            signature that was not checked.
        text: one sentence.
    """

    code: Literal["missing", "foreign", "page", "signature"]
    text: str


@dataclass(frozen=True, kw_only=True)
class Verification:
    """The result of checking a record.

    Attributes:
        path: the record file.
        findings: one sentence per difference; empty if nothing was changed.
        wrong: one sentence that summarises the findings; empty if there are none.
        notes: files that could not be checked or do not belong to the record.
        seal: digest that seals the record, as 64 hexadecimal digits, which is also printed on
            sheets; empty if the record itself was changed.
        n_named: number of products that the record references only by digest.
        n_products: number of products in the record whose digest was checked.
        n_inputs: number of input files in the record whose digest was checked.
        n_published: number of unchanged published files.
        n_pages: number of unchanged report pages of this record.
        n_others: number of unchanged figures and of unchanged other files of a crate.
        unchecked: description of the files in the folder that cannot be checked.
        signed_with: fingerprint of the signer's key; empty unless the check was requested and the
            signature is valid.
    """

    path: Path
    findings: tuple[str, ...]
    wrong: str = ""
    notes: tuple[Note, ...] = ()
    seal: str = ""
    n_named: int = 0
    n_products: int = 0
    n_inputs: int = 0
    n_published: int = 0
    n_pages: int = 0
    n_others: int = 0
    unchecked: tuple[str, ...] = ()
    signed_with: str = ""

    def __bool__(self) -> bool:
        """Whether the record and the files that were checked are unchanged."""
        return not self.wrong


def verify_run(
    path: str | Path, *, also_published: bool = True, signer: Path | None = None
) -> Verification:
    """Check the seal, digests, cache keys, required fields and published files of a record.

    Missing published files result only in a note, because a record may be passed on alone.

    Args:
        path: a run folder, or the `run.h5` in this folder.
        also_published: whether to check the files next to the record, too.
        signer: file with the public key of the signer; the record must be signed with this key.

    Raises:
        ArgumentError: the path does not exist, or the folder contains no finished run.
        InputError: `signer` is not a public key.
        PluginError: `signer` is given, and the library cryptography is not installed.
    """
    record_path = find_record(path)
    if found := verify_record(record_path):
        is_unchecked = found[0].code in ("foreign", "locked")
        wrong = "cannot be checked" if is_unchecked else "has been changed since it was written"
        findings = tuple(f"{finding.place}: {finding.problem}" for finding in found)
        return Verification(path=record_path, findings=findings, wrong=f"{record_path} {wrong}")
    with record_errors(record_path), open_record(record_path) as opened:
        record, seal = opened.record, opened.content_sha256
        contradictions = [
            sentence for cell in record.cells for sentence in _contradictions(opened, cell)
        ]
    signed_with, unsigned, notes = _check_signature(record_path, signer)
    changed: list[str] = []
    states: list[PublishedState] = []
    pages: dict[str, bool] = {}
    n_others = 0
    unchecked: tuple[str, ...] = ()
    if also_published:
        folder = record_path.parent
        pages = _page_states(folder, seal)
        notes += [_page_note(folder, name) for name, is_own in pages.items() if not is_own]
        states = list(in_order(lambda file: published_state(folder, file), record.published))
        checked = list(zip(record.published, states, strict=True))
        changed = [f"{file.path}: {_WRONG[state]}" for file, state in checked if state in _WRONG]
        notes += _published_notes(
            record_path, record, [file.path for file, state in checked if state == "missing"]
        )
        # If all published files are missing, the record was passed on alone and may be next to
        # unrelated files.
        if "same" in states or "changed" in states or os.path.lexists(folder / METADATA_FILE):
            others, gone, n_others, unchecked = _check_others(read_run(record_path), tuple(pages))
            changed += others
            notes += gone
    beside = [
        *(["its signature is not from the given signer"] if unsigned else []),
        *(["files next to it have been changed"] if changed else []),
    ]
    wrong = f"the seal of {record_path} is intact, but {' and '.join(beside)}" if beside else ""
    products = [product for cell in record.cells for product in cell.outputs.values()]
    n_products = sum(product.embedded for product in products)
    return Verification(
        path=record_path,
        findings=(*contradictions, *unsigned, *changed),
        wrong=f"{record_path} contradicts itself" if contradictions else wrong,
        notes=tuple(notes),
        seal=seal,
        signed_with=signed_with,
        n_products=n_products,
        n_named=len(products) - n_products,
        n_inputs=sum(len(entry.files) for entry in record.inputs if entry.embedded),
        n_published=states.count("same"),
        n_pages=sum(pages.values()),
        n_others=n_others,
        unchecked=unchecked,
    )


def _contradictions(opened: OpenRecord, cell: RecordedCell) -> Iterator[str]:
    places = [
        port
        for port, output in cell.outputs.items()
        if output.embedded and output.type_name == Inspection.type_name
    ]
    stated: dict[str, set[tuple[float, str]]] = {}
    for port in places:
        payload = Payload(**shared_fields(opened.payload(cell.address, port), Payload))
        for finding in Inspection.from_payload(payload).findings:
            stated.setdefault(finding.name, set()).add((finding.value, finding.unit))
    for metric in cell.metrics:
        name = metric.name if metric.name in stated else _OF_WALLS.sub("", metric.name)
        if name in stated and (metric.value, metric.unit) not in stated[name]:
            values = first_few([f"{value:g} {unit}" for value, unit in sorted(stated[name])])
            yield (
                f"/cells/{cell.address}: the metric {metric.name} is {metric.value:g} "
                f"{metric.unit}, but its inspection contains {values}"
            )


def _page_states(folder: Path, content_sha256: str) -> dict[str, bool]:
    """Return page -> whether it is unchanged and shows the record, for all pages next to it."""
    names = [REPORT_FILE] if os.path.lexists(folder / REPORT_FILE) else []
    names += [f"{PAGES_FOLDER}/{name}" for name in sorted(files_below(folder, PAGES_FOLDER))]
    return {name: _is_own_page(folder, name, content_sha256) for name in names}


def _is_own_page(folder: Path, name: str, content_sha256: str) -> bool:
    try:
        with open_below(folder, name) as stream:
            if os.fstat(stream.fileno()).st_size > LARGEST_PAGE_BYTES:
                return False
            content = stream.read()
    except (OSError, UnsafeFileError):
        return False
    sealed, _, end = content.rpartition(b"page ")
    shown = sealed.rpartition(PAGE_MARK.encode())[2].decode("ascii", "replace").split()
    own = f"{hashlib.sha256(sealed).hexdigest()} -->\n".encode()
    return end == own and content_sha256 in shown


def _page_note(folder: Path, name: str) -> Note:
    text = (
        f"{name} does not show this record, or has been changed since it was written; "
        f"`orthoflow report {shlex.quote(str(folder))}` recreates it"
    )
    return Note(code="page", text=text)


def broken_seal(run: Run, *, of_all: bool = False) -> str:
    """Describe the changes to a record since it was sealed; empty if none were found.

    By default, this is fast because the arrays of products and the input files are not checked. The
    digest of a product is checked when the product is read (`Run.payloads`), and `verify_run`
    checks everything.

    Args:
        run: the run.
        of_all: whether to check the arrays and input files, too, which is necessary before the
            record is passed on.
    """
    findings = verify_record(run.path, with_arrays=of_all)
    places = [finding.place for finding in findings if finding.code not in _OWN_FAULTS]
    if not places:
        return ""
    return (
        f"{run.path} has been changed since it was written: its seal does not match "
        f"{first_few(places)}"
    )


def _check_signature(record: Path, signer: Path | None) -> tuple[str, list[str], list[Note]]:
    try:
        if signer is not None:
            return check_signature(record, signer).fingerprint, [], []
        if (found := read_signature(record)) is None:
            return "", [], []
        text = (
            f"there is a signature with the key {found.fingerprint}, which was not "
            "checked: give the signer's public key with --signer"
        )
    except RecordError as error:
        if signer is not None:
            return "", [str(error)], []
        text = str(error)
    return "", [], [Note(code="signature", text=text)]


def _published_notes(path: Path, record: RunRecord, missing: list[str]) -> Iterator[Note]:
    n_published = len(record.published)
    if missing:
        text = (
            f"{len(missing)} of {n_published} published files are not in {PRODUCTS_FOLDER}/: "
            f"{first_few(missing)}"
        )
        yield Note(code="missing", text=text)
    # If all published files are missing, the record was passed on alone and may be next to
    # unrelated files.
    is_alone = bool(missing) and len(missing) == n_published
    if not is_alone and (unnamed := _unnamed(path, record)):
        text = f"the record does not list these files of {PRODUCTS_FOLDER}/: {first_few(unnamed)}"
        yield Note(code="foreign", text=text)


def _check_others(
    run: Run, pages: tuple[str, ...]
) -> tuple[list[str], list[Note], int, tuple[str, ...]]:
    """Check the files next to a record that are neither published files nor pages.

    Figures repeat parts of the record, as do the workflow and the lists of packages in a crate. The
    metadata of a crate contain the digests of all its files.

    Returns:
        Findings, notes on missing files, the number of unchanged files, and a description of the
        files that cannot be checked.
    """
    folder, findings = run.folder, []
    known = {file.path: file for file in run.record.published}
    crate, free = None, ""
    try:
        if (metadata := _crate_metadata(folder)) is not None:
            crate = _crate_files(metadata)
            different, free = _metadata_state(run.record, metadata, list(crate.values()))
            findings += different
    except (UnsafeFileError, OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        findings.append(f"{METADATA_FILE} is not the metadata of a crate, or is damaged: {error}")
        crate = crate or {}
    states: dict[str, tuple[PublishedState, str]] = {}
    for name, content in crate_texts(run.record).items() if crate is not None else ():
        digest = hashlib.sha256(content).hexdigest()
        known[name] = PublishedFile(path=name, size_bytes=len(content), sha256=digest)
        states[name] = published_state(folder, known[name]), "the record"
    for name, file in (crate or {}).items():
        # Avoid hashing large files a second time.
        if known.get(name) != file:
            states[name] = published_state(folder, file), METADATA_FILE
    findings += [
        f"{name}: differs from {source}"
        for name, (state, source) in states.items()
        if state in _WRONG
    ]
    figures = _figure_states(run)
    findings += [
        f"{name}: differs from the figure in the record"
        for name, is_same in figures.items()
        if not is_same
    ]
    gone = [name for name, (state, _) in states.items() if state == "missing"]
    same = {name for name, (state, _) in states.items() if state == "same"}
    text = f"{len(gone)} files of the crate are missing: {first_few(gone)}"
    signature = f"{RECORD_FILE}{SIGNATURE_SUFFIX}"
    checked = {RECORD_FILE, signature, *pages, *known, *states, *figures}
    return (
        findings,
        [Note(code="missing", text=text)] if gone else [],
        len({name for name, is_same in figures.items() if is_same} | same),
        tuple(_left_over(folder, checked, free)),
    )


def _left_over(folder: Path, checked: Set[str], free: str) -> Iterator[str]:
    tops: dict[str, list[str]] = {}
    for place, _, below in os.walk(folder):
        for name in below:
            path = Path(place, name).relative_to(folder)
            # Additional files in the products folder are reported by `_published_notes`.
            if path.as_posix() not in checked and path.parts[0] != PRODUCTS_FOLDER:
                tops.setdefault(path.parts[0], []).append(path.as_posix())
    for top, paths in sorted(tops.items()):
        if top == METADATA_FILE:
            yield f"{top} ({free})" if free else top
        else:
            yield f"{top}/ ({len(paths)} files)" if len(paths) > 1 else paths[0]


def _figure_states(run: Run) -> dict[str, bool]:
    """Return path -> whether the file shows the recorded figure, for figures next to a record."""
    try:
        figures = figure_files(run, run.cells)
    except RecordError:
        # Figures are never written to files if a name is invalid.
        return {}
    found = {f"{FIGURES_FOLDER}/{path}": figure for path, figure in figures.items()}
    states = in_order(lambda item: _is_same_figure(run.folder, *item), found.items())
    pairs = zip(found, states, strict=True)
    return {name: is_same for name, is_same in pairs if is_same is not None}


def _is_same_figure(folder: Path, path: str, figure: RecordedFigure) -> bool | None:
    """Return whether a file shows a figure, in any format; None if there is no such file."""
    try:
        with open_below(folder, path) as stream:
            content = stream.read(LARGEST_PAGE_BYTES)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (UnsafeFileError, OSError):
        return False
    if content == figure.data:
        return True
    try:
        return np.array_equal(decode_image(content, path), decode_image(figure.data, path))
    except InputError:
        return False


def _crate_metadata(folder: Path) -> Any:
    try:
        with open_below(folder, METADATA_FILE) as stream:
            return parse_json(stream.read(_LARGEST_METADATA).decode())
    except FileNotFoundError:
        return None


def _crate_files(crate: Any) -> dict[str, PublishedFile]:
    return {
        entity["@id"]: PublishedFile(
            path=entity["@id"],
            size_bytes=int(entity["contentSize"]),
            sha256=str(entity["sha256"]),
        )
        for entity in crate["@graph"]
        # The ids of input files, which are not in the crate, have the scheme `ni`.
        if "sha256" in entity and not str(entity["@id"]).startswith("ni:")
    }


def _metadata_state(
    record: RunRecord,
    crate: Any,
    files: Sequence[PublishedFile],
) -> tuple[list[str], str]:
    """Return findings if the metadata differ from the record, and which part was not checked.

    Differences from metadata that another version wrote are no findings, because that version may
    describe the same record with other entities.
    """
    from orthoflow.records.archive import metadata_differences  # noqa: PLC0415 - loads prov

    try:
        different = metadata_differences(record, files, crate)
    except RecordError as error:
        return [f"{METADATA_FILE}: {error}"], "everything except the digests of files"
    if different and record.created_by != f"orthoflow {__version__}":
        return [], f"everything except the digests of files: check it with {record.created_by}"
    found = [f"{METADATA_FILE}: differs from the record in {first_few(different)}"]
    return found if different else [], "author, license and descriptions"


def _unnamed(path: Path, record: RunRecord) -> list[str]:
    named = {file.path for file in record.published}
    unnamed: set[str] = set()
    for place, _, below in os.walk(path.parent / PRODUCTS_FOLDER):
        unnamed |= {Path(place, name).relative_to(path.parent).as_posix() for name in below}
    return sorted(unnamed - named)
