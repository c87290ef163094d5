"""What tests of workflow files share."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from tests.laboratories import laboratory_catalog


@pytest.fixture
def catalog(monkeypatch: pytest.MonkeyPatch) -> Catalog:
    return laboratory_catalog(monkeypatch)


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The path of the workflow of a test, in the working directory."""
    monkeypatch.chdir(tmp_path)
    return Path("flow.yaml")
