"""`--set` and `--input`: parameters and files from the command line."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pydantic import Field, ValidationError, field_validator

from orthoflow.catalog.catalog import Catalog
from orthoflow.errors import ArgumentError, PluginError
from orthoflow.files.yaml_positions import Position
from orthoflow.sdk import MethodParams
from orthoflow.workflow import parameters as module
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.problems import InvalidArgumentsError, InvalidWorkflowError, ProblemLog
from tests.laboratories import (
    GOOD,
    load,
)

SETS = {
    "plain": ("wall.gsd_m=0.002", "wall", "", "gsd_m", 0.002),
    "method name of a step without variants": ("wall.grid.gsd_m=2", "wall", "", "gsd_m", 2.0),
    "variant": ("plane.ransac.iterations=7", "plane", "ransac", "iterations", 7),
    "list": ("plane.hough2d.normal=[1, 0, 0]", "plane", "hough2d", "normal", [1.0, 0.0, 0.0]),
    "text with a minus": ("cloud.up=-x", "cloud", "", "up", "-x"),
    "text that YAML 1.1 takes for a flag": ("cloud.up=y", "cloud", "", "up", "y"),
    "inside a mapping": (
        "plane.hough2d.limits.low_m=0.5",
        "plane",
        "hough2d",
        "limits",
        {"low_m": 0.5, "high_m": 1.0},
    ),
    "inside a mapping of whoever has it": (
        "plane.limits.low_m=0.5",
        "plane",
        "hough2d",
        "limits",
        {"low_m": 0.5, "high_m": 1.0},
    ),
}


@pytest.mark.parametrize("case", SETS)
def test_set_overrides_a_parameter_and_is_kept(case: str, catalog: Catalog, write: Path) -> None:
    text, step, variant, parameter, value = SETS[case]
    workflow = load(GOOD, write, catalog, text)
    assert workflow.steps[step].variant(variant).params[parameter] == value
    assert parameter in workflow.steps[step].variant(variant).params_set
    assert workflow.overrides == (f"--set {text}",)


def test_set_without_variant_reaches_every_variant_that_has_the_parameter(
    catalog: Catalog, write: Path
) -> None:
    plane = load(GOOD, write, catalog, "plane.tolerance_m=0.5").steps["plane"]
    assert [variant.params["tolerance_m"] for variant in plane.variants] == [0.5, 0.5]
    plane = load(GOOD, write, catalog, "plane.iterations=5").steps["plane"]
    assert plane.variant("ransac").params["iterations"] == 5
    assert "iterations" not in plane.variant("hough2d").params_set


def test_parameters_that_disagree_are_told_where_the_method_stands(
    catalog: Catalog, write: Path
) -> None:
    text = GOOD.replace("use: plane.hough2d, params: {cell_m: 0.02}", "use: plane.hough2d")
    with pytest.raises(InvalidWorkflowError) as caught:
        load(text, write, catalog, "plane.hough2d.cell_m=0.06")
    (problem,) = caught.value.problems
    line = 1 + text.splitlines().index("      hough2d: {use: plane.hough2d}")
    assert (problem.line, problem.path) == (line, "steps.plane.variants.hough2d.params")
    assert problem.message.endswith("cell_m 0.06 must not exceed tolerance_m")


def test_a_parameter_without_a_default_is_asked_for() -> None:
    class Params(MethodParams):
        height_m: float = Field(description="Height.")

    with pytest.raises(ValidationError) as caught:
        Params.model_validate({})
    told: Any = SimpleNamespace(id="plane.level")
    reporter = module._Reporter(
        variant=told, info=told, as_set={}, reports={}, log=told, blame=None
    )
    (details,) = caught.value.errors()
    assert reporter._message(details) == "plane.level needs parameter height_m"


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ({"near": [1, 2, 3]}, "near is written [[x, y, z], ...], got [1, 2, 3]"),
        ({"near": 5}, "near is written [[x, y, z], ...], got 5"),
        ({"near": [[1, 2, "a"]]}, 'near[0][2]: input should be a valid number, got the text "a"'),
        (
            {"crop": [0, 0, 2]},
            "crop is written [number, number, number, number] or [[number, number], ...], got [0,",
        ),
        ({"ink": {"a": 1, "b": 2}}, 'ink is written {name: [number, number], ...}, got {"a": 1'),
    ],
)
def test_a_list_of_another_form_is_one_problem(value: dict[str, Any], told: str) -> None:
    class Params(MethodParams):
        near: tuple[tuple[float, float, float], ...] = Field((), description="At [[x, y, z], ...].")
        crop: tuple[float, float, float, float] | tuple[tuple[float, float], ...] | None = Field(
            None, description="Part."
        )
        ink: dict[str, tuple[float, float]] = Field(default_factory=dict, description="Inks.")

    problems: list[str] = []
    draft: Any = SimpleNamespace(
        params=None, info=SimpleNamespace(id="a.b", method=SimpleNamespace(Params=Params))
    )
    ((key, given),) = value.items()
    override = module.Override(report=problems.append, keys=(key,), value=given)
    module.resolve_params(draft, [override], ProblemLog(file="flow.yaml", lines=("x",)))
    (problem,) = problems
    assert problem.startswith(told)


def test_a_validator_that_fails_is_a_fault_of_its_plugin() -> None:
    class Params(MethodParams):
        height_m: float = Field(1.0, description="Height.")

        @field_validator("height_m")
        @classmethod
        def _fails(cls, _value: float) -> float:
            raise RuntimeError("the moon is full")

    log = ProblemLog(file="flow.yaml", lines=("x",))
    draft: Any = SimpleNamespace(
        params=None,
        info=SimpleNamespace(id="plane.level", method=SimpleNamespace(Params=Params)),
        position=Position(line=1, column=1),
        path="steps.x",
    )
    override = module.Override(report=lambda _: None, keys=("height_m",), value=2.0)
    found = module.resolve_params(draft, [override], log)
    assert (found.resolved, found.as_set) == ({}, {"height_m": 2.0})
    with pytest.raises(
        PluginError, match=r"checking the parameters of plane\.level failed: .*moon"
    ):
        log.raise_any()


def test_the_last_of_two_sets_wins_and_can_mend_a_value_of_the_file(
    catalog: Catalog, write: Path
) -> None:
    text = GOOD.replace("gsd_m: 1", "gsd_m: -1")
    workflow = load(text, write, catalog, "wall.gsd_m=2", "wall.gsd_m=3")
    assert workflow.steps["wall"].variants[0].params == {"gsd_m": 3.0}


BAD_SETS = {
    "wal.gsd_m=1": "there is no step wal (did you mean wall?); steps: cloud",
    "wall.gsd=1": "there is no parameter gsd in raster.grid (did you mean gsd_m?); known: gsd_m",
    "plane.ransak.iterations=1": "step plane has no variant ransak (did you mean ransac?); it has",
    "plane.depth=1": "no parameter depth in plane.hough2d or plane.ransac; known: cell_m, iter",
    "wall.gsd_m": "expected step.parameter=value or step.variant.parameter=value",
    "gsd_m=1": "expected step.parameter=value or step.variant.parameter=value",
    "wall.gsd_m=": "expected a value behind the equals sign",
    "wall.gsd_m=[1": "the value cannot be read as YAML: this is not YAML",
    "wall.gsd_m=-1": "input should be greater than 0, got -1",
    'wall.gsd_m="1"': 'a valid number, got the text "1"; write it without quotes',
    "plane.ransac.tolerance_m.x=1": "tolerance_m is no mapping, so nothing in it can be set",
}


@pytest.mark.parametrize("text", BAD_SETS)
def test_a_set_that_does_not_fit_is_refused(text: str, catalog: Catalog, write: Path) -> None:
    with pytest.raises(ArgumentError) as caught:
        load(GOOD, write, catalog, text)
    assert isinstance(caught.value, InvalidArgumentsError)
    assert str(caught.value).startswith(f"--set {text}: ")
    assert BAD_SETS[text] in str(caught.value)


def test_all_options_that_do_not_fit_are_named_together(catalog: Catalog, write: Path) -> None:
    write.write_text(GOOD)
    with pytest.raises(InvalidArgumentsError) as caught:
        load_workflow(
            write, catalog, sets=["wal.x=1", "wall.gsd=1"], inputs=["scam=a", "scan", "=b"]
        )
    assert [problem.file for problem in caught.value.problems] == [
        "--input scan",
        "--input =b",
        "--input scam=a",
        "--set wal.x=1",
        "--set wall.gsd=1",
    ]
    assert "there is no input scam (did you mean scan?)" in str(caught.value)
    assert "--input scan: expected NAME=PATH" in str(caught.value)
