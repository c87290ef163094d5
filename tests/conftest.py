"""Fixtures that several test modules share."""

from __future__ import annotations

from pathlib import Path

import pytest

_SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real scans and photos beside the checkout, which never ships with it."""
    if not _SHARED.is_dir():
        pytest.skip("the real test data beside the checkout (../shared/data) are not here")
    return _SHARED
