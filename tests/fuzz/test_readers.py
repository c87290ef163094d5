"""Readers of files from outside give something or refuse, whatever is in the files."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz import read_cameras, readers
from tests.fuzz.harness import IS_FUZZED, fuzz
from tests.optional import skip_unless

pytestmark = skip_unless(IS_FUZZED, "long", "damaged files for every reader")

MODULES = {name: module.__name__ for module in (readers, read_cameras) for name in module.NAMES}


@pytest.mark.parametrize("name", MODULES, ids=str.lower)
def test_a_damaged_file_is_read_or_refused(name: str, tmp_path: Path) -> None:
    outcome = fuzz(f"{MODULES[name]}:{name}", tmp_path)
    assert outcome.n_cases > 0
    assert not outcome.findings, outcome.report()
