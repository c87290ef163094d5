"""Verification: whether a record, and what was published beside it, is what was written."""

from __future__ import annotations

import hashlib
import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

from orthoflow_provenance.document import PublishedFile, RunRecord, UnsafeFileError
from orthoflow_provenance.paths import open_below
from orthoflow_provenance.record import open_record
from orthoflow_provenance.verify import verify_record

from orthoflow.alike import first_few
from orthoflow.errors import RecordError
from orthoflow.geometry.threads import in_order
from orthoflow.records.published import PRODUCTS_FOLDER
from orthoflow.records.runs import (
    FIGURES_FOLDER,
    PAGES_FOLDER,
    REPORT_FILE,
    Run,
    find_record,
    record_errors,
)
from orthoflow.records.signatures import SIGNATURE_SUFFIX, check_signature, read_signature

# What shows the record; its digests would have to be in it.
_VIEWS: Final = (REPORT_FILE, PAGES_FOLDER, FIGURES_FOLDER)

# What a record contradicts itself in: it may have been written so.
_OWN_FAULTS: Final = frozenset({"field", "name", "key", "reference"})
# A crate has its description, two files of the workflow and one per environment.
_UNCOVERED_MOST: Final = 8

PublishedState: TypeAlias = Literal["same", "changed", "missing", "unreadable", "no file"]
_WRONG: Final[dict[PublishedState, str]] = {
    "changed": "changed since it was published",
    "unreadable": "unreadable since it was published",
    "no file": "a link, a folder or a device stands where a file was published; it was not read",
}


@dataclass(frozen=True, kw_only=True)
class Verification:
    """What a check of a record found.

    Attributes:
        path: the record file.
        findings: one sentence per difference; empty when all is as it was written.
        wrong: what the findings are of, in words; empty without any.
        notes: what could not be checked, a sentence each.
        seal: the digest that seals the record, 64 hexadecimal digits, as sheets show it; empty
            where the record itself is not as it was written.
        n_named: products that the record names by their digests alone.
        n_products: products whose arrays lie in the record and were compared with their digest.
        n_inputs: input files that lie in the record and were compared with their digest.
        n_published: files beside the record that are as they were published.
        signed_with: fingerprint of the key that the record is signed with, empty unless that was
            asked for and is so.
    """

    path: Path
    findings: tuple[str, ...]
    wrong: str = ""
    notes: tuple[str, ...] = ()
    seal: str = ""
    n_named: int = 0
    n_products: int = 0
    n_inputs: int = 0
    n_published: int = 0
    signed_with: str = ""


def verify_run(
    path: str | Path, *, also_published: bool = True, signer: Path | None = None
) -> Verification:
    """Check seal, digests, cache keys and required fields of a record, and the published files.

    Published files that are not beside the record are a note: a record may travel alone.

    Args:
        path: a run folder, or the `run.h5` in it.
        also_published: check the files beside the record too.
        signer: public key that the record must be signed with.

    Raises:
        ArgumentError: nothing is there, or the folder holds no finished run.
        InputError: `signer` is no public key.
        PluginError: `signer` is given, and the library cryptography is missing.
    """
    record_path = find_record(path)
    found = verify_record(record_path)
    findings = tuple(f"{finding.place}: {finding.problem}" for finding in found)
    if findings:
        is_unchecked = found[0].code in ("foreign", "locked")
        wrong = "cannot be checked" if is_unchecked else "is not as it was written"
        wrong = f"{record_path} {wrong}"
        return Verification(path=record_path, findings=findings, wrong=wrong)
    with record_errors(record_path), open_record(record_path) as opened:
        record, seal = opened.record, opened.content_sha256
    products = [product for cell in record.cells for product in cell.outputs.values()]
    n_products = sum(product.embedded for product in products)
    check = _check_published(record_path, record) if also_published else _PublishedCheck()
    signature = _check_signature(record_path, signer)
    return Verification(
        path=record_path,
        findings=(*signature.findings, *check.changed),
        wrong=_wrong_beside(record_path, signature, check),
        notes=(*signature.notes, *check.notes),
        seal=seal,
        signed_with=signature.signed_with,
        n_products=n_products,
        n_named=len(products) - n_products,
        n_inputs=sum(len(entry.files) for entry in record.inputs if entry.embedded),
        n_published=check.n_same,
    )


def broken_seal(run: Run, *, of_all: bool = False) -> str:
    """Return what of a record was changed since it was sealed; empty where nothing is found.

    The arrays of products and input files are not looked at, so that this costs little: whoever
    reads those of a product compares their digest (`Run.payloads`), and `verify_run` looks at all.

    Args:
        run: the run.
        of_all: look at everything, for whoever hands on all of the record.
    """
    findings = verify_record(run.path, with_arrays=of_all)
    places = [finding.place for finding in findings if finding.code not in _OWN_FAULTS]
    if not places:
        return ""
    return f"{run.path} is not as it was written: its seal does not hold for {first_few(places)}"


def _wrong_beside(record: Path, signature: Verification, check: _PublishedCheck) -> str:
    """Name what differs beside a record that is whole."""
    wrong = [
        *(["its signature is not the one asked for"] if signature.findings else []),
        *(["published files beside it are not as they were written"] if check.changed else []),
    ]
    return f"the seal of {record} holds, but {' and '.join(wrong)}" if wrong else ""


def _check_signature(record: Path, signer: Path | None) -> Verification:
    """What is to be said of the signature alone."""
    try:
        if signer is not None:
            found = check_signature(record, signer)
            return Verification(path=record, findings=(), signed_with=found.fingerprint)
        if (unchecked := read_signature(record)) is None:
            return Verification(path=record, findings=())
    except RecordError as error:
        said = (str(error),)
        is_asked = signer is not None
        return Verification(
            path=record, findings=said if is_asked else (), notes=() if is_asked else said
        )
    note = (
        f"there is a signature, said to be of the key {unchecked.fingerprint}, that was not "
        "checked: name the signer's public key with --signer"
    )
    return Verification(path=record, findings=(), notes=(note,))


@dataclass(frozen=True, kw_only=True)
class _PublishedCheck:
    changed: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    n_same: int = 0


def _check_published(path: Path, record: RunRecord) -> _PublishedCheck:
    folder = path.parent
    states = list(in_order(lambda file: published_state(folder, file), record.published))
    checked = list(zip(record.published, states, strict=True))
    missing = [file.path for file, state in checked if state == "missing"]
    changed = tuple(f"{file.path}: {_WRONG[state]}" for file, state in checked if state in _WRONG)
    notes: tuple[str, ...] = (_missing_note(missing, len(checked)),) if missing else ()
    views = [name for name in _VIEWS if os.path.lexists(folder / name)]
    # A record that travels alone lies among files that are none of its own.
    others = _uncovered(path, record) if views or len(missing) < len(checked) else []
    if views or others:
        notes += (_uncovered_note(folder, views, others),)
    return _PublishedCheck(changed=changed, notes=notes, n_same=states.count("same"))


def published_state(folder: Path, file: PublishedFile) -> PublishedState:
    """Compare a published file with the record; follows no link and opens no device.

    Args:
        folder: of the run.
        file: what the record says of it.
    """
    try:
        with open_below(folder, file.path) as stream:
            # A sparse file of a terabyte is told by its size.
            if os.fstat(stream.fileno()).st_size != file.size_bytes:
                return "changed"
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
    except (FileNotFoundError, NotADirectoryError):
        return "missing"
    except UnsafeFileError:
        return "no file"
    except OSError:
        return "unreadable"
    return "same" if digest == file.sha256 else "changed"


def require_unchanged(run: Run, *paths: Path) -> None:
    """Refuse published files that are not as the record says: what is made of them would lie.

    Args:
        run: the run.
        paths: below its folder.

    Raises:
        RecordError: one was changed, is a link or a device, or is not in the record.
    """
    known = {file.path: file for file in run.record.published}
    for path in paths:
        expected = known.get(path.relative_to(run.folder).as_posix())
        if expected is None:
            raise RecordError(
                f"{path} is not named in the record of the run, so nothing vouches for it"
            )
        state = published_state(run.folder, expected)
        if state == "changed":
            raise RecordError(
                f"{path} was changed after the run: the record says that it has the digest "
                f"{expected.sha256}"
            )
        if state != "same":
            raise RecordError(f"{path} cannot be read: {state}")


def _uncovered(path: Path, record: RunRecord) -> list[str]:
    """What lies beside a record and is neither named in it nor shows it, sorted."""
    known = {path.name, f"{path.name}{SIGNATURE_SUFFIX}", PRODUCTS_FOLDER, *_VIEWS}
    _, folders, files = next(os.walk(path.parent), ("", [], []))
    beside = sorted({*folders, *files} - known)
    named = {file.path for file in record.published}
    for place, _, below in os.walk(path.parent / PRODUCTS_FOLDER):
        paths = [Path(place, name).relative_to(path.parent).as_posix() for name in below]
        beside += sorted(set(paths) - named)
    return beside


def _uncovered_note(folder: Path, views: list[str], others: list[str]) -> str:
    rest = first_few(others, most=_UNCOVERED_MOST)
    if not views:
        return f"not covered: {rest}, which the record does not name"
    shows, them = ("shows", "it") if len(views) == 1 else ("show", "them")
    return (
        f"not covered: {', '.join(views)}, which {shows} the record; `orthoflow report "
        f"{shlex.quote(str(folder))}` makes {them} anew"
        + (f"; nor what else the record does not name: {rest}" if others else "")
    )


def _missing_note(missing: list[str], n_published: int) -> str:
    if len(missing) == n_published:
        return (
            f"the {n_published} published files of the record are not beside it, so they were not "
            "checked"
        )
    return (
        f"{len(missing)} of {n_published} published files are not in {PRODUCTS_FOLDER}/: "
        f"{first_few(missing)}"
    )
