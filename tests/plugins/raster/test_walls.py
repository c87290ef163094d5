"""How much memory a wall takes, and what of it is known."""

from __future__ import annotations

import re
from types import SimpleNamespace

import psutil
import pytest
from orthoflow_plugins.raster.walls import require_memory

from orthoflow.errors import MethodError
from orthoflow.geometry import WallFrame
from orthoflow.geometry.bands import IN_MEMORY_CELLS
from tests import samples

GSD_M = 0.01


def frame(rows: int, columns: int) -> WallFrame:
    return samples.facing_south(GSD_M, columns, rows)


def with_memory(monkeypatch: pytest.MonkeyPatch, n_bytes: float) -> None:
    memory = SimpleNamespace(total=int(n_bytes))
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)


def needed_bytes(
    monkeypatch: pytest.MonkeyPatch, *frames: WallFrame, is_tin: bool = False
) -> float:
    """What some walls are said to need."""
    with_memory(monkeypatch, 4096.0)
    with pytest.raises(MethodError, match="raise gsd_m, or lower n_walls_max") as caught:
        require_memory(frames, is_tin=is_tin)
    found = re.search(r"which need ([0-9.e+-]+) GiB", str(caught.value))
    assert found is not None
    return float(found[1]) * 2.0**30


def test_walls_may_take_three_quarters_of_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    one = frame(2000, 3000)
    needed = needed_bytes(monkeypatch, one)
    with_memory(monkeypatch, 1.01 * needed / 0.75)
    require_memory([one])
    with_memory(monkeypatch, 0.99 * needed / 0.75)
    with pytest.raises(MethodError, match=r"gsd_m = 0.01 m make 6e\+06 cells \(3000 x 2000"):
        require_memory([one])


def test_a_wall_in_bands_takes_the_memory_of_a_band(monkeypatch: pytest.MonkeyPatch) -> None:
    huge, larger = frame(8000, 20_000), frame(8000, 40_000)
    assert huge.width * huge.height > IN_MEMORY_CELLS
    assert needed_bytes(monkeypatch, huge) == needed_bytes(monkeypatch, larger)
    tins = [needed_bytes(monkeypatch, one, is_tin=True) for one in (huge, larger)]
    assert tins[1] - tins[0] == pytest.approx(790 * 8000 * 20_000, rel=0.01)


def test_no_wall_has_more_cells_than_32_bits_count(monkeypatch: pytest.MonkeyPatch) -> None:
    with_memory(monkeypatch, 1e15)
    require_memory([frame(1 << 15, (1 << 16) - 1)])
    with pytest.raises(MethodError, match="cells of gsd_m"):
        require_memory([frame(1 << 15, 1 << 16)])
