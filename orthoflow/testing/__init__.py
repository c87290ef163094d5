"""The conformance suite for methods, both built-in and third-party.

Use it in the tests of a plugin:

    @pytest.mark.parametrize("case", conformance_cases("plane.flat"), ids=str)
    def test_conformance(case):
        case.run()

The suite needs only the declarations of the method, does not depend on pytest, and reports each
problem in one sentence. If a method cannot pass a check, list the check with the reason in
`expected_failures`. If the check passes nevertheless, the case fails, so that outdated entries are
noticed.
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
