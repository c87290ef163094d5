"""Seals of report pages, and the name of the signature file of a record."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Final

from orthoflow.records.runs import Run

SIGNATURE_SUFFIX: Final = ".sig"
# This text precedes the digests at the end of a page.
PAGE_MARK: Final = "orthoflow report of"


def sealed_page(text: str, runs: Sequence[Run]) -> str:
    """Append the digests of the records and of the page itself to a report page."""
    digests = [run.content_sha256 for run in runs if run.content_sha256]
    sealed = f"{text}\n<!-- {PAGE_MARK} {' '.join(digests)} "
    return f"{sealed}page {hashlib.sha256(sealed.encode('utf-8')).hexdigest()} -->\n"


def page_of(page: str, run: Run) -> str:
    """Replace the seal of a page that was written for another record of the same run."""
    text, mark, _ = page.rpartition(f"\n<!-- {PAGE_MARK}")
    return sealed_page(text, [run]) if mark else page
