"""What a step may do with its context: pictures of each kind, arrays of any size, being heard."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from orthoflow.sdk import Method, MethodParams, Ports, StepContext, StepEvent

SVG = b'<svg xmlns="http://www.w3.org/2000/svg"/>'
PNG = b"\x89PNG\r\n\x1a\n" + bytes(20)
WEBP = b"RIFF\x10\x00\x00\x00WEBPVP8 "


def context(folder: Path, heard: list[StepEvent] | None = None) -> StepContext:
    listen = (lambda event: None) if heard is None else heard.append
    return StepContext(rng=np.random.default_rng(1), cores=1, scratch=folder, listen=listen)


@pytest.mark.parametrize(
    ("content", "suffix", "media_type"),
    [
        (PNG, ".png", "image/png"),
        (WEBP, ".webp", "image/webp"),
        (SVG, ".svg", "image/svg+xml"),
    ],
    ids=["PNG", "WebP", "SVG"],
)
def test_a_picture_is_kept_by_its_kind(
    tmp_path: Path, content: bytes, suffix: str, media_type: str
) -> None:
    ctx = context(tmp_path)
    ctx.figure("wall_0", content, "A wall.")
    (figure,) = ctx.figures
    assert (figure.name, figure.caption, figure.media_type) == ("wall_0", "A wall.", media_type)
    assert figure.path == tmp_path / "figures" / f"wall_0{suffix}"
    assert figure.path.read_bytes() == content


@pytest.mark.usefixtures("charts")
def test_a_chart_is_drawn_as_png(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    ctx.figure("chart", Figure(figsize=(1, 1), dpi=20))
    (figure,) = ctx.figures
    assert figure.media_type == "image/png"
    assert figure.path.read_bytes().startswith(b"\x89PNG")


def test_lines_and_fractions_are_heard_in_order(tmp_path: Path) -> None:
    heard: list[StepEvent] = []
    ctx = context(tmp_path, heard)
    ctx.progress(-0.5, "begun")
    ctx.log("reading")
    ctx.progress(0.25)
    ctx.warn("few points")
    ctx.progress(7.0, "done")
    assert [(event.kind, event.text) for event in heard] == [
        *(("progress", "begun"), ("log", "reading"), ("progress", "")),
        *(("warning", "few points"), ("progress", "done")),
    ]
    assert [event.fraction for event in heard if event.kind == "progress"] == [0.0, 0.25, 1.0]
    assert ctx.warnings == ["few points"]


def test_a_step_can_ask_whether_it_is_to_stop(tmp_path: Path) -> None:
    asked = StepContext(
        rng=np.random.default_rng(1), cores=1, scratch=tmp_path, is_cancelled=lambda: True
    )
    assert asked.cancelled()
    assert not context(tmp_path).cancelled()


@pytest.mark.parametrize("shape", [(0,), (0, 3), (5, 0)])
def test_an_array_of_nothing_needs_no_file(tmp_path: Path, shape: tuple[int, ...]) -> None:
    array = context(tmp_path).allocate("cloud", "x", shape, np.float32)
    assert (array.shape, array.dtype) == (shape, np.float32)
    assert not (tmp_path / "allocated").exists()


@pytest.mark.parametrize("dtype", [np.uint8, np.float64])
def test_an_allocated_array_is_zero_and_a_file_of_its_size(
    tmp_path: Path, dtype: type[np.generic]
) -> None:
    ctx = context(tmp_path)
    array = ctx.allocate("walls", "walls/0/rgb", (4, 5, 3), dtype)
    assert (array.shape, array.dtype, array.any()) == ((4, 5, 3), dtype, False)
    (path,) = (tmp_path / "allocated").iterdir()
    assert path.name == "walls.walls.0.rgb"
    assert path.stat().st_size == 60 * np.dtype(dtype).itemsize
    array[1, 2, 2] = 7
    other = ctx.allocate("walls", "walls/1/rgb", (4, 5, 3), dtype)
    assert array[1, 2, 2] == 7
    assert not other.any()


def test_a_method_that_does_nothing_says_what_it_lacks(tmp_path: Path) -> None:
    class Idle(Method):
        id = "plane.idle"
        Params = MethodParams
        In = Ports
        Out = Ports

    with pytest.raises(AssertionError, match="Idle must implement run"):
        Idle().run(Ports(), MethodParams(), context(tmp_path))
    assert Idle.tools() == {}
