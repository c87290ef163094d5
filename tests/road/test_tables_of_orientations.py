"""The estimators of orientations side by side on the simulated room, against the truth."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.workflow.source import shipped_workflow
from tests.road.conftest import Shell, metrics_of, without_variants

pytestmark = pytest.mark.long
SMALL = (
    *("--set", "room.scan_step_m=0.004", "--set", "room.photo_gsd_m=0.003"),
    *("--set", "wall.gsd_m=0.006", "--executor", "inline"),
)
Table = dict[tuple[str, str], float]


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory, store: Path) -> Table:
    """Metrics by cell and name of a small run, from the guided ties alone."""
    shell = Shell(tmp_path_factory.mktemp("orient-methods"), store)
    text = shipped_workflow("orient-methods").read_text()
    left_out = ("unmasked", "masked", "dlt-k1")
    (shell.folder / "quick.yaml").write_text(without_variants(text, left_out))
    ended = shell("run", "quick.yaml", *SMALL, "-o", "run", timeout_s=1200)
    assert ended.code == 0, ended.said
    return metrics_of(shell.folder / "run")


def of(table: Table, step: str, orient: str, metric: str) -> float:
    return table[f"{step}@reties=guided,orient={orient}", metric]


@pytest.mark.parametrize(
    ("orient", "n_oriented", "limit_mm"),
    # The control of two photos lies at the limit of what is too flat for a DLT.
    [("pnp", 6, 0.8), ("bundle", 6, 0.6), ("dlt-all", 4, 1.2)],
)
def test_photos_are_oriented_within_what_is_stated(
    table: Table, orient: str, n_oriented: int, limit_mm: float
) -> None:
    assert n_oriented <= of(table, "orient", orient, "n_oriented") <= 6
    assert of(table, "check", orient, "n_misoriented") == 0
    # Measured: 0.62 (pnp) and 0.46 mm (bundle), on a raster of 6 mm. Two photos have 70 ties of two
    # millimetres each: which ones decides whether such a photo is off by 0.3 or by 0.9 mm.
    assert of(table, "check", orient, "pose_wall_rms_mm") < limit_mm
    assert of(table, "check", orient, "pose_error_over_sigma") < 2.0


def test_eleven_parameters_show_in_the_orthoimage(table: Table) -> None:
    # Measured: 3.1 mm instead of 1.4, from poses that are off by 4.0 mm on the wall.
    assert of(table, "check", "dlt", "rmse_u_mm") > 1.5 * of(table, "check", "pnp", "rmse_u_mm")
    assert of(table, "check", "dlt", "pose_wall_rms_mm") > 3.0 * of(
        table, "check", "dlt-all", "pose_wall_rms_mm"
    )


def test_a_looser_threshold_keeps_more_wrong_ties(
    tmp_path_factory: pytest.TempPathFactory, store: Path
) -> None:
    # At the size it ships with: in the coarse room whole photos are refused at some thresholds, and
    # all ties of a refused photo count as rejected.
    shell = Shell(tmp_path_factory.mktemp("orient-thresholds"), store)
    ended = shell(
        "run", "orient-thresholds.yaml", "--executor", "inline", "-o", "run", timeout_s=1200
    )
    assert ended.code == 0, ended.said
    found = metrics_of(shell.folder / "run")
    sigmas = (2, 3, 4, 6, 9)
    n_oriented = [found[f"orient@orient=sigma{n}", "n_oriented"] for n in sigmas]
    # Two standard deviations reject so many right ties that photos are lost with them.
    assert n_oriented[0] < n_oriented[1]
    assert len(set(n_oriented[1:])) == 1
    rejected = [found[f"orient@orient=sigma{n}", "rejected_share"] for n in sigmas]
    assert rejected == sorted(rejected, reverse=True)
    # Over the same photos: what two standard deviations keep is of other ones.
    wrong = [found[f"check@orient=sigma{n}", "tie_wrong_share"] for n in sigmas[1:]]
    assert wrong == sorted(wrong)
    assert wrong[0] < wrong[-1]
