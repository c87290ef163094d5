"""Every mistake that a workflow file can hold, as its user reads it.

The snapshots hold what is printed: place, path, message and the line. Review them as text.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from syrupy.assertion import SnapshotAssertion

from orthoflow.catalog.catalog import Catalog
from orthoflow.sdk import MetricSpec
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.source import InvalidWorkflowError
from tests.laboratories import GOOD, with_steps

# Behind `x: {use: plane.hough2d, in: {cloud: cloud.cloud}`.
CALLS = [
    ", params: {repeat: 3}",
    ", params: {cel_m: 1}",
    ", params: {cell_m: -0.02}",
    ", params: {cell_m: .inf}",
    ", params: {cell_m: 0.06}",
    ", params: {normal: [1, 0, up]}",
    ", params: {cell_m: [0.02]}",
    ", params: {limits: {low_m: true}}",
    ", params: [1]",
    ", repeat: often",
    ', timeout: "30"',
    ", resources: {core: 2}",
    ", resources: {cores: 0}",
    ", unless: cloud.cloud",
    ", if: inputs.scam",
    ", cell_m: 1",
]
STEPS = [
    "x: {use: plane.ransac, in: {cloud: cloud.cloud}, params: {tolerance_m: yes}}",
    "x: {use: , in: {cloud: cloud.cloud}}",
    "x: plane.hough2d",
    "inputs: {use: simulate.room}",
    "nul: {use: simulate.room}",
    "x: {use: plane.hough2d, in: {cloud: cloud.cloud, clouds: cloud.cloud}}",
    "x: {use: plane.hough2d, in: {cloud: cloud}}",
    "x: {use: plane.hough2d, in: {cloud: []}}",
    "x: {use: plane.hough2d, in: {cloud: clud.cloud}}",
    "x: {use: read.photos, in: {files: inputs.scans}}",
    "x: {use: plane.hough2d, in: {cloud: [cloud.clouds]}}",
    "x: {use: plane.hough2d, in: {cloud: inputs.scan}}",
    "x: {use: read.photos, in: {files: cloud.cloud}}",
    (
        "x: {use: match.guided, in: {photos: y.photos, walls: z.walls, cameras: x.ties}}\n"
        "y: {use: simulate.room}\n"
        "z: {use: raster.grid, in: {cloud: cloud.cloud, planes: p.planes}}\n"
        "p: {use: plane.hough2d, in: {cloud: cloud.cloud}}"
    ),
    "x: {in: {cloud: cloud.cloud}, params: {cell_m: 1}, variants: {a: {use: plane.hough2d}}}",
    "x: {in: {cloud: cloud.cloud}, variants: {}}",
    "x: {in: {cloud: cloud.cloud}, variants: {a: {use: plane.hough2d}, b: {use: orient.pnp}}}",
    "x: {variants: {a: {use: simulate.room}}}",
    "x: {variants: {a: {use: plane.hough2d, in: {cloud: cloud.cloud}}}}",
    "x: !python {use: simulate.room}",
    "3: {use: simulate.room}",
    "a: {use: plain.hough2d}\nb: {use: plane.hough2d, in: {cloud: a.cloud}}",
    (
        "p: {use: plane.unheard-of, in: {cloud: cloud.cloud}}\n"
        "w: {use: raster.grid, in: {cloud: cloud.cloud, planes: p.planes}}"
    ),
]
# Before the steps.
HEADS = [
    "name: flow\n",
    "orthoflow: 2\n",
    "orthoflow: new\n",
    "orthoflow: 1\nseed: -1\n",
    "orthoflow: 1\nname: a b\n",
    "orthoflow: 1\ninputs: {scan: a.e57}\n",
    "orthoflow: 1\ninputs: {scan: {files: []}}\n",
    "orthoflow: 1\ninputs: {scan: {optional: no}}\n",
    "orthoflow: 1\n<<: {seed: 1}\n",
]
COMPARISONS = [
    "{desing: product}",
    "{design: one-at-time}",
    "{baseline: {plain: ransac}}",
    "{baseline: {plane: ransak}}",
    "{exclude: {plane: ransac}}",
    "{exclude: [{plane: ransac, orient: dlt}]}",
    "{exclude: [{}]}",
    "{baseline: {plane: ransac}, exclude: [{plane: ransac}]}",
    "{metrics: [rms_mm]}",
    "{metrics: [plan.rms_mm]}",
]
NO_STEPS = [
    "orthoflow: 1\n",
    "orthoflow: 1\nsteps: {}\n",
    # Nothing more is reported of what names steps.
    "orthoflow: 1\nstep: {x: 1}\ncompare: {baseline: {plane: a}}\n",
]
CALL = "x: {use: plane.hough2d, in: {cloud: cloud.cloud}%s}"
ROOM = "steps: {room: {use: simulate.room}}\n"
MISTAKES = {
    **{more: with_steps(CALL % more) for more in CALLS},
    **{steps: with_steps(steps) for steps in STEPS},
    **{head: head + ROOM for head in HEADS},
    **{one: GOOD[: GOOD.index("compare:")] + f"compare: {one}\n" for one in COMPARISONS},
    **{text: text for text in NO_STEPS},
}
UNREADABLE = {
    "unclosed bracket": "steps: [1",
    "tab": "orthoflow: 1\n\tsteps: 2\n",
    "no space behind a colon": "steps:\n  x:\n    use:plane.hough2d\n    in: {}\n",
    "undefined alias": "steps: *nothing\n",
    "two documents": "a: 1\n---\nb: 2\n",
    "control character": "orthoflow: 1\nname: a\x01\n",
    "empty": "",
    "list": "- a\n",
    "deep nesting": "[" * 100 + "]" * 100,
    "very deep nesting": "[" * 3000,
    "a value inside itself": "a: &x [*x]\n",
    "deep nesting through anchors": "a0: &a0 [x]\n"
    + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 70)),
    "many values": "- x\n" * 12_000,
    "YAML 1.1": "%YAML 1.1\n---\na: 1\n",
    "anchor bomb": (
        "a: &a [x,x,x,x,x,x,x,x,x,x]\n"
        "b: &b [*a,*a,*a,*a,*a,*a,*a,*a,*a,*a]\n"
        "c: &c [*b,*b,*b,*b,*b,*b,*b,*b,*b,*b]\n"
        "d: &d [*c,*c,*c,*c,*c,*c,*c,*c,*c,*c]\n"
    ),
}


@pytest.mark.parametrize("case", [*MISTAKES, *UNREADABLE])
def test_each_mistake_is_reported_at_its_place(
    case: str, catalog: Catalog, write: Path, snapshot: SnapshotAssertion
) -> None:
    text = (MISTAKES | UNREADABLE)[case]
    write.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidWorkflowError) as caught:
        load_workflow(write, catalog)
    lines = text.splitlines()
    for problem in caught.value.problems:
        assert problem.text == (lines[problem.line - 1] if lines else "")
    assert str(caught.value) == snapshot


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
