"""The rules: what every method must keep, one function each."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import ValidationError

from orthoflow.engine.store import digest_of
from orthoflow.errors import OrthoflowError
from orthoflow.products import Planes, PointCloud, Product
from orthoflow.sdk import Method, port_specs
from orthoflow.testing.examples import example_room, few_points
from orthoflow.testing.trials import TrialRun, run_trial
from orthoflow.testing.witnesses import Witness

# What a float parameter's name ends with: its unit, or a word that says it has none.
UNIT_SUFFIXES: Final = (
    *("m", "mm", "m2", "px", "deg", "rad", "s", "cells", "sigma"),
    *("grey", "share", "ratio", "factor", "scale", "exponent", "power", "probability", "world"),
    "intensity",
)


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A method with what to try it on.

    Attributes:
        witness: runs of the method on its inputs.
        folder: empty, for further runs.
    """

    witness: Witness
    folder: Path

    @property
    def method(self) -> type[Method]:
        """The class."""
        return self.witness.trial.method

    def run_on(self, name: str, **inputs: Product) -> TrialRun:
        """Run the method with other inputs on some ports, in a scratch folder of that name."""
        trial = self.witness.trial
        changed = replace(trial, inputs={**trial.inputs, **inputs})
        return run_trial(changed, self.folder / name)


@dataclass(frozen=True, kw_only=True)
class Check:
    """One rule.

    Attributes:
        name: for listings and `expected_failures`.
        rule: the rule in one sentence.
        run: raises AssertionError with one sentence when the method breaks the rule.
        applies: whether the rule is about this method.
    """

    name: str
    rule: str
    run: Callable[[Subject], None]
    applies: Callable[[type[Method]], bool]


def _require(holds: object, sentence: str) -> None:
    if not holds:
        raise AssertionError(sentence)


def parameters_are_documented(subject: Subject) -> None:
    """Every parameter has a default, a description, and a unit in its name."""
    for name, info in subject.method.Params.model_fields.items():
        _require(info.description, f"parameter {name} has no description")
        _require(not info.is_required(), f"parameter {name} has no default")
        if info.annotation is float or info.annotation == (float | None):
            _require(
                re.search(rf"_({'|'.join(UNIT_SUFFIXES)})(_|$)", f"_{name}"),
                f"parameter {name} does not say its unit: end it with one of "
                f"{', '.join(UNIT_SUFFIXES)}",
            )


def parameters_round_trip(subject: Subject) -> None:
    """Parameters survive JSON, are frozen, and unknown keys are refused."""
    model = subject.method.Params
    params = model(**subject.witness.trial.params)
    text = json.dumps(params.model_dump(mode="json"), allow_nan=False)
    _require(model.model_validate_json(text) == params, f"parameters change through JSON: {text}")
    _require(model.model_config.get("frozen"), "parameters are not frozen")
    try:
        model.model_validate({"no_such_parameter": 1})
    except ValidationError:
        return
    raise AssertionError("an unknown parameter is accepted in silence")


def outputs_are_valid(subject: Subject) -> None:
    """Outputs have the declared types and survive storing; metrics carry units."""
    run = subject.witness.first.run
    for name, port in port_specs(subject.method.Out).items():
        product = run.outputs.get(name)
        _require(product is not None or not port.required, f"output {name} is missing")
        if product is None:
            continue
        _require(
            product.type_name == port.type_name,
            f"output {name} is a {product.type_name}, declared is {port.type_name}",
        )
        again = type(product).from_payload(product.to_payload())
        _require(digest_of(again) == run.digests[name], f"output {name} changes when stored")
    for metric in run.metrics:
        _require(metric.unit, f"metric {metric.name} has no unit (`1` for counts and shares)")


def inputs_stay_untouched(subject: Subject) -> None:
    """No array of an input is written to."""
    for name in subject.witness.first.changed_inputs:
        raise AssertionError(f"input {name} was changed")


def global_state_stays_untouched(subject: Subject) -> None:
    """Numpy's global generator is not used."""
    _require(
        not subject.witness.first.drew_globally,
        "the method draws from numpy's global generator, not from ctx.rng",
    )


def nothing_is_written_outside_scratch(subject: Subject) -> None:
    """Working directory, home and temporary folder stay empty."""
    strays = subject.witness.elsewhere.strays
    _require(not strays, f"files were written outside the scratch folder: {', '.join(strays)}")


def results_repeat(subject: Subject) -> None:
    """Same seed, same digest: in this process and in a new one, elsewhere, with another hash seed.

    With determinism `loose` only the types of the outputs have to agree.
    """
    witness = subject.witness
    first, second, elsewhere = witness.first.run, witness.again, witness.elsewhere
    exact = subject.method.determinism != "loose"
    for name, digest in first.digests.items():
        _require(
            not exact or second.digests[name] == digest,
            f"output {name} differs between two runs with one seed in one process",
        )
        _require(
            name in elsewhere.digests and (not exact or elsewhere.digests[name] == digest),
            f"output {name} differs in a new process with another working directory and hash seed",
        )


def threads_do_not_show(subject: Subject) -> None:
    """One core or two give the same digest."""
    one, two = subject.witness.first.run, subject.witness.on_two_cores
    for name, digest in one.digests.items():
        _require(two.digests[name] == digest, f"output {name} depends on the number of cores")


def _cloud_ports(method: type[Method]) -> Iterator[str]:
    yield from (name for name, port in port_specs(method.In).items() if port.type_name == "cloud")


def _refuses(subject: Subject, cloud: PointCloud, what: str) -> None:
    for port in _cloud_ports(subject.method):
        try:
            subject.run_on(f"{port}-{what}", **{port: cloud})
        except OrthoflowError as error:
            _require(str(error).strip(), f"a cloud with {what} is refused without a word")
        except Exception as error:
            raise AssertionError(
                f"a cloud with {what} ends in {type(error).__name__}, not in an OrthoflowError: "
                f"{error}"
            ) from error
        else:
            raise AssertionError(f"a cloud with {what} is accepted in silence")


def empty_cloud_is_refused(subject: Subject) -> None:
    """A cloud without points ends in an OrthoflowError."""
    _refuses(subject, few_points(np.zeros((0, 3))), "no points")


def single_point_is_refused(subject: Subject) -> None:
    """A cloud of one point ends in an OrthoflowError."""
    _refuses(subject, few_points(np.ones((1, 3))), "one point")


def nan_is_refused(subject: Subject) -> None:
    """A cloud with a coordinate that is not a number ends in an OrthoflowError."""
    cloud, _ = example_room(n_points=5000)
    y = cloud.y.copy()
    y[100] = np.nan
    fields = {name: value for name, value in vars(cloud).items() if name != "y"}
    _refuses(subject, PointCloud(y=y, **fields), "NaN coordinates")


def planes_follow_a_rigid_motion(subject: Subject) -> None:
    """Planes of a room turned about up and shifted are the planes, turned and shifted.

    Tolerances: 0.02 deg and 1 mm, far above the fit's own noise (2 mm / sqrt(n)) and far below
    what a method that thinks in axes or loses digits would show.
    """
    shift = np.array([634512.347, 486215.781, 112.193])
    for turned_deg, moved_by in ((0.0, shift), (33.0, np.zeros(3)), (191.7, shift)):
        cloud, truth = example_room(turned_deg=turned_deg, shift_m=moved_by)
        run = subject.run_on(f"turned{turned_deg}{moved_by[0]}", cloud=cloud)
        planes = run.outputs["planes"]
        _require(isinstance(planes, Planes) and len(planes) > 0, "no plane was found")
        if isinstance(planes, Planes):
            _match_planes(planes, truth)


def _match_planes(found: Planes, truth: Planes) -> None:
    for index in range(len(found)):
        cosines = truth.normal @ found.normal[index]
        centres = truth.corners.mean(axis=1)
        gaps_m = np.abs(centres @ found.normal[index] - found.offset[index])
        angles_deg = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
        fits = (angles_deg < 0.02) & (gaps_m < 0.001)
        _require(
            bool(fits.any()),
            f"plane {index} of a moved room is {angles_deg.min():.3f} deg and "
            f"{1000 * gaps_m[np.argmin(angles_deg)]:.2f} mm from the nearest true plane",
        )


def _always(method: type[Method]) -> bool:
    return True


def _is_reproducible(method: type[Method]) -> bool:
    return method.determinism != "loose"


def _takes_a_cloud(method: type[Method]) -> bool:
    return any(True for _ in _cloud_ports(method))


def _finds_planes(method: type[Method]) -> bool:
    return method.id.startswith("plane.") and method.id != "plane.given"


def _check(run: Callable[[Subject], None], applies: Callable[[type[Method]], bool]) -> Check:
    rule = (run.__doc__ or "").partition("\n")[0]
    return Check(name=run.__name__.replace("_", "-"), rule=rule, run=run, applies=applies)


CHECKS: Final[tuple[Check, ...]] = (
    _check(parameters_are_documented, _always),
    _check(parameters_round_trip, _always),
    _check(outputs_are_valid, _always),
    _check(inputs_stay_untouched, _always),
    _check(global_state_stays_untouched, _always),
    _check(nothing_is_written_outside_scratch, _always),
    _check(results_repeat, _always),
    _check(threads_do_not_show, _is_reproducible),
    _check(empty_cloud_is_refused, _takes_a_cloud),
    _check(single_point_is_refused, _takes_a_cloud),
    _check(nan_is_refused, _takes_a_cloud),
    _check(planes_follow_a_rigid_motion, _finds_planes),
)
