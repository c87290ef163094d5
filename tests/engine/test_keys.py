"""What decides a result is in its key, without the doing of who wrote the method."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.engine.keys import library_versions, method_facts
from tests.engine_world import World

STEPS = """
steps:
  first: {use: make.range}
  second: {use: work.add, in: {numbers: first.numbers}}
"""


@pytest.fixture(autouse=True)
def _fresh_versions() -> Iterator[None]:
    yield
    library_versions.cache_clear()


def require(world: World, *requirements: str) -> None:
    """Let the toys' distribution require others."""
    lines = "".join(f"Requires-Dist: {text}\n" for text in requirements)
    metadata = world.site / "toy_plugin-1.0.dist-info" / "METADATA"
    metadata.write_text(f"Metadata-Version: 2.1\nName: toy-plugin\nVersion: 1.0\n{lines}")
    library_versions.cache_clear()


def install(world: World, name: str, version: str) -> None:
    """Put an empty library with a module of its name where the toys lie."""
    for old in world.site.glob(f"{name}-*.dist-info"):
        (old / "METADATA").unlink()
        (old / "RECORD").unlink()
        old.rmdir()
    info = world.site / f"{name}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (info / "RECORD").write_text(f"{name}.py,,\n")
    (world.site / f"{name}.py").touch()
    library_versions.cache_clear()


def test_every_method_of_ours_is_keyed_by_the_libraries_that_compute() -> None:
    catalog = discover_catalog()
    for name in catalog.methods:
        tools = method_facts(name, catalog).tools
        assert tools.keys() >= {"numpy", "numba", "scipy", "opencv-python-headless", "pycolmap"}
        assert tools.keys().isdisjoint({"click", "rich", "h5py"})


@pytest.mark.parametrize("how", ["required", "imported"])
def test_a_new_version_of_a_library_computes_again_and_is_named(world: World, how: str) -> None:
    install(world, "lintel", "1.0")
    if how == "required":
        require(world, "lintel>=0.5; python_version > '3'", "absent", "pytest; extra == 'test'")
    else:
        with (world.site / "toy_plugin" / "works.py").open("a") as source:
            source.write("\n\ndef later() -> None:\n    import lintel\n")
    assert world.run(STEPS, executor="inline").status == "ok"
    assert {status for status, _ in world.status(STEPS).values()} == {"cached"}
    install(world, "lintel", "1.1")
    assert world.status(STEPS)["first"] == ("will run", 'lintel "1.0" -> "1.1"')


def test_a_method_may_declare_that_a_library_does_not_change_its_results(world: World) -> None:
    install(world, "lintel", "1.0")
    require(world, "lintel")
    source = world.site / "toy_plugin" / "makes.py"
    id_line = '    id = "make.range"\n'
    declared = f'{id_line}    unaffected_by = ("Lintel",)\n'
    source.write_text(source.read_text().replace(id_line, declared))
    catalog = world.catalog()
    assert "lintel" not in method_facts("make.range", catalog).tools
    assert "lintel" in method_facts("work.noise", catalog).tools


@pytest.mark.parametrize("name", ["works.py", "table.csv", "inner/table.npy"])
def test_a_plugin_whose_files_changed_under_the_same_version_computes_again(
    world: World, name: str
) -> None:
    file = world.site / "toy_plugin" / name
    file.parent.mkdir(exist_ok=True)
    with file.open("a") as stream:
        stream.write("# one\n")
    assert world.run(STEPS, executor="inline").status == "ok"
    assert world.status(STEPS)["first"][0] == "cached"
    with file.open("a") as stream:
        stream.write("# other\n")
    assert world.status(STEPS)["first"] == ("will run", "code changed")
