"""Figures on a page: which are shown, how they share its bytes, and their files beside it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from orthoflow_provenance.document import RecordedCell, RecordedFigure

from orthoflow.files.images import decode_image, encode_png, encode_webp
from orthoflow.report.figures import figure_groups, write_figures
from tests.report_runs import HeldRun, cell, compared_resolved, record

PNG, SVG, WEBP = "image/png", "image/svg+xml", "image/webp"


def figure(name: str, data: bytes, media_type: str = PNG) -> RecordedFigure:
    return RecordedFigure(name=name, caption=f"about {name}", media_type=media_type, data=data)


def run(cells: Sequence[RecordedCell]) -> HeldRun:
    recorded = record(cells, workflow_resolved=compared_resolved("plane.rms_mm"))
    return HeldRun(path=Path("run") / "run.h5", record=recorded)


def shown(of: HeldRun, **more: object) -> list[tuple[str, str, int]]:
    """Cell, title and bytes of every figure on the page."""
    return [
        (group.cell, picture.title, len(base64.b64decode(picture.uri.partition(",")[2])))
        for group in figure_groups(of, **more)  # type: ignore[arg-type]
        for picture in group.pictures
    ]


def noise(seed: int, side: int = 300) -> bytes:
    """A picture that packs badly: some 3 bytes a pixel as PNG."""
    return encode_png(
        np.random.default_rng(seed).integers(0, 256, (side, side, 3)).astype(np.uint8)
    )


# --- sharing the bytes of a page ---


def test_all_figures_of_a_page_take_less_than_four_megabytes() -> None:
    large = [figure(f"f{k}", noise(k, 700)) for k in range(5)]
    n_bytes = len(large[0].data)
    assert 2 * n_bytes < 3_900_000 < 3 * n_bytes
    for n_figures, is_whole in ((2, True), (3, False)):
        cells = [cell("plane@plane=fine", figures=tuple(large[:n_figures]))]
        sizes = [size for *_, size in shown(run(cells))]
        assert (sizes == [len(one.data) for one in large[:n_figures]]) is is_whole
        assert sum(sizes) <= 3_900_000


# --- files ---


def test_figures_are_written_as_programs_take_them(tmp_path: Path) -> None:
    picture = np.full((20, 30, 3), 77, np.uint8)
    bad = b'<svg xmlns="http://www.w3.org/2000/svg"><script>alert(1)</script></svg>'
    of = run(
        [
            cell(
                "check",
                figures=(
                    figure("photo", encode_webp(picture), WEBP),
                    figure("chart", encode_png(picture)),
                    figure("script", bad, SVG),
                    figure("damaged", b"RIFF....WEBP", WEBP),
                ),
            ),
            cell("other", figures=(figure("not_asked", encode_png(picture)),)),
        ]
    )
    assert write_figures(of, tmp_path / "out", ["check"]) == 2
    found = sorted(
        path.relative_to(tmp_path / "out").as_posix()
        for path in (tmp_path / "out").rglob("*")
        if path.is_file()
    )
    assert found == ["check/chart.png", "check/photo.png", "graph.svg"]
    photo = decode_image((tmp_path / "out/check/photo.png").read_bytes())
    assert np.abs(photo.astype(int) - 77).max() <= 3
    assert (tmp_path / "out/graph.svg").read_bytes().startswith(b"<?xml")
    assert write_figures(of, tmp_path / "page", ["other"], inside="figures") == 1
    assert (tmp_path / "page/figures/other/not_asked.png").is_file()
    assert (tmp_path / "page/figures/graph.svg").is_file()
