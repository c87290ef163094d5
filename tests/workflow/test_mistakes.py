"""Every mistake that a workflow file can hold, and the sentence it gets."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.sdk import MetricSpec
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.problems import InvalidWorkflowError
from tests.laboratories import (
    GOOD,
    problems,
    with_steps,
)

# What stands behind `x: {use: plane.hough2d, in: {cloud: cloud.cloud}`; the place in it; words.
CALLS = [
    (", params: {repeat: 3}", ".params.repeat", "(repeat belongs beside params, not in it)"),
    (", params: {cel_m: 1}", ".params.cel_m", "(did you mean cell_m?)"),
    (", params: {cell_m: -0.02}", ".params.cell_m", "greater than 0, go"),
    (", params: {cell_m: .inf}", ".params.cell_m", "a finite number, g"),
    (", params: {cell_m: 0.06}", ".params", "cell_m 0.06 must not"),
    (", params: {normal: [1, 0, up]}", ".params.normal[2]", "a valid number, go"),
    (", params: {cell_m: [0.02]}", ".params.cell_m", "a valid number, go"),
    (", params: {limits: {low_m: true}}", ".params.limits.low_m", "a valid number, go"),
    (", params: [1]", ".params", "a mapping, got a l"),
    (", repeat: often", ".repeat", "a whole number, go"),
    (', timeout: "30"', ".timeout", "write it without quotes"),
    (", resources: {core: 2}", ".resources.core", "(did you mean cores?)"),
    (", resources: {cores: 0}", ".resources.cores", "greater than or eq"),
    (", unless: cloud.cloud", ".unless", "an input such as i"),
    (", if: inputs.scam", ".if", "(did you mean scan?)"),
    (", cell_m: 1", ".cell_m", "belong in params"),
]
STEPS = [
    (
        "x: {use: plane.ransac, in: {cloud: cloud.cloud}, params: {tolerance_m: yes}}",
        "x.params.tolerance_m",
        "a valid number or",
    ),
    ("x: {use: , in: {cloud: cloud.cloud}}", "x", "needs the key use, a"),
    ("x: plane.hough2d", "x", "a mapping, got the"),
    ("inputs: {use: simulate.room}", "inputs", "a step cannot be called"),
    ("nul: {use: simulate.room}", "nul", "'nul' cannot be a name: a"),
    (
        "x: {use: plane.hough2d, in: {cloud: cloud.cloud, clouds: cloud.cloud}}",
        "x.in.clouds",
        "(did you mean cloud?)",
    ),
    ("x: {use: plane.hough2d, in: {cloud: cloud}}", "x.in.cloud", "step.port or input"),
    ("x: {use: plane.hough2d, in: {cloud: []}}", "x.in.cloud", "list should have at least"),
    ("x: {use: plane.hough2d, in: {cloud: clud.cloud}}", "x.in.cloud", "(did you mean cloud?)"),
    ("x: {use: read.photos, in: {files: inputs.scans}}", "x.in.files", "(did you mean scan?)"),
    (
        "x: {use: plane.hough2d, in: {cloud: [cloud.clouds]}}",
        "x.in.cloud[0]",
        "(did you mean cloud?)",
    ),
    ("x: {use: plane.hough2d, in: {cloud: inputs.scan}}", "x.in.cloud", "expected the product"),
    ("x: {use: read.photos, in: {files: cloud.cloud}}", "x.in.files", "expected files of an"),
    (
        (
            "x: {use: match.guided, in: {photos: y.photos, walls: z.walls, cameras: x.ties}}\n"
            "y: {use: simulate.room}\n"
            "z: {use: raster.grid, in: {cloud: cloud.cloud, planes: p.planes}}\n"
            "p: {use: plane.hough2d, in: {cloud: cloud.cloud}}"
        ),
        "x.in.cameras",
        "the steps form a cycle: x",
    ),
    (
        "x: {in: {cloud: cloud.cloud}, params: {cell_m: 1}, variants: {a: {use: plane.hough2d}}}",
        "x.params",
        "with variants, params",
    ),
    ("x: {in: {cloud: cloud.cloud}, variants: {}}", "x.variants", "expected at least one"),
    (
        "x: {in: {cloud: cloud.cloud}, variants: {a: {use: plane.hough2d}, b: {use: orient.pnp}}}",
        "x.variants.b.use",
        "variants of a step must",
    ),
    ("x: {variants: {a: {use: simulate.room}}}", "x.variants.a.use", "simulate.room is a"),
    (
        "x: {variants: {a: {use: plane.hough2d, in: {cloud: cloud.cloud}}}}",
        "x.variants.a.in",
        "belong in params",
    ),
    ("x: !python {use: simulate.room}", "x", "tags are not allowed"),
    ("3: {use: simulate.room}", "", "a key must be text, got 3"),
]
CALL = "x: {use: plane.hough2d, in: {cloud: cloud.cloud}%s}"
CASES = [*((CALL % more, f"x{path}", words) for more, path, words in CALLS), *STEPS]


@pytest.mark.parametrize(("steps", "path", "message"), CASES)
def test_each_mistake_in_a_step_is_named_at_its_place(
    steps: str, path: str, message: str, catalog: Catalog, write: Path
) -> None:
    found = problems(with_steps(steps), write, catalog)
    place = f"steps.{path}".rstrip(".")
    assert (place, True) in [(at, message in text) for _, _, at, text in found], found


HEADS = [
    (
        "name: flow\n",
        "orthoflow",
        "a workflow begins with",
    ),
    (
        "orthoflow: 2\n",
        "orthoflow",
        "the file has workflow",
    ),
    (
        "orthoflow: new\n",
        "orthoflow",
        "a whole number, go",
    ),
    (
        "orthoflow: 1\nseed: -1\n",
        "seed",
        "greater than or eq",
    ),
    (
        "orthoflow: 1\nname: a b\n",
        "name",
        "'a b' cannot be a name: a",
    ),
    (
        "orthoflow: 1\ninputs: {scan: a.e57}\n",
        "inputs.scan",
        "a mapping, got the",
    ),
    (
        "orthoflow: 1\ninputs: {scan: {files: []}}\n",
        "inputs.scan.files",
        "list should have at least",
    ),
    (
        "orthoflow: 1\ninputs: {scan: {optional: no}}\n",
        "inputs.scan.optional",
        "true or false, got",
    ),
    (
        "orthoflow: 1\n<<: {seed: 1}\n",
        "<<",
        "unknown key <<; known",
    ),
]


@pytest.mark.parametrize(("head", "path", "message"), HEADS)
def test_each_mistake_outside_the_steps_is_named_at_its_place(
    head: str, path: str, message: str, catalog: Catalog, write: Path
) -> None:
    [found] = problems(head + "steps: {room: {use: simulate.room}}\n", write, catalog)
    assert found[2] == path
    assert message in found[3]


@pytest.mark.parametrize(
    ("steps", "message"),
    [("", "a workflow needs the key steps"), ("steps: {}", "a workflow needs at least one step")],
)
def test_a_workflow_without_steps_is_refused(
    steps: str, message: str, catalog: Catalog, write: Path
) -> None:
    assert problems(f"orthoflow: 1\n{steps}\n", write, catalog)[0][2:] == ("steps", message)


def test_without_steps_nobody_is_told_of_each_that_is_not_there(
    catalog: Catalog, write: Path
) -> None:
    text = "orthoflow: 1\nstep: {x: 1}\ncompare: {baseline: {plane: a}}\n"
    assert [one[2] for one in problems(text, write, catalog)] == ["steps", "step"]


COMPARISONS = [
    ("{desing: product}", "desing", "(did you mean design?)"),
    ("{design: one-at-time}", "design", "(did you mean one-at-a-time?)"),
    ("{baseline: {plain: ransac}}", "baseline.plain", "(did you mean plane?)"),
    ("{baseline: {plane: ransak}}", "baseline.plane", "(did you mean ransac?)"),
    ("{exclude: {plane: ransac}}", "exclude", "a list, got a mapp"),
    ("{exclude: [{plane: ransac, orient: dlt}]}", "exclude[0].orient", "step orient has no"),
    ("{exclude: [{}]}", "exclude[0]", "mapping should have at"),
    (
        "{baseline: {plane: ransac}, exclude: [{plane: ransac}]}",
        "exclude",
        "the baseline contains the",
    ),
    ("{metrics: [rms_mm]}", "metrics[0]", "step.metric, * all"),
    ("{metrics: [plan.rms_mm]}", "metrics[0]", "(did you mean plane?)"),
]


@pytest.mark.parametrize(("section", "path", "message"), COMPARISONS)
def test_each_mistake_in_the_comparison_is_named_at_its_place(
    section: str, path: str, message: str, catalog: Catalog, write: Path
) -> None:
    text = GOOD[: GOOD.index("compare:")] + f"compare: {section}\n"
    [found] = problems(text, write, catalog)
    assert found[2] == f"compare.{path}"
    assert message in found[3]


def test_a_step_that_cannot_be_read_does_not_bring_problems_of_its_users(
    catalog: Catalog, write: Path
) -> None:
    steps = """
        plane: {use: plane.unheard-of, in: {cloud: cloud.cloud}}
        wall: {use: raster.grid, in: {cloud: cloud.cloud, planes: plane.planes}}
        """
    found = problems(with_steps(steps), write, catalog)
    assert [path for _, _, path, _ in found] == ["steps.plane.use"]


UNREADABLE = {
    "unclosed bracket": ("steps: [1", 1, "this is not YAML: the bracket [ that opens"),
    "tab": ("orthoflow: 1\n\tsteps: 2\n", 2, "this is not YAML: there is a tab here; indent"),
    "no space behind a colon": (
        "steps:\n  x:\n    use:plane.hough2d\n    in: {cloud: cloud.cloud}\n",
        3,
        "this is not YAML: put a space after the colon",
    ),
    "undefined alias": ("steps: *nothing\n", 1, "this is not YAML: found undefined alias"),
    "two documents": ("a: 1\n---\nb: 2\n", 2, "expected a single document"),
    "control character": ("orthoflow: 1\nname: a\x01\n", 2, "this is not YAML: unacceptable"),
    "empty": ("", 1, "the document is empty"),
    "list": ("- a\n", 1, "expected a mapping, got a list"),
    "deep nesting": ("[" * 100 + "]" * 100, 1, "nested deeper than 60 levels"),
    "very deep nesting": ("[" * 3000, 1, "nested deeper than 60 levels"),
    "a value inside itself": ("a: &x [*x]\n", 1, "the value contains itself through its anchor"),
    "deep nesting through anchors": (
        "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 70)),
        1,
        "nested deeper than 60 levels",
    ),
    "many values": ("- x\n" * 12_000, 10_000, "the document has more than 10000 values"),
    "YAML 1.1": ("%YAML 1.1\n---\na: 1\n", 1, "expected YAML 1.2"),
    "anchor bomb": (
        (
            "a: &a [x,x,x,x,x,x,x,x,x,x]\n"
            "b: &b [*a,*a,*a,*a,*a,*a,*a,*a,*a,*a]\n"
            "c: &c [*b,*b,*b,*b,*b,*b,*b,*b,*b,*b]\n"
            "d: &d [*c,*c,*c,*c,*c,*c,*c,*c,*c,*c]\n"
        ),
        1,
        "more than 10000 values once aliases are expanded",
    ),
}


@pytest.mark.parametrize("case", UNREADABLE)
def test_what_is_no_workflow_at_all_is_one_problem_with_its_line(
    case: str, catalog: Catalog, write: Path
) -> None:
    text, line, message = UNREADABLE[case]
    write.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidWorkflowError) as caught:
        load_workflow(write, catalog)
    (problem,) = caught.value.problems
    assert problem.line == line
    assert message in problem.message


def test_metrics_that_no_method_of_a_step_declares_are_refused(
    write: Path, catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    def asked(metrics: str) -> list[str]:
        text = GOOD.replace('[plane.rms_mm, "*.wall_s"]', metrics)
        write.write_text(text)
        try:
            load_workflow(write, catalog)
        except InvalidWorkflowError as error:
            return [f"{item.path}: {item.message}" for item in error.problems]
        return []

    # Where an author declares nothing, nothing is refused.
    assert asked("[plane.rmse_mm]") == []
    declared = {"plane.hough2d": ("rms_mm", "wall_[0-9]*_mm"), "plane.ransac": ("own_mm",)}
    for method, metrics in declared.items():
        monkeypatch.setattr(catalog.method(method).load(), "metrics", metrics)
    assert asked("[plane.own_mm, plane.wall_3_mm, plane.compile_s, 'plane.x_*']") == []
    whose = "`orthoflow plugins show METHOD` lists those of plane.hough2d, plane.ransac"
    assert asked("[plane.rsm_mm, 'plan*.depth', orient.rsm_mm]") == [
        f"compare.metrics[0]: step plane reports no metric rsm_mm (did you mean rms_mm?); {whose}",
        f"compare.metrics[1]: step plane reports no metric depth; {whose}",
    ]
    # Each where it stands in the list.
    text = GOOD.replace('"*.wall_s"]', "plane.rsm_mm, plane]")
    write.write_text(text)
    with pytest.raises(InvalidWorkflowError) as caught:
        load_workflow(write, catalog)
    lines = text.splitlines()
    shown = [lines[item.line - 1][item.column - 1 :] for item in caught.value.problems]
    assert shown == ["plane.rsm_mm, plane]", "plane]"]


def test_metrics_that_the_wiring_cannot_produce_are_refused(
    write: Path, catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    declared = (MetricSpec("n_photos"), MetricSpec("lens_[xy]_px", needs=("calibration",)))
    monkeypatch.setattr(catalog.method("read.photos").load(), "metrics", declared)

    def problem(metric: str, text: str = GOOD) -> str:
        write.write_text(text.replace("plane.rms_mm", metric))
        try:
            load_workflow(write, catalog)
        except InvalidWorkflowError as error:
            return "\n".join(f"{one.path}: {one.message}" for one in error.problems)
        return ""

    alone = GOOD.replace(", calibration: inputs.calibration", "")
    assert [problem(metric) for metric in ("shots.lens_x_px", "'shots.lens_*'")] == ["", ""]
    for metric in ("lens_x_px", "lens_*"):
        assert problem(f"'shots.{metric}'", alone).startswith(
            f"compare.metrics[0]: step shots reports {metric} only with calibration wired"
        )
    assert problem("'shots.*'", alone) == problem("'*.n_photos'", alone) == ""
    assert "step shots reports no metric depth_mm" in problem("shots.depth_mm")


def test_what_takes_from_a_step_of_an_unknown_kind_is_no_mistake_of_its_own(
    catalog: Catalog, write: Path
) -> None:
    steps = "a: {use: plain.hough2d}\nb: {use: plane.hough2d, in: {cloud: a.cloud}}"
    found = problems(with_steps(steps), write, catalog)
    assert [path for _, _, path, _ in found] == ["steps.a.use"]
