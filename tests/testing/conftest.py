"""What the tests of the conformance suite share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from orthoflow.testing import isolation


@pytest.fixture(scope="session", autouse=True)
def _no_charts_elsewhere() -> Iterator[None]:
    """Set up no charts in the processes of runs elsewhere, which keep none."""
    blanks = "from tests.undrawn_charts import build_charts_on_blanks; build_charts_on_blanks()"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(isolation, "_SERVE", f"{blanks}; {isolation._SERVE}")
        yield
