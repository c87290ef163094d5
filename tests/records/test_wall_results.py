"""What a drawing says of a wall: how exact it is, what was done to colours, which cell is meant."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from orthoflow.errors import ArgumentError, RecordError
from orthoflow.products import CheckPoints, Finding, Inspection
from orthoflow.records import walls as module


def output(type_name: str, digest: str = "", *, embedded: bool = True) -> Any:
    return SimpleNamespace(type_name=type_name, digest=digest or type_name, embedded=embedded)


def cell(address: str = "", **known: Any) -> Any:
    plain = {
        "address": address,
        "outputs": {},
        "inputs": {},
        "metrics": (),
        "diagnostics": (),
        "params": {},
        "method": "mosaic.seams",
        "status": "ok",
        "error_message": "",
    }
    return SimpleNamespace(**{**plain, **known})


class ToyRun:
    """Cells by address, each behind those before it."""

    def __init__(self, folder: Path | None = None, published: tuple[str, ...] = (), **cells: Any):
        self.cells = cells
        self.folder = folder
        self.path = Path("run.h5") if folder is None else folder / "run.h5"
        self.record = SimpleNamespace(
            run_id="r1", published=[SimpleNamespace(path=path) for path in published]
        )

    def payload(self, address: str, port: str) -> Any:
        return self.cells[address].outputs[port].product.to_payload()

    def cell(self, address: str) -> Any:
        if address not in self.cells:
            raise ArgumentError(f"no cell {address}")
        return self.cells[address]

    def with_failure(self, sentence: str) -> str:
        return f"{sentence}; plane failed"

    def upstream(self, address: str) -> list[Any]:
        names = list(self.cells)
        return [self.cells[name] for name in names[: names.index(address) + 1]]


def inspection(*findings: tuple[str, float, int], walls: tuple[int, ...] = ()) -> Inspection:
    count = len(walls)
    return Inspection(
        wall=np.array(walls, dtype=np.int32),
        points_world=np.zeros((count, 3)),
        displacement_m=np.zeros((count, 2)),
        kind=np.zeros(count, dtype=np.uint8),
        kinds=("point",),
        findings=tuple(
            Finding(name=name, value=value, unit="mm", wall=wall) for name, value, wall in findings
        ),
    )


def test_an_inspection_says_how_exact_a_wall_is_by_findings_on_it() -> None:
    own = inspection(
        ("rmse_x_mm", 1.25, 3), ("rmse_y_mm", 2.0, 3), ("n_found", 6.0, 3),
        ("rms_3d_mm", 3.0, 3), ("max_3d_mm", 9.0, 3),
        ("rmse_x_mm", 7.0, 4), ("rmse_y_mm", 7.0, 4),
        ("rmse_x_mm", 8.0, -1), ("rmse_y_mm", 8.0, -1),
    )  # fmt: skip
    every = inspection(("patch_rmse_u_mm", 1.0, -1), ("patch_rmse_v_mm", 2.0, -1))
    first = inspection(("rmse_u_mm", 4.0, 0), ("rmse_v_mm", 5.0, 0))
    half = inspection(("rmse_x_mm", 1.0, 3), ("n_points", 5.0, 3))
    found = {"check": own, "truth": every, "half": half, "first": first}
    assert [said.text() for said in module._accuracy(found, 3)] == [
        "measured: RMSE horizontal 1.2 mm, vertical 2.0 mm (check points: 6)",
        "measured with depth: RMS 3.0 mm, largest 9.0 mm",
    ]
    # What was found of all walls together says nothing of one.
    (first_said,) = module._accuracy(found, 0)
    assert first_said.text("de") == "gemessen: RMSE seitlich 4,0 mm, in der Höhe 5,0 mm"


def checkpoints(count: int) -> Any:
    product = CheckPoints(
        names=tuple(f"P{k}" for k in range(count)),
        points_world=np.zeros((count, 3)),
        classes=("",) * count,
        wall=np.full(count, -1, dtype=np.int32),
        pixels_wall=np.full((count, 2), np.nan),
    )
    return SimpleNamespace(type_name="checkpoints", embedded=True, product=product)


def looking(status: str, message: str = "") -> Any:
    given = SimpleNamespace(type_name="checkpoints", source="survey.points", digest="c")
    return cell("check", status=status, error_message=message, inputs={"points": given})


@pytest.mark.parametrize(
    ("count", "check", "said"),
    [
        (3, looking("failed", "none was found: P0 (57 m left of wall 0)"),
         ", although 3 check points were given: none was found: P0 (57 m left of wall 0)"),
        (1, cell(), ", although 1 check point was given: no step used them"),
        (3, looking("ok"), ": surveyed check points would show"),
    ],
    ids=["none counted", "not looked for", "counted on another wall"],
)  # fmt: skip
def test_given_check_points_are_not_asked_for_again(count: int, check: Any, said: str) -> None:
    # Those of the simulated room were given by nobody.
    room = cell(method="simulate.room", outputs={"points": checkpoints(48)})
    survey = cell(method="read.checkpoints", outputs={"points": checkpoints(count)})
    run: Any = ToyRun(room=room, survey=survey, check=check)
    assert module._unmeasured(run).text().startswith(f"accuracy not checked{said}")
    alone: Any = ToyRun(room=room)
    assert "surveyed check points would show" in module._unmeasured(alone).text()


@pytest.mark.parametrize(
    ("params", "metrics", "said"),
    [
        ({}, (), "colours from mosaic.seams"),
        ({"gains": "none"}, (), "original colours of the photos or the scan"),
        ({"gains": "local"}, (), "original colours: the photos agree, or there is only one"),
        (
            {"gains": "local"},
            (SimpleNamespace(name="gain_max", value=1.5),),
            "colours balanced between photos",
        ),
    ],
)
def test_what_was_done_to_colours_is_said(params: Any, metrics: Any, said: str) -> None:
    photos = cell(inputs={"photos": output("photos")})
    run: Any = ToyRun(photos=photos, mosaic=cell(params=params, metrics=metrics))
    assert module._colours(run, "mosaic").text() == said
    for least, more in ((0, ""), (10, ", without points darker than 10 of 255")):
        ortho = cell(inputs={"cloud": output("cloud")}, params={"skip_below_grey": least})
        run = ToyRun(ortho=ortho, mosaic=cell(params=params))
        assert module._colours(run, "mosaic").text() == f"colours as scanned{more}"


def test_the_last_orthoimages_are_meant_or_else_the_last_walls() -> None:
    walls, images = {"walls": output("walls")}, {"images": output("orthoimages")}
    run: Any = ToyRun(
        a=cell(outputs=walls), b=cell(outputs=images), c=cell(outputs=images), d=cell(outputs=walls)
    )
    assert module._pictured(run, None) == "c"
    assert module._pictured(run, "a") == "a"
    assert module._pictured(ToyRun(a=cell(outputs=walls), d=cell(outputs=walls)), None) == "d"  # type: ignore[arg-type]
    nothing: Any = ToyRun(e=cell(outputs={"cloud": output("cloud")}))
    with pytest.raises(ArgumentError, match=r"r1 has no orthoimages and no walls; plane failed$"):
        module._pictured(nothing, None)
    with pytest.raises(ArgumentError, match=r"e has no orthoimages or walls; .*: none"):
        module._pictured(nothing, "e")
    run.cells["e"] = nothing.cells["e"]
    with pytest.raises(ArgumentError, match="steps of this run that have: b, c, a, d"):
        module._pictured(run, "e")


PUBLISHED = (
    "products/mosaic/wall_2_ortho.tif",
    "products/mosaic/images_wall_10_depth.tif",
    "products/mosaic/wall_2_ortho.json",
    "products/mosaic/wall_x_ortho.tif",
    "products/mosaic/wall_3_preview.tif",
    "products/other/wall_4_ortho.tif",
    "products/mosaic/wall_5_intensity.tif",
)


@pytest.mark.parametrize(("wall", "is_asked"), [(None, True), (2, True), (10, False)])
def test_an_orthoimage_that_is_gone_is_asked_for(
    tmp_path: Path, wall: int | None, is_asked: bool
) -> None:
    run: Any = ToyRun(folder=tmp_path, published=PUBLISHED)
    if is_asked:
        with pytest.raises(RecordError, match=r"wall_2_ortho.tif is missing in .* copy it back"):
            module._require_orthoimages(run, "mosaic", wall)
        (tmp_path / "products/mosaic").mkdir(parents=True)
        (tmp_path / PUBLISHED[0]).touch()
    module._require_orthoimages(run, "mosaic", wall)
