"""The conformance suite that every method passes, built in or third-party.

Use it in the tests of a plugin:

    @pytest.mark.parametrize("case", conformance_cases("plane.flat"), ids=str)
    def test_conformance(case):
        case.run()

It reads only what the method declares, needs no pytest itself, and states in one sentence what is
wrong. A check that a method cannot pass is named with its reason in `expected_failures`; it fails
when it starts to pass, so that reasons do not outlive their cause.
"""

from orthoflow.testing.cases import ConformanceCase, ConformanceError, conformance_cases
from orthoflow.testing.examples import ExampleError, example_inputs, example_room
from orthoflow.testing.trials import Trial, TrialRun, run_trial

__all__ = [
    "ConformanceCase",
    "ConformanceError",
    "ExampleError",
    "Trial",
    "TrialRun",
    "conformance_cases",
    "example_inputs",
    "example_room",
    "run_trial",
]
