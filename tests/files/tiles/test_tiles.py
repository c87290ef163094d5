from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from orthoflow.files.tiles import pyramid
from orthoflow.files.tiles.pyramid import write_tiles, write_viewer
from tests.browser import Page
from tests.ortho_file_scenes import CORNER, GSD_M, UP, WALL_SHAPE, colours, room


@pytest.fixture(scope="module")
def tiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tiles")
    images = {f"wall_{ortho.wall}_ortho": ortho for ortho in room(folder / "files")}
    for name, ortho in images.items():
        write_tiles(folder, name, ortho)
    write_viewer(folder, images)
    return folder


def level_of(folder: Path, number: int) -> np.ndarray:
    """All tiles of a level put together."""
    tiles = {}
    for path in (folder / str(number)).iterdir():
        column, row = map(int, path.stem.split("_"))
        tiles[row, column] = np.asarray(Image.open(path).convert("RGBA"))
    rows, columns = np.array(list(tiles)).max(axis=0) + 1
    return np.vstack([np.hstack([tiles[r, c] for c in range(columns)]) for r in range(rows)])


def test_every_level_shows_the_whole_orthoimage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pyramid, "TILE_PX", 300)
    wall, _ = room(tmp_path / "files")
    n_tiles = write_tiles(tmp_path, "wall", wall)
    folder = tmp_path / "wall_files"
    assert n_tiles == sum(1 for _ in folder.rglob("*.webp"))
    size = ET.parse(tmp_path / "wall.dzi").getroot()[0].attrib
    assert size == {"Width": str(WALL_SHAPE[1]), "Height": str(WALL_SHAPE[0])}
    last = max(int(path.name) for path in folder.iterdir())
    assert last == 11
    for number in range(last + 1):
        step = 2 ** (last - number)
        shape = tuple(-(-side // step) for side in WALL_SHAPE)
        found = level_of(folder, number)
        assert found.shape == (*shape, 4)
        if min(shape) < 20:
            continue
        if step == 1:
            assert np.count_nonzero(found[:, :, 3] == 0) == 200 * 300
        # Away from the hole and the border; WebP loses a few levels of colour.
        part = found[: int(0.1 * shape[0]), : int(0.9 * shape[1]), :3].astype(int)
        rows, columns = (np.arange(n) * step + 0.5 * (step - 1) for n in part.shape[:2])
        whole = colours(WALL_SHAPE)[
            np.rint(rows).astype(int)[:, None], np.rint(columns).astype(int)
        ]
        assert np.abs(part - whole).mean() < 4.0


@pytest.mark.long
def test_the_page_shows_and_measures_without_a_server(
    new_page: Callable[[], Page], tiled: Path, tmp_path: Path
) -> None:
    page = new_page()
    page.show_as(1000, 700)
    page.open(tiled / "index.html")
    page.evaluate("new Promise(done => setTimeout(done, 1500))")
    assert page.evaluate("[...document.querySelectorAll('option')].map(o => o.textContent)") == [
        "wall </script> 0",
        "floor 1",
    ]
    page.evaluate("use('distance'); points = [[0, 100], [200, 100]]; finished = true; tell()")
    assert page.evaluate("document.getElementById('result').textContent") == "1.0000 m"
    page.evaluate(
        "use('area'); points = [[0, 0], [200, 0], [200, 400], [0, 400]]; finished = true;tell()"
    )
    said = page.evaluate("document.getElementById('result').textContent")
    assert said == "2.0000 m², perimeter 6.0000 m"
    page.evaluate("clear(); cursor = [400, 200]; tellCursor()")
    x, y, z = CORNER + GSD_M * (400 * np.array([1.0, 0.0, 0.0]) - 200 * UP)
    world = page.evaluate("document.getElementById('world').textContent")
    assert f"{x:.3f}, {y:.3f}, {z:.3f} m" in world
    wall = page.evaluate("document.getElementById('wall').textContent")
    assert wall.endswith("X, Y: 2.000, -1.000 m")
    # What is painted in the middle is what the orthoimage has there.
    page.evaluate("cursor = null; whole()")
    page.evaluate("new Promise(done => setTimeout(done, 500))")
    (tmp_path / "page.png").write_bytes(page.screenshot())
    picture = np.asarray(Image.open(tmp_path / "page.png").convert("RGB")).astype(int)

    def shown(column: int, row: int) -> np.ndarray:
        x, y = page.evaluate(
            f"(() => {{ const [x, y] = onScreen([{column}, {row}]), box = "
            "canvas.getBoundingClientRect(); return [x + box.left, y + box.top]; })()"
        )
        return picture[round(y), round(x)]

    assert np.abs(shown(800, 500) - colours(WALL_SHAPE)[500, 800].astype(int)).max() <= 12
    # Three cells inside the hole nothing shows, least of all a coarser level.
    assert np.ptp(shown(350, 103)) == np.ptp(shown(350, 200)) == 0
    assert page.complaints == []
    assert all(address.startswith(("file:", "data:")) for address in page.requests)


def test_names_do_not_end_the_script(tiled: Path) -> None:
    text = (tiled / "index.html").read_text()
    assert text.count("</script>") == 1
    assert "wall \\u003c/script\\u003e 0" in text
