"""The method follows all rules that orthoflow's own methods follow."""

from pathlib import Path

import pytest
from orthoflow.testing import conformance_cases

CASES = conformance_cases(
    "orient.poselib",
    golden=Path(__file__).with_name("golden.json"),
)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_conformance(case):
    case.run()
