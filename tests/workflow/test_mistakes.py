"""Every mistake that a workflow file can hold, and the sentence it gets."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.sdk import MetricSpec
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.problems import (
    InvalidWorkflowError,
)
from tests.laboratories import (
    GOOD,
    problems,
    with_steps,
)

STEP = "x: {use: plane.hough2d, in: {cloud: cloud.cloud}%s}"
CASES = {
    "key of the call": (
        STEP % ", params: {repeat: 3}",
        "steps.x.params.repeat",
        "unknown parameter repeat (repeat belongs beside params, not in it); plane.hough2d has",
    ),
    "unknown parameter": (
        STEP % ", params: {cel_m: 1}",
        "steps.x.params.cel_m",
        (
            "unknown parameter cel_m (did you mean cell_m?); plane.hough2d has cell_m, "
            "tolerance_m, normal, limits"
        ),
    ),
    "parameter out of range": (
        STEP % ", params: {cell_m: -0.02}",
        "steps.x.params.cell_m",
        "input should be greater than 0, got -0.02",
    ),
    "not a finite number": (
        STEP % ", params: {cell_m: .inf}",
        "steps.x.params.cell_m",
        "input should be a finite number, got inf",
    ),
    "parameters that disagree": (
        STEP % ", params: {cell_m: 0.06}",
        "steps.x.params",
        "cell_m 0.06 must not exceed tolerance_m",
    ),
    "item of a list": (
        STEP % ", params: {normal: [1, 0, up]}",
        "steps.x.params.normal[2]",
        'input should be a valid number, got the text "up"',
    ),
    "none of several types": (
        "x: {use: plane.ransac, in: {cloud: cloud.cloud}, params: {tolerance_m: yes}}",
        "steps.x.params.tolerance_m",
        "input should be a valid number or 'auto', got the text \"yes\"",
    ),
    "list instead of a number": (
        STEP % ", params: {cell_m: [0.02]}",
        "steps.x.params.cell_m",
        "input should be a valid number, got a list",
    ),
    "mapping instead of a number": (
        STEP % ", params: {cell_m: {low_m: 0.02}}",
        "steps.x.params.cell_m",
        "input should be a valid number, got a mapping",
    ),
    "nested parameter": (
        STEP % ", params: {limits: {low_m: true}}",
        "steps.x.params.limits.low_m",
        "input should be a valid number, got true",
    ),
    "parameters are no mapping": (
        STEP % ", params: [1]",
        "steps.x.params",
        "expected a mapping, got a list",
    ),
    "repeat is no number": (
        STEP % ", repeat: often",
        "steps.x.repeat",
        'expected a whole number from 1 to 10000, got the text "often"',
    ),
    "timeout without unit": (
        STEP % ', timeout: "30"',
        "steps.x.timeout",
        'expected a time such as 90s, 30min, 2h or a number of seconds above 0, got the text "30"',
    ),
    "timeout zero": (STEP % ", timeout: 0", "steps.x.timeout", "expected a time such as"),
    "unknown resource": (
        STEP % ", resources: {core: 2}",
        "steps.x.resources.core",
        "unknown key core (did you mean cores?)",
    ),
    "no cores": (
        STEP % ", resources: {cores: 0}",
        "steps.x.resources.cores",
        "expected a whole number from 1 on, got 0",
    ),
    "unless a step": (
        STEP % ", unless: cloud.cloud",
        "steps.x.unless",
        'expected an input such as inputs.scan, got the text "cloud.cloud"',
    ),
    "if an unknown input": (
        STEP % ", if: inputs.scam",
        "steps.x.if",
        "there is no input scam (did you mean scan?)",
    ),
    "unless an unknown input": (
        STEP % ", unless: inputs.scam",
        "steps.x.unless",
        "there is no input scam (did you mean scan?)",
    ),
    "use without a value": ("x: {use: , in: {cloud: cloud.cloud}}", "steps.x", "needs the key use"),
    "parameter beside the others": (
        "x: {use: plane.hough2d, in: {cloud: cloud.cloud}, cell_m: 1}",
        "steps.x.cell_m",
        "timeout, in, if, unless, variants; parameters of the method belong in params",
    ),
    "no use": ("x: {in: {cloud: cloud.cloud}}", "steps.x", "needs the key use"),
    "use is no text": ("x: {use: 3}", "steps.x.use", "expected a text, got 3"),
    "step is no mapping": ("x: plane.hough2d", "steps.x", "expected a mapping, got the text"),
    "step called inputs": (
        "inputs: {use: simulate.room}",
        "steps.inputs",
        "a step cannot be called inputs",
    ),
    "name of a device": ("nul: {use: simulate.room}", "steps.nul", "'nul' cannot be a name"),
    "name in capitals": ("X: {use: simulate.room}", "steps.X", "'X' cannot be a name"),
    "unknown port": (
        "x: {use: plane.hough2d, in: {cloud: cloud.cloud, clouds: cloud.cloud}}",
        "steps.x.in.clouds",
        "plane.hough2d has no input port clouds (did you mean cloud?); it has cloud",
    ),
    "no reference": (
        "x: {use: plane.hough2d, in: {cloud: cloud}}",
        "steps.x.in.cloud",
        'expected step.port or inputs.name, got the text "cloud"',
    ),
    "empty list of references": (
        "x: {use: plane.hough2d, in: {cloud: []}}",
        "steps.x.in.cloud",
        "expected at least one reference, got an empty list",
    ),
    "unknown step": (
        "x: {use: plane.hough2d, in: {cloud: clud.cloud}}",
        "steps.x.in.cloud",
        "there is no step clud (did you mean cloud?); steps: cloud, x",
    ),
    "unknown input": (
        "x: {use: read.photos, in: {files: inputs.scans}}",
        "steps.x.in.files",
        "there is no input scans (did you mean scan?); inputs: scan",
    ),
    "unknown output port": (
        "x: {use: plane.hough2d, in: {cloud: [cloud.clouds]}}",
        "steps.x.in.cloud[0]",
        "step cloud has no output port clouds (did you mean cloud?); it has cloud",
    ),
    "files where a product is meant": (
        "x: {use: plane.hough2d, in: {cloud: inputs.scan}}",
        "steps.x.in.cloud",
        "expected the product cloud, but inputs.scan gives files of an input",
    ),
    "product of another type": (
        "x: {use: read.photos, in: {files: cloud.cloud}}",
        "steps.x.in.files",
        "expected files of an input, but cloud.cloud gives the product cloud",
    ),
    "step that feeds itself": (
        (
            "x: {use: match.guided, in: {photos: y.photos, walls: z.walls, cameras: x.ties}}\n"
            "y: {use: simulate.room}\n"
            "z: {use: raster.grid, in: {cloud: cloud.cloud, planes: p.planes}}\n"
            "p: {use: plane.hough2d, in: {cloud: cloud.cloud}}"
        ),
        "steps.x.in.cameras",
        "the steps form a cycle: x takes x.ties (line 6)",
    ),
    "params beside variants": (
        "x: {in: {cloud: cloud.cloud}, params: {cell_m: 1}, variants: {a: {use: plane.hough2d}}}",
        "steps.x.params",
        "with variants, params belongs in each of them",
    ),
    "no variants": (
        "x: {in: {cloud: cloud.cloud}, variants: {}}",
        "steps.x.variants",
        "expected at least one variant",
    ),
    "variants of two kinds": (
        "x: {in: {cloud: cloud.cloud}, variants: {a: {use: plane.hough2d}, b: {use: orient.pnp}}}",
        "steps.x.variants.b.use",
        "variants of a step must be of one kind, got orient beside plane",
    ),
    "variants of a source": (
        "x: {variants: {a: {use: simulate.room}}}",
        "steps.x.variants.a.use",
        "simulate.room is a source, and sources take no variants; give it a step",
    ),
    "in of a variant": (
        "x: {variants: {a: {use: plane.hough2d, in: {cloud: cloud.cloud}}}}",
        "steps.x.variants.a.in",
        "unknown key in",
    ),
    "a tag": ("x: !python {use: simulate.room}", "steps.x", "tags are not allowed"),
    "a key that is no text": ("3: {use: simulate.room}", "steps", "a key must be text, got 3"),
    "a key that is a list": ("? [a]\n: 1", "steps", "a key must be text, got a list or mapping"),
}


@pytest.mark.parametrize("case", CASES)
def test_each_mistake_in_a_step_is_named_at_its_place(
    case: str, catalog: Catalog, write: Path
) -> None:
    steps, path, message = CASES[case]
    found = problems(with_steps(steps), write, catalog)
    assert (path, True) in [(at, message in text) for _, _, at, text in found], found


HEADS = {
    "no format": ("name: flow\n", "orthoflow", "a workflow begins with orthoflow: 1"),
    "newer format": (
        "orthoflow: 2\n",
        "orthoflow",
        "the file has workflow format 2, this orthoflow reads 1; upgrade orthoflow",
    ),
    "format is no number": ("orthoflow: new\n", "orthoflow", "expected a whole number from 1 on"),
    "seed below zero": ("orthoflow: 1\nseed: -1\n", "seed", "expected a whole number from 0 on"),
    "name with blanks": ("orthoflow: 1\nname: a b\n", "name", "'a b' cannot be a name"),
    "input is no mapping": (
        "orthoflow: 1\ninputs: {scan: a.e57}\n",
        "inputs.scan",
        'expected a mapping, got the text "a.e57"',
    ),
    "files are numbers": (
        "orthoflow: 1\ninputs: {scan: {files: [a.e57, 3]}}\n",
        "inputs.scan.files[1]",
        "expected a text, got 3",
    ),
    "files are an empty list": (
        "orthoflow: 1\ninputs: {scan: {files: []}}\n",
        "inputs.scan.files",
        "expected at least one text, got an empty list",
    ),
    "optional is no flag": (
        "orthoflow: 1\ninputs: {scan: {optional: no}}\n",
        "inputs.scan.optional",
        'expected true or false, got the text "no"',
    ),
    "inputs are a list": (
        "orthoflow: 1\ninputs: [scan]\n",
        "inputs",
        "expected a mapping, got a list",
    ),
    "merge key": ("orthoflow: 1\n<<: {seed: 1}\n", "<<", "unknown key <<"),
}


@pytest.mark.parametrize("case", HEADS)
def test_each_mistake_outside_the_steps_is_named_at_its_place(
    case: str, catalog: Catalog, write: Path
) -> None:
    head, path, message = HEADS[case]
    found = problems(head + "steps: {room: {use: simulate.room}}\n", write, catalog)
    assert len(found) == 1
    assert found[0][2] == path
    assert message in found[0][3]


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


COMPARISONS = {
    "unknown key": ("{desing: product}", "compare.desing", "(did you mean design?)"),
    "unknown design": (
        "{design: one-at-time}",
        "compare.design",
        "unknown design one-at-time (did you mean one-at-a-time?); known: product, one-at-a-time",
    ),
    "baseline of an unknown step": (
        "{baseline: {plain: ransac}}",
        "compare.baseline.plain",
        "there is no step plain with variants (did you mean plane?); with variants: plane, orient",
    ),
    "baseline of a step without variants": (
        "{baseline: {wall: a}}",
        "compare.baseline.wall",
        "there is no step wall with variants",
    ),
    "baseline names an unknown variant": (
        "{baseline: {plane: ransak}}",
        "compare.baseline.plane",
        "step plane has no variant ransak (did you mean ransac?); it has hough2d, ransac",
    ),
    "exclude is no list": (
        "{exclude: {plane: ransac}}",
        "compare.exclude",
        "expected a list of mappings step: variant, got a mapping",
    ),
    "exclude names an unknown variant": (
        "{exclude: [{plane: ransac, orient: dlt}]}",
        "compare.exclude[0].orient",
        "step orient has no variant dlt",
    ),
    "exclude is empty": ("{exclude: [{}]}", "compare.exclude[0]", "got an empty mapping"),
    "baseline is excluded": (
        "{baseline: {plane: ransac}, exclude: [{plane: ransac}]}",
        "compare.exclude",
        "the baseline contains the excluded combination {plane: ransac}; name another baseline",
    ),
    "metric without step": (
        "{metrics: [rms_mm]}",
        "compare.metrics[0]",
        'expected step.metric, * allowed, got the text "rms_mm"',
    ),
    "metric of an unknown step": (
        "{metrics: [plan.rms_mm]}",
        "compare.metrics[0]",
        "there is no step plan for plan.rms_mm (did you mean plane?)",
    ),
}


@pytest.mark.parametrize("case", COMPARISONS)
def test_each_mistake_in_the_comparison_is_named_at_its_place(
    case: str, catalog: Catalog, write: Path
) -> None:
    section, path, message = COMPARISONS[case]
    text = GOOD[: GOOD.index("compare:")] + f"compare: {section}\n"
    found = problems(text, write, catalog)
    assert len(found) == 1
    assert found[0][2] == path
    assert message in found[0][3]


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
