"""Both methods follow the rules; the detector is tested on the simulated wall."""

from pathlib import Path

import numpy as np
import pytest
from orthoflow.testing import Trial, conformance_cases, run_trial

from orthoflow_cracks.cracked_wall import CrackedWall
from orthoflow_cracks.dark_lines import DarkLines


def cracked_wall(folder):
    return run_trial(Trial(method=CrackedWall, inputs={}), folder).outputs


def inputs():
    return {"orthoimages": cracked_wall(Path())["orthoimages"]}


CASES = [
    *conformance_cases("crack.dark-lines", inputs=inputs),
    *conformance_cases("simulate.cracked-wall"),
]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_conformance(case):
    case.run()


def test_the_cracks_are_found_where_they_are(tmp_path):
    made = cracked_wall(tmp_path / "wall")
    trial = Trial(method=DarkLines, inputs={"orthoimages": made["orthoimages"]})
    found = run_trial(trial, tmp_path / "found").outputs["cracks"]
    assert len(found) == len(made["cracks"])
    # A line may lack half of its last step, and it is as wide as the cells that it covers.
    assert found.length_m() == pytest.approx(made["cracks"].length_m(), abs=0.15)
    np.testing.assert_allclose(found.width_m, 0.008, atol=0.003)
