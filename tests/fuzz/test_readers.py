"""Readers of files from outside give something or refuse, whatever is in the files."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz.harness import fuzz
from tests.fuzz.readers import NAMES


@pytest.mark.parametrize("name", NAMES, ids=str.lower)
def test_a_damaged_file_is_read_or_refused(name: str, tmp_path: Path) -> None:
    outcome = fuzz(f"tests.fuzz.readers:{name}", tmp_path)
    assert outcome.n_cases > 0
    assert not outcome.findings, outcome.report()
