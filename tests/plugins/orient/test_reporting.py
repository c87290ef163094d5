"""What an orientation step tells of its photos as a whole."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.orient import bundle, reporting
from orthoflow_plugins.orient.residuals import PhotoNumbers

from orthoflow.products import TieRole
from orthoflow.sdk import StepContext

IN, OUT, CHECK = TieRole.CONTROL, TieRole.REJECTED, TieRole.CHECK


def context(folder: Path) -> StepContext:
    return StepContext(rng=np.random.default_rng(1), cores=1, scratch=folder)


def told(ctx: StepContext) -> dict[str, float]:
    return {metric.name: metric.value for metric in ctx.metrics}


def numbers(n_control: int, n_check: int, check_px: float) -> PhotoNumbers:
    return PhotoNumbers(
        n_control=n_control,
        n_check=n_check,
        n_rejected=0,
        control_rmse_px=0.1 * n_control,
        check_rmse_px=check_px,
        check_rmse_mm=2.0 * check_px,
        pixel_mm=2.0,
        hull_ratio=0.5,
    )


def photo(
    name: str,
    status: str,
    roles: list[TieRole],
    of: PhotoNumbers | None = None,
    sigma_wall_m: float | None = None,
    notes: tuple[str, ...] = (),
) -> Any:
    return SimpleNamespace(
        camera=SimpleNamespace(photo=name, status=status, sigma_wall_m=sigma_wall_m),
        role=np.array(roles, dtype=np.uint8),
        numbers=of,
        notes=notes,
    )


FOUND = [
    photo("a", "ok", [IN, IN, CHECK, OUT], numbers(2, 1, 0.5), 0.003),
    photo("b", "ok", [IN, CHECK, OUT, OUT], numbers(6, 2, 0.9), 0.001, ("beware",)),
    # Taken as it is given: nothing is measured of it.
    photo("c", "ok", []),
    photo("d", "ok", [IN, IN], numbers(4, 0, np.nan), 0.002),
    # Refused, though it had numbers.
    photo("e", "too flat", [OUT, OUT], numbers(90, 90, 9.0)),
]


def test_photos_and_ties_are_counted_and_errors_told_of_those_oriented(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    reporting._measure(ctx, FOUND)
    assert told(ctx) == {
        "n_photos": 5,
        "n_oriented": 4,
        "n_refused": 1,
        "n_ties": 12,
        "n_control": 12,
        "n_check": 3,
        "rejected_share": pytest.approx(5 / 12),
        "control_rmse_px_median": pytest.approx(0.4),
        "control_rmse_px_worst": pytest.approx(0.6),
        # Of a photo without withheld ties nothing is known.
        "check_rmse_px_median": pytest.approx(0.7),
        "check_rmse_px_worst": pytest.approx(0.9),
        "check_rmse_mm_median": pytest.approx(1.4),
        "check_rmse_mm_worst": pytest.approx(1.8),
        "sigma_wall_mm_median": pytest.approx(2.0),
        "sigma_wall_mm_worst": pytest.approx(3.0),
    }


def test_without_an_oriented_photo_nothing_is_told_of_errors(tmp_path: Path) -> None:
    for found, n_photos in ((FOUND[4:], 1), ([], 0)):
        ctx = context(tmp_path)
        reporting._measure(ctx, found)
        assert told(ctx)["n_photos"] == told(ctx)["n_refused"] == n_photos
        assert told(ctx)["rejected_share"] == float(n_photos)
        assert not any("rmse" in name or "sigma" in name for name in told(ctx))


def test_a_photo_is_warned_of_by_its_reason_and_its_notes(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    for found in FOUND:
        reporting._warn(ctx, found)
    assert ctx.warnings == ["photo b: beware", "photo e is not oriented: too flat"]


@pytest.mark.parametrize("has_ties", [True, False])
def test_a_block_is_told_of_with_its_ties_between_photos(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, has_ties: bool
) -> None:
    monkeypatch.setattr(bundle, "correlation_notes", lambda *_: ["hardly told apart"])
    monkeypatch.setattr(bundle, "lenses_json", lambda *_: ["lens"])
    monkeypatch.setattr(bundle, "lens_statistics", lambda *_: ["mean"])
    adjusted: Any = SimpleNamespace(
        block=None,
        covariance=SimpleNamespace(sigma0=1.25, redundancy=77.0, cofactors=None, matrix=None),
        n_tie_points=40 if has_ties else 0,
        n_tie_observations=90 if has_ties else 0,
        tie_sigma_px=0.4 if has_ties else np.nan,
        tie_rmse_px=0.3 if has_ties else np.nan,
    )
    ctx = context(tmp_path)
    details = bundle._report_block(ctx, adjusted, [])
    assert details == {
        "sigma0": 1.25,
        "redundancy": 77.0,
        "lenses": ["lens"],
        "lens_statistics": ["mean"],
        "photo_ties": {
            "n_points": 40 if has_ties else 0,
            "n_observations": 90 if has_ties else 0,
            "sigma_px": 0.4 if has_ties else None,
        },
    }
    expected = {"sigma0": 1.25, "redundancy": 77.0, "n_photo_points": 40 if has_ties else 0}
    assert told(ctx) == (expected | {"photo_tie_rmse_px": 0.3} if has_ties else expected)
    assert ctx.warnings == ["hardly told apart"]


@pytest.mark.parametrize("wants_ties", [True, False])
def test_key_points_are_sought_in_photos_that_overlap_others(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, wants_ties: bool
) -> None:
    block: list[Any] = [
        SimpleNamespace(
            tied=SimpleNamespace(
                photo=SimpleNamespace(name=name),
                seen=SimpleNamespace(points_world=np.arange(12.0).reshape(4, 3)),
                is_check=np.array([True, False, False, False]),
            ),
            estimate=SimpleNamespace(
                agreeing=np.array([True, True, False, True]),
                resection=SimpleNamespace(camera=f"camera {name}"),
            ),
        )
        for name in "abcd"
    ]
    given: list[Any] = []

    def pairs(cameras: Any, shown: Any, share: float) -> list[tuple[int, int]]:
        assert cameras == ["camera a", "camera b", "camera c", "camera d"]
        # Neither withheld ties nor those that do not agree.
        assert [points[:, 0].tolist() for points in shown] == [[3.0, 9.0]] * 4
        assert share == 0.35
        return [(0, 3), (1, 3)]

    monkeypatch.setattr(bundle, "overlapping_pairs", pairs)
    monkeypatch.setattr(bundle, "photo_features", lambda photo, n: (photo.name, n))
    monkeypatch.setattr(bundle, "no_features", lambda: "none")
    monkeypatch.setattr(bundle, "no_photo_ties", lambda: "no ties")
    monkeypatch.setattr(bundle, "tie_photos", lambda *args: given.append(args) or "ties")
    params = bundle.OrientColmapBundle.Params(
        photo_ties=wants_ties, overlap_min_share=0.35, n_features_max=500, n_photo_points_max=77
    )
    told_shares: list[float] = []
    ctx = StepContext(
        rng=np.random.default_rng(1),
        cores=1,
        scratch=tmp_path,
        listen=lambda event: (
            told_shares.append(event.fraction) if event.kind == "progress" else None
        ),
    )
    found = bundle._photo_ties(block, params, ctx)
    if not wants_ties:
        assert (found, given) == ("no ties", [])
        return
    assert found == "ties"
    ((_, features, asked, n_most),) = given
    assert features == [("a", 500), ("b", 500), "none", ("d", 500)]
    assert (asked, n_most) == ([(0, 3), (1, 3)], 77)
    # From what orienting one by one took to where the adjustment begins.
    assert told_shares == pytest.approx([0.4, 0.475, 0.55, 0.625])
