"""The SDK: ports from annotations, what the context collects and refuses, untrusted names."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from orthoflow.errors import CancelledStepError, PluginError, ProductError
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import Method, Metric, MetricSpec, Ports, StepContext, StepEvent, port_specs
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


# The context of a step ----------------------------------------------------------------------------


PNG = b"\x89PNG\r\n\x1a\n" + bytes(20)
WEBP = b"RIFF....WEBP"


def context(folder: Path, heard: list[StepEvent] | None = None) -> StepContext:
    listen = (lambda event: None) if heard is None else heard.append
    return StepContext(rng=np.random.default_rng(1), cores=1, scratch=folder, listen=listen)


@pytest.mark.parametrize(
    "content",
    [b"no picture at all", b"\x89PNG", b'<svg xmlns="http://www.w3.org/2000/svg"/>'],
    ids=["text", "cut off", "SVG"],
)
def test_what_is_no_picture_is_refused_where_it_is_drawn(tmp_path: Path, content: bytes) -> None:
    ctx = context(tmp_path)
    message = rf"^figure plan must be .* its content begins with {re.escape(repr(content[:16]))}$"
    with pytest.raises(ProductError, match=message):
        ctx.figure("plan", content)
    assert (ctx.figures, list(tmp_path.iterdir())) == ([], [])


def test_two_pictures_have_names_that_differ_everywhere(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    ctx.figure("depth", PNG)
    for name, content in (("Depth", PNG), ("depth", WEBP)):
        with pytest.raises(ProductError, match=f"figure {name} was added twice"):
            ctx.figure(name, content)
    assert [figure.path.name for figure in ctx.figures] == ["depth.png"]


def test_lines_and_fractions_are_heard_in_order(tmp_path: Path) -> None:
    heard: list[StepEvent] = []
    ctx = context(tmp_path, heard)
    ctx.progress(-0.5, "begun")
    ctx.log("reading")
    ctx.progress(0.25)
    ctx.warn("few points")
    ctx.progress(0.1, "back")
    ctx.progress(7.0, "done")
    assert [(event.kind, event.text) for event in heard] == [
        *(("progress", "begun"), ("log", "reading"), ("progress", "")),
        *(("diagnostic", "few points"), ("progress", "back"), ("progress", "done")),
    ]
    assert [event.fraction for event in heard if event.kind == "progress"] == [0.0, 0.25, 0.25, 1.0]
    assert ctx.warnings == ["few points"]


def test_a_step_can_ask_whether_it_is_to_stop(tmp_path: Path) -> None:
    asked = StepContext(
        rng=np.random.default_rng(1), cores=1, scratch=tmp_path, is_cancelled=lambda: True
    )
    assert asked.cancelled()
    with pytest.raises(CancelledStepError):
        asked.progress(0.1)
    assert not context(tmp_path).cancelled()


def test_an_allocated_array_is_zero_and_a_file_of_its_size(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    nothing = ctx.allocate("cloud", "x", (5, 0), np.float32)
    assert (nothing.shape, nothing.dtype) == ((5, 0), np.float32)
    assert not (tmp_path / "allocated").exists()
    array = ctx.allocate("walls", "walls/0/rgb", (4, 5, 3), np.float64)
    assert (array.shape, array.dtype, array.any()) == ((4, 5, 3), np.float64, False)
    (path,) = (tmp_path / "allocated").iterdir()
    # In blocks of 512 bytes: nothing of it is a hole.
    assert 512 * path.stat().st_blocks >= path.stat().st_size
    assert path.stat().st_size == 60 * 8
    array[1, 2, 2] = 7
    other = ctx.allocate("walls", "walls/1/rgb", (4, 5, 3), np.float64)
    assert array[1, 2, 2] == 7
    assert not other.any()
    for shape, odd in [((4,), object), ((-4,), float)]:
        with pytest.raises(ProductError, match=r"^cannot allocate an array of type .* and shape "):
            ctx.allocate("numbers", "values", shape, odd)


NOT_NAMES = ["", "..", "../up", "a b", "two\nlines", "half \udcff", "n" * 300, 5]


@pytest.mark.parametrize("name", NOT_NAMES, ids=ascii)
def test_what_cannot_be_a_name_names_no_metric_and_no_figure(tmp_path: Path, name: str) -> None:
    ctx = context(tmp_path)
    with pytest.raises(
        ProductError, match=r"^the name of a metric may contain at most 200 letters, "
    ):
        ctx.metric(name, 1.0, "mm")
    with pytest.raises(
        ProductError, match=r"^the name of a figure may contain at most 200 letters, "
    ):
        ctx.figure(name, PNG)
    assert (ctx.metrics, ctx.figures, list(tmp_path.iterdir())) == ([], [], [])


def test_a_metric_is_a_number_and_its_unit_a_word(tmp_path: Path) -> None:
    for unit in ("", "m\nm", None, 1.0, "\x1b"):
        with pytest.raises(ProductError, match="the unit of metric length must be a word"):
            context(tmp_path).metric("length", 1.0, unit)
    refused = r"^metric length must be (a number: |finite, got .*: do not report)"
    for value in ("three", None, 10**400, np.nan, np.inf):
        with pytest.raises(ProductError, match=refused):
            context(tmp_path).metric("length", value, "m")


def test_a_step_names_each_metric_once_and_warns_a_thousand_times(tmp_path: Path) -> None:
    heard: list[StepEvent] = []
    ctx = context(tmp_path, heard)
    ctx.metric("m1", 1.0, "1")
    with pytest.raises(ProductError, match="metric m1 was reported twice"):
        ctx.metric("m1", 2.0, "m")
    for k in range(1003):
        ctx.warn(f"warning {k}")
    assert len(heard) == 1000
    assert (ctx.diagnostics[999].text, len(ctx.diagnostics)) == ("warning 999", 1001)
    assert ctx.diagnostics[1000].values == {"n": 3}


class OfSize:
    def __init__(self, n_bytes: int) -> None:
        self.n_bytes = n_bytes

    def savefig(self, path: Path) -> None:
        with path.open("wb") as file:
            file.write(PNG)
            file.truncate(self.n_bytes)  # without the rest on the disk


@pytest.mark.usefixtures("charts")
def test_a_figure_may_have_64_mebibytes(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    ctx.figure("largest", OfSize(64 * 1024**2))
    with pytest.raises(ProductError, match="figure larger must be a file of at most 64 MiB"):
        ctx.figure("larger", OfSize(64 * 1024**2 + 1))
    assert [figure.name for figure in ctx.figures] == ["largest"]
