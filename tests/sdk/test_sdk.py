"""The SDK: ports from annotations, what the context collects and refuses, untrusted names."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.errors import PluginError
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import Method, Metric, MetricSpec, Ports, port_specs
from orthoflow.sdk.lines import one_line, text_of_path
from orthoflow.sdk.methods import labelled


class Inputs(Ports):
    cloud: PointCloud
    planes: Planes | None = None


class Wrong(Ports):
    cloud: int


def test_ports_are_read_from_annotations() -> None:
    ports = port_specs(Inputs)
    assert {name: (port.type_name, port.required) for name, port in ports.items()} == {
        "cloud": ("cloud", True),
        "planes": ("planes", False),
    }

    with pytest.raises(PluginError, match=r"Wrong.cloud must be annotated with a product class"):
        port_specs(Wrong)


class Damp(Method):
    metrics = (
        MetricSpec("n_*", label="damp patches"),
        MetricSpec("damp_share", label="share that is damp", better="lower"),
        MetricSpec("wall_[0-9]*_rms_mm", label="RMS, wall {0}{1}"),
        "other",
    )


def test_metrics_carry_what_their_method_calls_them() -> None:
    reported = [
        Metric(name=name, value=1.0, unit="1")
        for name in ("n_patches", "damp_share", "wall_12_rms_mm", "other")
    ]
    assert [(one.name, one.label, one.better) for one in labelled(Damp, reported)] == [
        ("n_patches", "damp patches", ""),
        ("damp_share", "share that is damp", "lower"),
        ("wall_12_rms_mm", "RMS, wall 12", ""),
        ("other", "", ""),
    ]
    assert [Damp.may_report(name) for name in ("n_x", "other", "rms_mm")] == [True, True, False]


def test_the_unit_of_a_metric_is_declared_or_the_end_of_its_name() -> None:
    assert [MetricSpec(name).unit for name in ("rms_mm", "n_points", "damp_share")] == [
        *("mm", "1", "1"),
    ]
    assert MetricSpec("speed", unit="m/s").unit == "m/s"

    for declared, named in (
        ({"name": "a/b"}, "printable lines of at most 200 bytes"),
        ({"name": "a", "label": "two\nlines"}, "printable lines"),
        ({"name": "a", "better": "most"}, "better must be lower, higher, one or empty, got 'most'"),
    ):
        with pytest.raises(PluginError, match=named):
            MetricSpec(**declared)


def test_what_cannot_say_anything_is_told_by_its_kind() -> None:
    class MuteError(Exception):
        def __str__(self) -> str:
            raise RuntimeError

    assert one_line(MuteError()) == "a MuteError without a message"


def test_a_path_is_kept_where_others_can_read_it() -> None:
    assert text_of_path(Path("a/ä.laz")) == str(Path("a/ä.laz"))
    assert text_of_path(Path("a/\udcff.laz")) is None
