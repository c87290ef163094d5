"""Parts of what a method maps over, what it reports, and how that is called."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orthoflow.errors import MethodError
from orthoflow.products import Photo, Photos, Planes, PointCloud
from orthoflow.sdk import Method, MethodParams, Metric, MetricSpec, Part, Ports, StepContext
from orthoflow.sdk.methods import checked_part, labelled, mapped_port


class Counting(Method):
    """Counts the letters of photos' names, some photos at a time."""

    id = "match.counting"
    maps_over = "photos"
    metrics = (MetricSpec("n_*", label="number of {0}", better="higher"), "rms_px")

    class Params(MethodParams):
        """None."""

    class In(Ports):
        photos: Photos
        planes: Planes | None

    class Out(Ports):
        cloud: PointCloud

    @dataclass(frozen=True, kw_only=True)
    class PartOut(Part):
        counts: tuple[int, ...]

    def run_part(self, inputs: In, items: range, params: Params, ctx: StepContext) -> PartOut:
        if len(items) == 7:
            ctx.metric("n_letters", 1.0, "1")
        return self.PartOut(counts=tuple(len(inputs.photos.photos[k].name) for k in items))

    def join(self, inputs: In, parts: Sequence[PartOut], params: Params, ctx: StepContext) -> Any:
        return [count for part in parts for count in part.counts]


def context(folder: Path) -> StepContext:
    return StepContext(rng=np.random.default_rng(0), cores=1, scratch=folder)


def inputs(count: int = 3) -> Any:
    photos = tuple(Photo(name="x" * k, encoded=b"", width=1, height=1) for k in range(count))
    return Counting.In(photos=Photos(photos=photos), planes=None)


def test_a_method_that_maps_gives_for_all_what_it_gives_for_parts(tmp_path: Path) -> None:
    port = mapped_port(Counting)
    assert port is not None
    assert (port.port, port.field, port.item_name) == ("photos", "photos", "name")
    method, ctx = Counting(), context(tmp_path)
    part = checked_part(method, inputs(), range(1, 3), Counting.Params(), ctx)
    assert part == Counting.PartOut(counts=(1, 2))
    assert method.run(inputs(), Counting.Params(), ctx) == [0, 1, 2]
    with pytest.raises(MethodError, match="reports metrics or figures of a part; it must do that"):
        checked_part(method, inputs(7), range(7), Counting.Params(), ctx)


def test_a_part_is_what_the_method_says_it_is(tmp_path: Path) -> None:
    class Wrong(Counting):
        def run_part(self, *_: Any) -> Any:
            return (1, 2)

    with pytest.raises(MethodError, match=r"match\.counting must give its PartOut .* got tuple"):
        checked_part(Wrong(), inputs(), range(2), Counting.Params(), context(tmp_path))


def test_what_maps_over_nothing_is_no_mapping() -> None:
    assert mapped_port(type("Plain", (Counting,), {"maps_over": ""})) is None


def test_metrics_are_those_declared_and_labelled() -> None:
    reported = [Metric(name=name, value=1.0, unit="1") for name in ("n_planes", "rms_px")]
    count, rms = labelled(Counting, reported)
    assert (count.label, count.better) == ("number of planes", "higher")
    assert (rms.label, rms.unit) == ("", "1")
    assert [Counting.may_report(name) for name in ("n_planes", "rms_px", "rms_mm")] == [
        *(True, True, False),
    ]
    anything = type("Anything", (Counting,), {"metrics": ()})
    assert anything.may_report("rms_mm")
    assert Counting.tools() == {}
