"""Seals of report pages, and the name of the signature of a record."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Final

from orthoflow.records.runs import Run

SIGNATURE_SUFFIX: Final = ".sig"
# Text before the digests at the end of a page.
PAGE_MARK: Final = "orthoflow report of"


def sealed_page(text: str, runs: Sequence[Run]) -> str:
    """Return a report page with the digests of its records and of its own text appended."""
    digests = [run.content_sha256 for run in runs if run.content_sha256]
    sealed = f"{text}\n<!-- {PAGE_MARK} {' '.join(digests)} "
    return f"{sealed}page {hashlib.sha256(sealed.encode('utf-8')).hexdigest()} -->\n"


def page_of(page: str, run: Run) -> str:
    """Return a page of another record of the same run, sealed as a page of this record."""
    text, mark, _ = page.rpartition(f"\n<!-- {PAGE_MARK}")
    return sealed_page(text, [run]) if mark else page
