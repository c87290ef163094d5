"""The rules: what every method must keep, one function each."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import ValidationError

from orthoflow.engine.store import digest_of
from orthoflow.errors import OrthoflowError
from orthoflow.products import InputFiles, Planes, PointCloud, Product
from orthoflow.sdk import Method, port_specs
from orthoflow.testing.examples import example_room, few_points
from orthoflow.testing.isolation import run_elsewhere
from orthoflow.testing.trials import Trial, TrialRun, run_trial

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
        method: the class.
        inputs: port -> product.
        params: parameters that differ from the defaults.
        folder: empty, for the check to use.
    """

    method: type[Method]
    inputs: Mapping[str, Product | InputFiles]
    params: Mapping[str, object]
    folder: Path

    def trial(self, **changes: object) -> Trial:
        """Give the run of the method on the subject's inputs, with changes."""
        wanted: dict[str, object] = {
            "method": self.method,
            "inputs": self.inputs,
            "params": self.params,
            **changes,
        }
        return Trial(**wanted)  # type: ignore[arg-type]  # names and types are those of Trial

    def run(self, name: str = "scratch", **changes: object) -> TrialRun:
        """Run it in a scratch folder of the given name."""
        return run_trial(self.trial(**changes), self.folder / name)


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
    params = model(**subject.params)
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
    run = subject.run()
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
    before = _input_digests(subject)
    subject.run()
    for name, digest in _input_digests(subject).items():
        _require(digest == before[name], f"input {name} was changed")


def global_state_stays_untouched(subject: Subject) -> None:
    """Numpy's global generator is not used."""
    before = repr(np.random.get_state())  # noqa: NPY002 - it is the global one that is watched
    subject.run()
    after = repr(np.random.get_state())  # noqa: NPY002
    _require(before == after, "the method draws from numpy's global generator, not from ctx.rng")


def nothing_is_written_outside_scratch(subject: Subject) -> None:
    """Working directory, home and temporary folder stay empty."""
    elsewhere = run_elsewhere(subject.trial(), subject.folder)
    _require(
        not elsewhere.strays,
        f"files were written outside the scratch folder: {', '.join(elsewhere.strays)}",
    )


def results_repeat(subject: Subject) -> None:
    """Same seed, same digest: in this process and in a new one, elsewhere, with another hash seed.

    With determinism `loose` only the types of the outputs have to agree.
    """
    first = subject.run("first")
    second = subject.run("second")
    elsewhere = run_elsewhere(subject.trial(), subject.folder)
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
    one = subject.run("one", cores=1)
    two = subject.run("two", cores=2)
    for name, digest in one.digests.items():
        _require(two.digests[name] == digest, f"output {name} depends on the number of cores")


def _cloud_ports(method: type[Method]) -> Iterator[str]:
    yield from (name for name, port in port_specs(method.In).items() if port.type_name == "cloud")


def _refuses(subject: Subject, cloud: PointCloud, what: str) -> None:
    for port in _cloud_ports(subject.method):
        try:
            subject.run(f"{port}-{what}", inputs={**subject.inputs, port: cloud})
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
        run = subject.run(f"turned{turned_deg}{moved_by[0]}", inputs={"cloud": cloud})
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


def _input_digests(subject: Subject) -> dict[str, str]:
    return {
        name: digest_of(product)
        for name, product in subject.inputs.items()
        if isinstance(product, Product)
    }


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
