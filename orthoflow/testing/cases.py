"""A method and a check become a case; a case that fails states why in one sentence."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from pydantic import ValidationError

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.catalog.distributions import package_path
from orthoflow.errors import ArgumentError
from orthoflow.products import InputFiles, Product
from orthoflow.sdk import Method
from orthoflow.sdk.lines import describe_error
from orthoflow.testing.checks import CHECKS, Check
from orthoflow.testing.examples import ExampleError, example_inputs
from orthoflow.testing.trials import Trial
from orthoflow.testing.witnesses import Subject, Witness

Inputs = Mapping[str, Product | InputFiles]


class ConformanceError(AssertionError):
    """A method does not keep a rule; the message names method, rule and what happened."""


@dataclass(frozen=True, kw_only=True)
class ConformanceCase:
    """One check of one method.

    Attributes:
        method_id: id of the method.
        check: what is checked.
        witness: gives the runs of the method, which its cases share.
        expected_failure: why the check is known to fail; empty when it must pass.
        golden: file of digests that results are held to; None for none.
    """

    method_id: str
    check: Check
    witness: Callable[[], Witness]
    expected_failure: str = ""
    golden: Path | None = None

    def __str__(self) -> str:
        return f"{self.method_id}-{self.check.name}"

    def run(self) -> None:
        """Run the check.

        Raises:
            ConformanceError: the method breaks the rule, or a failure that was expected did not
                happen.
        """
        problem = self.problem()
        if self.expected_failure and not problem:
            raise ConformanceError(
                f"{self}: passes, although it was expected to fail ({self.expected_failure}): "
                "take it out of expected_failures"
            )
        if problem and not self.expected_failure:
            raise ConformanceError(f"{self}: {problem}")

    def problem(self) -> str:
        """Run the check and give what is wrong in one sentence, empty when nothing is."""
        with TemporaryDirectory(prefix="orthoflow-conformance-") as folder:
            try:
                subject = Subject(witness=self.witness(), folder=Path(folder), golden=self.golden)
                self.check.run(subject)
            except AssertionError as error:
                # What stops every run says nothing of a rule about odd inputs.
                return (error.__cause__ is not None and self._what_stops()) or str(error)
            except Exception as error:  # noqa: BLE001 - a third-party method may raise anything
                return _failure(error, self.witness)
        return ""

    def _what_stops(self) -> str:
        """What the method's run on its examples fails with; empty when it does not."""
        try:
            _ = self.witness().first
        except Exception as error:  # noqa: BLE001 - as above
            return _failure(error, self.witness)
        return ""


def _failure(error: Exception, witness: Callable[[], Witness]) -> str:
    """State in one sentence, and in which line, what stopped a run of the method."""
    if isinstance(error, ExampleError):
        return str(error)
    trial = witness().trial
    if isinstance(error, ValidationError) and error.title == trial.method.Params.__name__:
        return "; ".join(
            f"parameter {'.'.join(map(str, one['loc']))} "
            + ("has no default" if one["type"] == "missing" else f"cannot be: {one['msg']}")
            for one in error.errors(include_url=False)
        )
    own = package_path(trial.method.__module__)
    frames = traceback.extract_tb(error.__traceback__)
    within = [one for one in frames if own and Path(one.filename).resolve().is_relative_to(own)]
    where = f" ({Path(within[-1].filename).name}:{within[-1].lineno})" if within else ""
    where = "" if str(error).endswith(where) else where
    return f"on the suite's inputs the method raised {describe_error(error)}{where}"


def conformance_cases(
    method_id: str,
    *,
    inputs: Inputs | Callable[[], Inputs] | None = None,
    params: Mapping[str, object] | None = None,
    expected_failures: Mapping[str, str] | None = None,
    golden: Path | None = None,
) -> tuple[ConformanceCase, ...]:
    """Return every check that applies to an installed method.

    Args:
        method_id: e.g. `plane.flat`; found through the installed entry points.
        inputs: port -> product for ports the suite has no fitting example of, or what gives them
            when the first case runs.
        params: parameters that differ from the defaults, for a quick run.
        expected_failures: check name -> why the method cannot pass it.
        golden: file of digests that results are held to as long as `result_version` stays; what it
            lacks is added at the first run. Keep it beside the tests, under version control.

    Raises:
        ArgumentError: `expected_failures` names a check that does not exist or gives no reason.
        WorkflowError: no installed plugin has the method.
        PluginError: the method cannot be loaded.
    """
    expected = dict(expected_failures or {})
    method: type[Method] = discover_catalog().method(method_id).load()
    for name, reason in expected.items():
        if name not in {check.name for check in CHECKS} or not reason.strip():
            raise ArgumentError(
                f"expected_failures needs the name of a check and a reason, got {name!r}: "
                f"{reason!r}; the checks are {', '.join(check.name for check in CHECKS)}"
            )

    @cache
    def witness() -> Witness:
        given = inputs() if callable(inputs) else inputs or {}
        filled = {**example_inputs(method, besides=given), **given}
        return Witness(Trial(method=method, inputs=filled, params=dict(params or {})))

    return tuple(
        ConformanceCase(
            method_id=method_id,
            check=check,
            witness=witness,
            expected_failure=expected.get(check.name, ""),
            golden=golden,
        )
        for check in CHECKS
        if check.applies(method) and (golden is not None or check.name != "golden-digest-holds")
    )
