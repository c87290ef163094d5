"""The run that tests of drawings draw."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.drawing_runs import write_drawing_run


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drawing_run(tmp_path_factory.mktemp("drawn") / "run")
