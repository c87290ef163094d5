"""What the settings of a simulated room become: its plan, its scanner, its film, and its record."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.simulate import room
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.sdk import StepContext

Params = SimulateRoom.Params


def planned(
    monkeypatch: pytest.MonkeyPatch, folder: Path, **params: object
) -> tuple[Any, Any, dict[str, Any], Any]:
    """The plan of the room, what draws its walls, what is recorded of it, and of its photos."""
    got: dict[str, Any] = {}

    def build_room(plan: Any, rng: Any) -> Any:
        got["plan"], got["rng"] = plan, rng
        return SimpleNamespace(scene="scene", planes=())

    def planned_shots(plan: Any, rng: Any) -> str:
        got["shots"] = plan
        return "shots"

    def truth_of(delivery: Any, cloud: Any, shots: Any, settings: dict[str, Any]) -> str:
        got["settings"], got["delivery"] = settings, delivery
        return "truth"

    deliverables = "orthoflow_plugins.simulate.deliverables"
    monkeypatch.setattr("orthoflow.geometry.scene_views.SceneCameras", lambda scene, cores: "views")
    monkeypatch.setattr(f"{deliverables}.Delivery", SimpleNamespace)
    monkeypatch.setattr(f"{deliverables}.cloud_of", lambda _: "cloud")
    monkeypatch.setattr(f"{deliverables}.truth_of", truth_of)
    for name in ("report_room", "report_photos"):
        monkeypatch.setattr(f"{deliverables}.{name}", lambda *_: None)
    monkeypatch.setattr(room, "build_room", build_room)
    monkeypatch.setattr(room, "planned_shots", planned_shots)
    monkeypatch.setattr(room, "_scan", lambda *_: "scan")
    monkeypatch.setattr(room, "calibration_of", lambda shots, *, is_known: is_known)
    monkeypatch.setattr(room, "take_photos", lambda *args: args[:2])
    monkeypatch.setattr(room, "with_passers_by", lambda *_: ())
    monkeypatch.setattr(room, "calibrated", lambda photos, calibration: (*photos, calibration))
    monkeypatch.setattr(room, "_check_points", lambda delivery, views, most: most)
    monkeypatch.setattr(SimulateRoom, "Out", staticmethod(lambda **out: out))
    ctx = StepContext(rng=np.random.default_rng(5), cores=1, scratch=folder)
    out: Any = SimulateRoom().run(SimulateRoom.In(), Params.model_validate(params), ctx)
    assert (out["cloud"], out["truth"]) == ("cloud", "truth")
    assert out["photos"] == ("views", "shots", out["calibration"])
    return got["plan"], got["rng"], got["settings"], (got["shots"], out, got["delivery"])


@pytest.mark.parametrize(
    ("gap", "share", "inversion"),
    [("none", 0.0, 0.0), ("easy", 0.3, 0.0), ("hard", 0.7, 0.0), ("inverted", 0.3, 1.0)],
)
def test_a_gap_says_how_much_of_what_the_laser_sees_is_its_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, gap: str, share: float, inversion: float
) -> None:
    params = {"spectral_gap": gap, "relief_scale": 0.5, "obstacle": False, "textile_share": 0.2}
    plan, rng, _, _ = planned(monkeypatch, tmp_path, **params)
    assert (plan.spectral_gap, plan.relief, plan.obstacle) == (share, 0.5, False)
    assert plan.textile_share == 0.2
    # As it is designed.
    assert rng is None
    errors = room._errors(Params.model_validate(params), 4)
    assert errors.inversion == inversion
    assert errors.band_seed == 4
    # What is asked for stands whatever the gap.
    asked = Params.model_validate({**params, "spectral_inversion_share": 0.25})
    assert room._errors(asked, 4).inversion == 0.25


def test_records_of_rooms_as_they_always_were_do_not_change(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    _, _, usual, _ = planned(monkeypatch, tmp_path)
    later = {"decoration", "design_seed", "geometry", "photo_exposure_share"}
    later |= {"n_passers_by", "turn_deg"}
    assert set(usual) == set(Params.model_fields) - later
    changed = {
        "decoration": "drawn",
        "design_seed": 7,
        "geometry": "drawn",
        "photo_exposure_share": 0.2,
        "n_passers_by": 3,
        "turn_deg": 12.0,
    }
    _, rng, settings, _ = planned(monkeypatch, tmp_path, **changed)
    assert {name: settings[name] for name in later} == changed
    # A design has a seed of its own.
    assert rng.integers(1 << 40) == np.random.default_rng(7).integers(1 << 40)


def test_photos_are_planned_and_developed_as_asked(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    params = {
        "photo_layout": "variant2",
        "photo_gsd_m": 0.004,
        "photo_obliquity_deg": 9.0,
        "calibrated": False,
        "check_points_most": 11,
        "up": "y",
        "shift_world_m": (5.0, 6.0, 7.0),
        "photo_noise_grey": 2.5,
        "photo_vignetting_share": 0.3,
        "photo_supersample": 4,
        "photo_exposure_share": 0.2,
    }
    *_, (shots, out, delivery) = planned(monkeypatch, tmp_path, **params)
    assert (shots.layout, shots.gsd_m, shots.obliquity_deg) == ("variant2", 0.004, 9.0)
    assert (out["calibration"], out["checkpoints"]) == (False, 11)
    np.testing.assert_array_equal(delivery.world_from_room @ [0.0, 0.0, 1.0], [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(delivery.shift_world_m, [5.0, 6.0, 7.0])
    film = room._film(Params.model_validate(params))
    assert (film.noise_grey, film.vignetting, film.supersample, film.exposures) == (
        2.5,
        0.3,
        4,
        0.2,
    )
