"""Every mistake that a user can make in a workflow, its options and its tables, as it is reported.

The snapshots hold what is printed: place, path, message and the line. Review them as text.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest
from pydantic import Field, field_validator
from syrupy.assertion import SnapshotAssertion

from orthoflow.catalog.catalog import Catalog
from orthoflow.errors import OrthoflowError
from orthoflow.sdk import MethodParams, MetricSpec
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.source import InvalidWorkflowError
from tests.laboratories import GOOD, ROOMS, SWEPT, load, with_steps

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
    (
        "a: {use: raster.grid, in: {cloud: a.cloud, planes: b.planes}}\n"
        "b: {use: plane.hough2d, in: {cloud: b.planes}}"
    ),
    "x: {in: {cloud: cloud.cloud}, params: {cell_m: 1}, variants: {a: {use: plane.hough2d}}}",
    "x: {in: {cloud: cloud.cloud}, variants: {}}",
    "x: {in: {cloud: cloud.cloud}, variants: {a: {use: plane.hough2d}, b: {use: orient.pnp}}}",
    "x: {variants: {a: {use: simulate.room}}}",
    "x: {variants: {a: {use: plane.hough2d, in: {cloud: cloud.cloud}}}}",
    "x: !python {use: simulate.room}",
    "3: {use: simulate.room}",
    '"": {in: {cloud: cloud.cloud}, variants: {a: ~, b: {use: plane.hough2d}}}',
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


# Options of the command line, behind `--set`.
BAD_SETS = [
    "wal.gsd_m=1",
    "wall.gsd=1",
    "plane.ransak.iterations=1",
    "plane.depth=1",
    "wall.gsd_m",
    "gsd_m=1",
    "wall.gsd_m=",
    "wall.gsd_m=[1",
    "wall.gsd_m=-1",
    'wall.gsd_m="1"',
    "plane.ransac.tolerance_m.x=1",
]
# In the place of a sweep, and behind `--set` of the swept workflow.
SWEEPS = [
    "{sweep: [0.02]}",
    "{sweep: 0.02}",
    "{sweep: [0.02, wide]}",
    "{sweep: [0.02, 0.05], step: 1}",
    "{sweep: [1, 0.02, 1.0]}",
    "[0.02, 0.05]",
    "{sweep: [0.02, 0.001]}",
]
SET_SWEEPS = [
    "plane.tolerance_m={sweep: [1]}",
    "plane.tolerance_m={sweep: [1, 2], to: 3}",
    "plane.tolerance_m={sweep: [1, 2, 1]}",
    "plane.tolerance_m=[1, 2]",
    "cloud.up={sweep: [x, z]}",
]
SEEDS = ["{sweep: [1, -2]}", "{sweep: [1, 2, 1]}", "{swep: [1, 2]}", "true"]
# Files of parameters.
SET_FILES = ["plane.celm: 1", "wall.gsd_m: fine", "wall: {gsd_m: 1}", "- 1", "wall.gsd_m: [1\n"]
# Behind the workflow of rooms.
MAPPINGS = [
    "datasets: {hall: {skan: a.e57}}",
    "datasets: {hall: {wall.gsd_m: 0.5}}",
    "datasets: {Hall: {}}",
    "datasets: {}",
    "datasets: [hall]",
    "datasets: {hall: hall.e57}",
    "datasets: {a: {}, a: {}}",
    "datasets: {hall: {scan: 5}}",
    "datasets: {hall: {set: {walls.gsd_m: 1}}}",
    "datasets: {hall: {set: {wall.gsd: 1}}}",
    "datasets: {hall: {set: {wall: 1}}}",
    "datasets: {hall: {set: {wall.gsd_m: -1}}}",
    "datasets: {hall: {set: {plane.hough2d.cell_m: 0.06}}}",
    "datasets: {hall: {set: {plane.hough2d.cell_m.deep: 1}}}",
    "datasets: nowhere.csv",
    "datasets: {hall: {}}\ncompare: {exclude: [{data: hal}]}",
    "datasets: {hall: {}}\ncompare: {baseline: {data: hall}}",
    *(f"datasets: {{a: {{set: {{seed: {seed}}}}}}}" for seed in ("-1", "1.5", "{sweep: [1, 1]}")),
]
TABLES = [
    "name,scans\nhall,a\nattic,b\n",
    "name,wall.gsd\nhall,1\nattic,1\n",
    "name,wall.gsd_m\nhall,1\nattic,-1\n",
    "name,wall.gsd_m\nhall,[1\n",
    "room,scan\nhall,a\n",
    "hall: {set: {wall.gsd_m: 1}}\n",
    "name,scan\n,a.e57\n",
    "name,scan\nhall,a\nhall,b\n",
    "name,scan\nGreat Hall,a\n",
    "name,scan,scan\nhall,a,b\n",
    "name,scan\nhall,a,b\n",
    'name,scan\nhall,"a\n',
    "# nothing\n",
    "name,scan\n",
]
SIX = """\
orthoflow: 1
name: flow
sede: 4
inputs:
  scan: {files: a.e57}
  scan: {files: b.e57}
steps:
  cloud: {use: read.scan, in: {files: inputs.scan}}
  plane: {use: plane.hough2d, in: {cloud: cloud.cloud}, params: {cell_m: "0.003"}}
  other: {use: plane.hugh2d, in: {cloud: cloud.cloud}}
  wall: {use: raster.grid, in: {cloud: cloud.cloud}}
  t: {use: match.guided, in: {photos: p.photos, walls: wall.walls, cameras: orient.cameras}}
  p: {use: read.photos, in: {files: inputs.scan}}
  orient: {use: orient.pnp, in: {photos: p.photos, ties: t.ties}}
"""
TWO = "datasets: {hall: {scan: hall.e57}, stairs: {scan: stairs.e57}}\n"
NEEDED = ROOMS.replace("scan: {optional: true}", "scan: {}").replace(", unless: inputs.scan", "")


def case(
    text: str, files: Mapping[str, str] = MappingProxyType({}), **options: object
) -> tuple[str, Mapping[str, str], dict[str, Any]]:
    """A workflow, files beside it, and the options that it is read with."""
    return text, files, options


SWEPT_SEED = SWEPT.replace("orthoflow: 1", "orthoflow: 1\nseed: {sweep: [1, 2]}")
CASES = {
    **{name: case(text) for name, text in (MISTAKES | UNREADABLE).items()},
    **{f"--set {one}": case(GOOD, sets=[one]) for one in BAD_SETS},
    **{f"swept --set {one}": case(SWEPT, sets=[one]) for one in SET_SWEEPS},
    **{f"swept {one}": case(SWEPT.replace("{sweep: [0.02, 0.05, 0.1]}", one)) for one in SWEEPS},
    **{f"seed {one}": case(f"orthoflow: 1\nseed: {one}\n{ROOM}") for one in SEEDS},
    **{f"file {one}": case(SWEPT, {"a.yaml": one}, set_files=["a.yaml"]) for one in SET_FILES},
    **{one: case(f"{ROOMS}{one}\n") for one in MAPPINGS},
    **{f"table {one}": case(ROOMS, {"a.csv": one}, datasets="a.csv") for one in TABLES},
    "table in the file": case(f"{ROOMS}datasets: a.csv\n", {"a.csv": TABLES[3]}),
    "swept for a dataset": case(f"{SWEPT}datasets: {{a: {{set: {{plane.tolerance_m: 0.5}}}}}}\n"),
    "a dataset without files": case(
        f"{NEEDED}datasets: {{hall: {{scan: hall.e57}}, made: {{}}}}\n"
    ),
    "a step called data": case(ROOMS.replace("shots", "data") + TWO),
    "a step called seed": case(SWEPT_SEED.replace("wall:", "seed:")),
    "unknown dataset": case(ROOMS + TWO, only_data=["hall,stair"]),
    "no datasets": case(ROOMS, only_data=["hall"]),
    "input of every dataset": case(ROOMS + TWO, inputs=["scan=attic.e57"]),
    "input of an unknown dataset": case(ROOMS + TWO, inputs=["scan@attic=attic.e57"]),
    "all options": case(GOOD, sets=["wal.x=1", "wall.gsd=1"], inputs=["scam=a", "scan", "=b"]),
    "no file of parameters": case(SWEPT, set_files=["nix.yaml"]),
    "a device as parameters": case(SWEPT, set_files=["/dev/zero"]),
    "six kinds at once": case(SIX),
}


@pytest.mark.parametrize("name", CASES)
def test_each_mistake_is_reported_at_its_place(
    name: str, catalog: Catalog, write: Path, snapshot: SnapshotAssertion
) -> None:
    text, files, options = CASES[name]
    for file, content in files.items():
        Path(file).write_text(content, encoding="utf-8")
    write.write_text(text, encoding="utf-8")
    with pytest.raises(OrthoflowError) as caught:
        load_workflow(write, catalog, **options)
    assert caught.value.exit_code == 2
    assert str(caught.value).replace(str(Path.cwd()), "FOLDER") == snapshot


class Params(MethodParams):
    near: tuple[tuple[float, float, float], ...] = Field((), description="At [[x, y, z], ...].")
    crop: tuple[float, float, float, float] | tuple[tuple[float, float], ...] | None = Field(
        None, description="Part."
    )
    ink: dict[str, tuple[float, float]] = Field(default_factory=dict, description="Inks.")
    height_m: float = Field(description="Height.")

    @field_validator("height_m")
    @classmethod
    def _fails(cls, value: float) -> float:
        if value == 13:
            raise RuntimeError("the moon is full")
        return value


@pytest.mark.parametrize(
    "params",
    [
        "{}",
        "{height_m: 1, near: [1, 2, 3]}",
        "{height_m: 1, near: [[1, 2, a]]}",
        "{height_m: 1, crop: [0, 0, 2]}",
        "{height_m: 1, ink: {a: 1}}",
        "{height_m: 13}",
    ],
)
def test_what_is_wrong_with_a_parameter_is_one_problem(
    params: str,
    catalog: Catalog,
    write: Path,
    monkeypatch: pytest.MonkeyPatch,
    snapshot: SnapshotAssertion,
) -> None:
    monkeypatch.setattr(catalog.method("plane.hough2d").load(), "Params", Params)
    text = with_steps(f"x: {{use: plane.hough2d, in: {{cloud: cloud.cloud}}, params: {params}}}")
    with pytest.raises(OrthoflowError) as caught:
        load(text, write, catalog)
    assert str(caught.value) == snapshot


def refused(text: str, path: Path, catalog: Catalog) -> list[str]:
    """What is reported of a workflow; nothing where it is right."""
    try:
        load(text, path, catalog)
    except InvalidWorkflowError as error:
        return [
            f"{one.path}: {one.message} at {one.text[one.column - 1 :]}" for one in error.problems
        ]
    return []


def test_metrics_that_no_method_of_a_step_declares_are_refused(
    write: Path, catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    def asked(metrics: str) -> list[str]:
        text = GOOD.replace('[plane.rms_mm, "*.wall_s"]', f"[{metrics}]")
        return refused(text, write, catalog)

    # Where an author declares nothing, nothing is refused.
    assert asked("plane.rmse_mm") == []
    declared = {"plane.hough2d": ("rms_mm", "wall_[0-9]*_mm"), "plane.ransac": ("own_mm",)}
    for method, metrics in declared.items():
        monkeypatch.setattr(catalog.method(method).load(), "metrics", metrics)
    assert asked("plane.own_mm, plane.wall_3_mm, plane.compile_s, 'plane.x_*'") == []
    whose = "to list its metrics, run `orthoflow plugins show` with plane.hough2d, plane.ransac"
    first, second = asked("plane.rsm_mm, 'plan*.depth', orient.rsm_mm")
    assert first == (
        "compare.metrics[0]: step plane reports no metric rsm_mm (did you mean rms_mm?); "
        f"{whose} at plane.rsm_mm, 'plan*.depth', orient.rsm_mm]"
    )
    assert second.startswith(f"compare.metrics[1]: step plane reports no metric depth; {whose} at ")


def test_metrics_that_the_wiring_cannot_produce_are_refused(
    write: Path, catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    declared = (MetricSpec("n_photos"), MetricSpec("lens_[xy]_px", needs=("calibration",)))
    monkeypatch.setattr(catalog.method("read.photos").load(), "metrics", declared)

    def asked(metric: str, text: str = GOOD) -> str:
        return "".join(refused(text.replace("plane.rms_mm", metric), write, catalog))

    alone = GOOD.replace(", calibration: inputs.calibration", "")
    assert [asked(metric) for metric in ("shots.lens_x_px", "'shots.lens_*'")] == ["", ""]
    for metric in ("lens_x_px", "lens_*"):
        assert asked(f"'shots.{metric}'", alone).startswith(
            f"compare.metrics[0]: step shots reports {metric} only if calibration is connected"
        )
    assert asked("'shots.*'", alone) == asked("'*.n_photos'", alone) == ""
    assert "step shots reports no metric depth_mm" in asked("shots.depth_mm")
