"""Both papers' accuracy tables in one, on the simulated room: backward beside direct."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.road.conftest import Shell, metrics_of

pytestmark = pytest.mark.long
GSD_MM = 6.0
SMALL = (
    *("--set", "room.scan_step_m=0.004", "--set", "room.photo_gsd_m=0.003"),
    *("--set", "wall.gsd_m=0.006", "--executor", "inline"),
)
WAYS = ("backward", "forward", "exact", "centre", "filled")


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory, store: Path) -> dict[tuple[str, str], float]:
    """Metrics by cell and name of a small run."""
    shell = Shell(tmp_path_factory.mktemp("ortho-methods"), store)
    ended = shell("run", "ortho-methods.yaml", *SMALL, "-o", "run", timeout_s=1200)
    assert ended.code == 0, ended.said
    return metrics_of(shell.folder / "run")


@pytest.mark.parametrize("way", WAYS)
def test_the_tables_of_both_papers_are_told(table: dict[tuple[str, str], float], way: str) -> None:
    # A fifth of a cell is what points at steps of 4 mm leave in cells of 6 mm.
    for axis in "xy":
        assert table[f"surf@ortho={way}", f"rmse_{axis}_mm"] <= 0.5 * GSD_MM
        assert table[f"surf@ortho={way}", f"beyond_2rmse_{axis}_share"] <= 0.25
        assert table[f"points@ortho={way}", f"rmse_{axis}_mm"] <= 0.5 * GSD_MM
    assert table[f"points@ortho={way}", "flat_n_found"] >= 10
    assert table[f"points@ortho={way}", "rms_after_once_mm"] <= GSD_MM


def test_flat_points_are_found_better_than_those_at_edges(
    table: dict[tuple[str, str], float],
) -> None:
    for way in WAYS:
        flat = table[f"points@ortho={way}", "flat_rms_mm"]
        assert flat < table[f"points@ortho={way}", "vertical_edge_rms_mm"]
