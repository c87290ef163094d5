"""Verification: whether a record is what was written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from orthoflow_provenance.reader import read_record
from orthoflow_provenance.verify import verify_record

from orthoflow.records.runs import find_record, record_errors


@dataclass(frozen=True, kw_only=True)
class Verification:
    """What a check of a record found.

    Attributes:
        path: the record file.
        findings: one sentence per difference; empty when the record is as it was written.
        n_products: products whose arrays lie in the record and were compared with their digest.
    """

    path: Path
    findings: tuple[str, ...]
    n_products: int


def verify_run(path: str | Path) -> Verification:
    """Check seal, digests, cache keys and required fields of a record.

    Args:
        path: a run folder, or the `run.h5` in it.

    Raises:
        ArgumentError: nothing is there, or the folder holds no finished run.
    """
    record_path = find_record(path)
    findings = tuple(
        f"{finding.place}: {finding.problem}" for finding in verify_record(record_path)
    )
    n_products = 0
    if not findings:
        with record_errors(record_path):
            cells = read_record(record_path).cells
        n_products = sum(product.embedded for cell in cells for product in cell.outputs.values())
    return Verification(path=record_path, findings=findings, n_products=n_products)
