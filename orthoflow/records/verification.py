"""Verification: whether a record, and what was published beside it, is what was written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from orthoflow_provenance.model import PublishedFile, RunRecord
from orthoflow_provenance.reader import read_record
from orthoflow_provenance.verify import verify_record

from orthoflow.engine.file_digests import file_sha256
from orthoflow.geometry.threads import in_order
from orthoflow.records.published import PRODUCTS_FOLDER
from orthoflow.records.runs import find_record, record_errors

_FILES_NAMED: Final = 3


@dataclass(frozen=True, kw_only=True)
class Verification:
    """What a check of a record found.

    Attributes:
        path: the record file.
        findings: one sentence per difference; empty when all is as it was written.
        notes: what could not be checked, a sentence each.
        n_products: products whose arrays lie in the record and were compared with their digest.
        n_inputs: input files that lie in the record and were compared with their digest.
        n_published: files beside the record that are as they were published.
    """

    path: Path
    findings: tuple[str, ...]
    notes: tuple[str, ...] = ()
    n_products: int = 0
    n_inputs: int = 0
    n_published: int = 0


def verify_run(path: str | Path, *, also_published: bool = True) -> Verification:
    """Check seal, digests, cache keys and required fields of a record, and the published files.

    Published files that are not beside the record are a note: a record may travel alone.

    Args:
        path: a run folder, or the `run.h5` in it.
        also_published: check the files beside the record too.

    Raises:
        ArgumentError: nothing is there, or the folder holds no finished run.
    """
    record_path = find_record(path)
    findings = tuple(
        f"{finding.place}: {finding.problem}" for finding in verify_record(record_path)
    )
    if findings:
        return Verification(path=record_path, findings=findings)
    with record_errors(record_path):
        record = read_record(record_path)
    check = _check_published(record_path.parent, record) if also_published else _PublishedCheck()
    return Verification(
        path=record_path,
        findings=check.changed,
        notes=check.notes,
        n_products=sum(
            product.embedded for cell in record.cells for product in cell.outputs.values()
        ),
        n_inputs=sum(len(entry.files) for entry in record.inputs if entry.embedded),
        n_published=check.n_same,
    )


@dataclass(frozen=True, kw_only=True)
class _PublishedCheck:
    changed: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    n_same: int = 0


def _check_published(folder: Path, record: RunRecord) -> _PublishedCheck:
    states = list(in_order(lambda file: _state(folder, file), record.published))
    checked = list(zip(record.published, states, strict=True))
    missing = [file.path for file, state in checked if state == "missing"]
    changed = tuple(
        f"{file.path}: {state} since it was published"
        for file, state in checked
        if state in {"changed", "unreadable"}
    )
    notes = (_missing_note(missing, len(checked)),) if missing else ()
    return _PublishedCheck(changed=changed, notes=notes, n_same=states.count("same"))


def _state(
    folder: Path, file: PublishedFile
) -> Literal["same", "changed", "missing", "unreadable"]:
    path = folder / file.path
    try:
        if path.stat().st_size != file.size_bytes:
            return "changed"
        return "same" if file_sha256(path) == file.sha256 else "changed"
    except (FileNotFoundError, NotADirectoryError):
        return "missing"
    except OSError:
        return "unreadable"


def _missing_note(missing: list[str], n_published: int) -> str:
    if len(missing) == n_published:
        return (
            f"the {n_published} published files of the record are not beside it, so they were not "
            "checked"
        )
    named = ", ".join(missing[:_FILES_NAMED])
    more = f" and {len(missing) - _FILES_NAMED} more" if len(missing) > _FILES_NAMED else ""
    return (
        f"{len(missing)} of {n_published} published files are not in {PRODUCTS_FOLDER}/ any more: "
        f"{named}{more}"
    )
