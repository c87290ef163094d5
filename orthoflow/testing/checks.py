"""The rules that all methods must follow, one function each."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import pairwise
from typing import Any, Final, get_args, get_type_hints

import numpy as np
from pydantic import ValidationError
from pydantic.fields import FieldInfo

from orthoflow.engine.store import digest_of
from orthoflow.errors import CancelledStepError, OrthoflowError, ProductError
from orthoflow.products import Cameras, PointCloud, Product
from orthoflow.sdk import Method, port_specs
from orthoflow.sdk.units import UNITS
from orthoflow.testing.examples import example_room
from orthoflow.testing.golden import golden_problem
from orthoflow.testing.photographed import example_ties
from orthoflow.testing.physics import (
    cells_show_their_own_place,
    mosaics_show_cells_in_place,
    planes_follow_a_rigid_motion,
    poses_are_recovered,
    stated_errors_of_planes_hold,
    stated_errors_of_poses_hold,
)
from orthoflow.testing.subjects import Subject, output_of, require

# The name of a float parameter must contain one of these words, which stand for a unit or for a
# value without a unit.
UNIT_SUFFIXES: Final = (*UNITS, "world", "intensity")


@dataclass(frozen=True)
class Check:
    """A rule and the function that checks it.

    Attributes:
        run: raises AssertionError with one sentence if the method breaks the rule.
        applies: returns a true value if the rule applies to the method.
        is_quick: whether the check runs the method on the example at most twice, and otherwise only
            on inputs that are rejected before any computation.
    """

    run: Callable[[Subject], None]
    applies: Callable[[type[Method]], object] = lambda method: True
    is_quick: bool = True

    @property
    def name(self) -> str:
        """Name for listings and `expected_failures`."""
        return self.run.__name__.replace("_", "-")

    @property
    def rule(self) -> str:
        """The rule in one sentence."""
        return (self.run.__doc__ or "").partition("\n")[0]


def parameters_are_documented(subject: Subject) -> None:
    """Every parameter has a default, a description, and a unit in its name."""
    fields = subject.method.Params.model_fields
    faults = [fault for name, info in fields.items() for fault in _parameter_faults(name, info)]
    require(not faults, "; ".join(faults))


def _parameter_faults(name: str, info: FieldInfo) -> Iterator[str]:
    if info.is_required():
        yield f"parameter {name} has no default"
    if not info.description:
        yield f"parameter {name} has no description"
    is_float = info.annotation is float or info.annotation == (float | None)
    if is_float and not re.search(rf"_({'|'.join(UNIT_SUFFIXES)})(_|$)", f"_{name}"):
        yield (
            f"the name of parameter {name} lacks a unit: end it with one of "
            f"{', '.join(UNIT_SUFFIXES)}"
        )


def parameters_round_trip(subject: Subject) -> None:
    """Parameters can be stored as JSON, are frozen, and reject unknown keys."""
    model = subject.method.Params
    params = model(**subject.trial.params)
    text = json.dumps(params.model_dump(mode="json"), allow_nan=False)
    again = model.model_validate_json(text)
    require(again == params, f"parameters change when converted to JSON and back: {text}")
    require(model.model_config.get("frozen"), "parameters are not frozen")
    try:
        model.model_validate({"no_such_parameter": 1})
    except ValidationError:
        return
    raise AssertionError("an unknown parameter is accepted")


def outputs_are_valid(subject: Subject) -> None:
    """Outputs have the declared types, fit each other and the inputs, and can be stored.

    Metrics are declared.
    """
    run = subject.first
    given = {name: one for name, one in subject.trial.inputs.items() if isinstance(one, Product)}
    for name, port in port_specs(subject.method.Out).items():
        product = run.outputs.get(name)
        require(product is not None or not port.required, f"output {name} is missing")
        if product is None:
            continue
        require(
            product.type_name == port.type_name,
            f"output {name} is a {product.type_name}, but {port.type_name} is declared",
        )
        others = {port: other for port, other in run.outputs.items() if port != name}
        try:
            product.check_against(others | given)
        except ProductError as error:
            raise AssertionError(f"output {name} is invalid: {error}") from error
        unknown = sorted(set(product.tolerances) - _field_names(type(product), set()))
        require(not unknown, f"tolerances of {name} name no field: {', '.join(unknown)}")
        again = type(product).from_payload(product.to_payload())
        require(digest_of(again) == run.digests[name], f"storing changes output {name}")
    for metric in run.metrics:
        require(
            subject.method.may_report(metric.name),
            f"metric {metric.name} is not declared by the method (`metrics`)",
        )


def _field_names(hint: Any, seen: set[Any]) -> set[str]:
    """Return the names of the fields of a dataclass and of the dataclasses in its fields."""
    if hint in seen:
        return set()
    seen.add(hint)
    hints = get_type_hints(hint) if is_dataclass(hint) else {}
    own = {field.name for field in fields(hint)} if hints else set()
    return own.union(*(_field_names(part, seen) for part in (*hints.values(), *get_args(hint))))


def inputs_stay_untouched(subject: Subject) -> None:
    """Input arrays are not changed."""
    _ = subject.first
    require(not subject.changed_inputs, f"changed inputs: {', '.join(subject.changed_inputs)}")


def global_state_stays_untouched(subject: Subject) -> None:
    """The global random generator of numpy is not used."""
    require(
        not subject.first.drew_globally,
        "the method uses numpy's global random generator instead of ctx.rng",
    )


def nothing_is_written_outside_scratch(subject: Subject) -> None:
    """No files are written to the working directory, the home directory or the temporary folder."""
    _ = subject.first  # all rules report an error of every run in the same way
    _, strays = subject.elsewhere
    require(not strays, f"files were written outside the scratch folder: {', '.join(strays)}")


def results_repeat(subject: Subject) -> None:
    """The same seed gives the same digest, also in a new process with another hash seed.

    If determinism is `loose`, only the types of the outputs must be the same.
    """
    first, second, (elsewhere, _) = subject.first, subject.again, subject.elsewhere
    exact = subject.method.determinism != "loose"
    for name, digest in first.digests.items():
        require(
            not exact or second.digests[name] == digest,
            f"output {name} differs between two runs with the same seed in the same process",
        )
        require(
            name in elsewhere and (not exact or elsewhere[name] == digest),
            f"output {name} differs in a new process with another working directory and hash seed",
        )


def threads_do_not_show(subject: Subject) -> None:
    """The digest is the same with one core and with two."""
    one, two = subject.first, subject.on_two_cores
    for name, digest in one.digests.items():
        # If outputs differ between two runs on one core, `results_repeat` reports this.
        is_same = two.digests[name] == digest or subject.again.digests[name] != digest
        require(is_same, f"output {name} depends on the number of cores")


def _cloud_ports(method: type[Method]) -> list[str]:
    return [name for name, port in port_specs(method.In).items() if port.type_name == "cloud"]


def _check_clouds(
    subject: Subject,
    spoilt: Callable[[PointCloud], PointCloud],
    what: str,
    *,
    may_pass: bool = False,
) -> None:
    _ = subject.first  # an error of every run is not due to these clouds
    for port in _cloud_ports(subject.method):
        cloud = subject.trial.inputs.get(port)
        if not isinstance(cloud, PointCloud):
            cloud = example_room(n_points=5000)[0]
        try:
            subject.run_on(**{port: spoilt(cloud)})
        except OrthoflowError as error:
            require(str(error).strip(), f"a cloud with {what} is refused without a message")
        except Exception as error:
            raise AssertionError(
                f"a cloud with {what} raises {type(error).__name__} instead of an "
                f"OrthoflowError: {error}"
            ) from error
        else:
            require(may_pass, f"a cloud with {what} is accepted")


def _with_one_x(cloud: PointCloud, x_m: float) -> PointCloud:
    x = cloud.x.copy()
    x[len(x) // 2] = x_m
    return replace(cloud, x=x)


def empty_cloud_is_refused(subject: Subject) -> None:
    """A cloud without points causes an OrthoflowError."""
    none = np.zeros(0, dtype=np.int64)
    _check_clouds(subject, lambda cloud: cloud.selected(none), "no points")


def nan_is_refused(subject: Subject) -> None:
    """A cloud in which a coordinate is NaN causes an OrthoflowError."""
    _check_clouds(subject, lambda cloud: _with_one_x(cloud, np.nan), "NaN coordinates")


def a_huge_coordinate_does_no_harm(subject: Subject) -> None:
    """A cloud with one coordinate of 1e30 m gives a result or causes an OrthoflowError."""
    what = "a coordinate of 1e30 m"
    _check_clouds(subject, lambda cloud: _with_one_x(cloud, 1e30), what, may_pass=True)


def missing_ties_are_reported(subject: Subject) -> None:
    """Without ties, no photo is reported as oriented."""
    ties = example_ties()
    # Any, because the arrays have various types.
    rows: dict[str, Any] = {
        name: given[:0] for name, given in vars(ties).items() if isinstance(given, np.ndarray)
    }
    try:
        run = subject.run_on(ties=replace(ties, **rows))
    except OrthoflowError:
        return
    cameras = output_of(run, "cameras", Cameras).cameras
    oriented = [camera.photo for camera in cameras if camera.status == "ok"]
    require(not oriented, f"{', '.join(oriented)} was oriented without any ties")


def progress_never_goes_back(subject: Subject) -> None:
    """Progress is reported as fractions from 0 to 1 that never decrease."""
    fractions = subject.first.fractions
    for before, after in pairwise((0.0, *fractions, 1.0)):
        require(
            math.isfinite(after) and before <= after <= 1.0,
            f"progress decreases from {before:.3f} to {after:.3f}",
        )


def cancel_is_honoured(subject: Subject) -> None:
    """The method checks regularly whether its step was cancelled, and stops if so."""
    try:
        subject.run_cancelled()
    except CancelledStepError:
        return
    raise AssertionError(
        "a cancelled step ran to completion: call ctx.progress(fraction, text) regularly; it "
        "raises when the step is cancelled"
    )


def golden_digest_holds(subject: Subject) -> None:
    """Results agree with the golden file, unless `result_version` was incremented."""
    if subject.golden is not None:
        problem = golden_problem(subject.golden, subject.trial, subject.first.outputs)
        require(not problem, problem)


def _of(kind: str) -> Callable[[type[Method]], bool]:
    return lambda method: method.id.partition(".")[0] == kind


def _takes_ties(method: type[Method]) -> bool:
    ports = port_specs(method.In)
    return _of("orient")(method) and "ties" in ports and ports["ties"].required


CHECKS: Final[tuple[Check, ...]] = (
    Check(parameters_are_documented),
    Check(parameters_round_trip),
    Check(outputs_are_valid),
    Check(inputs_stay_untouched),
    Check(global_state_stays_untouched),
    Check(nothing_is_written_outside_scratch, is_quick=False),
    Check(results_repeat, is_quick=False),
    Check(threads_do_not_show, lambda method: method.determinism != "loose"),
    Check(progress_never_goes_back),
    Check(cancel_is_honoured),
    Check(empty_cloud_is_refused, _cloud_ports),
    Check(nan_is_refused, _cloud_ports),
    Check(a_huge_coordinate_does_no_harm, _cloud_ports, is_quick=False),
    Check(missing_ties_are_reported, _takes_ties, is_quick=False),
    Check(planes_follow_a_rigid_motion, _of("plane"), is_quick=False),
    Check(stated_errors_of_planes_hold, _of("plane"), is_quick=False),
    Check(poses_are_recovered, _of("orient"), is_quick=False),
    Check(stated_errors_of_poses_hold, _takes_ties, is_quick=False),
    Check(cells_show_their_own_place, _of("ortho"), is_quick=False),
    Check(mosaics_show_cells_in_place, _of("mosaic"), is_quick=False),
    Check(golden_digest_holds),
)
