"""How much memory a wall takes."""

from __future__ import annotations

from types import SimpleNamespace

import psutil
import pytest
from orthoflow_plugins.raster.walls import bytes_needed, require_memory

from orthoflow.errors import MethodError
from orthoflow.geometry.bands import IN_MEMORY_CELLS
from tests import samples


def test_walls_may_take_three_quarters_of_the_memory_and_large_ones_that_of_a_band(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def give_memory(n_bytes: float) -> None:
        memory = SimpleNamespace(total=int(n_bytes))
        monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)

    one = samples.facing_south(0.01, 3000, 2000)
    give_memory(1.01 * bytes_needed([one.shape]) / 0.75)
    require_memory([one])
    give_memory(0.99 * bytes_needed([one.shape]) / 0.75)
    with pytest.raises(MethodError, match=r"gsd_m = 0.01 m make 6e\+06 cells \(3000 x 2000"):
        require_memory([one])
    huge, larger = (8000, 20_000), (8000, 40_000)
    assert huge[0] * huge[1] > IN_MEMORY_CELLS
    assert bytes_needed([huge]) == bytes_needed([larger])
    tins = [bytes_needed([shape], is_tin=True) for shape in (huge, larger)]
    assert tins[1] - tins[0] == 790 * 8000 * 20_000
    # Whatever the memory, cells are numbered with 32 bits.
    give_memory(1e15)
    require_memory([samples.facing_south(0.01, (1 << 16) - 1, 1 << 15)])
    with pytest.raises(MethodError, match="cells of gsd_m"):
        require_memory([samples.facing_south(0.01, 1 << 16, 1 << 15)])
