"""Plugins: found one by one, never harming each other, checked before use; and their code."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.catalog.distributions import (
    DistributionInfo,
    describe_distribution,
    package_path,
    required_distributions,
)
from orthoflow.engine.environment import packages
from orthoflow.errors import PluginError, WorkflowError
from orthoflow.products.planes import Planes
from orthoflow.version import DISTRIBUTION
from tests.laboratories import LABORATORY, laboratory_catalog, write_distribution
from tests.studios import asked

HOOKS = """\
from orthoflow.sdk.hooks import KindSpec, MethodSpec, ProductSpec, hookimpl

@hookimpl
def orthoflow_methods():
    return [{methods}]

@hookimpl
def orthoflow_kinds():
    return [{kinds}]

@hookimpl
def orthoflow_products():
    return [{products}]
"""


SPEECHLESS = """\
class Speechless(Exception):
    def __str__(self):
        raise RuntimeError

raise Speechless
"""


def hooks(methods: str = "", kinds: str = "", products: str = "") -> str:
    return HOOKS.format(methods=methods, kinds=kinds, products=products)


def method(method_id: str, target: str) -> str:
    return f"MethodSpec(id={method_id!r}, target={target!r}, summary='-')"


def with_plugin(
    name: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, **more: str
) -> Catalog:
    """The laboratory beside one more plugin, whose hooks are in `<name>_hooks`."""
    sources = {f"{name}_hooks.py": text} | {f"{key}.py": value for key, value in more.items()}
    folder = write_distribution(tmp_path / name, name, sources)
    return laboratory_catalog(monkeypatch, folder)


def test_a_strangers_distribution_is_found_by_its_metadata(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    catalog = laboratory_catalog(monkeypatch)
    entry = catalog.method("plane.hough2d")
    assert (entry.distribution.name, entry.distribution.version) == ("laboratory", "1.0")
    assert str(entry.distribution) == "laboratory 1.0"
    assert entry.load().result_version == 3
    assert catalog.kinds["plane"].spec.outputs == {"planes": "planes", "labels": "labels"}
    assert catalog.product_class("planes") is Planes
    assert catalog.publisher("labels") is None
    assert catalog.broken == ()


LIMITING = "import os, sys\nos.chdir('/')\nsys.setrecursionlimit(900)"


@pytest.mark.parametrize(
    ("name", "text", "error"),
    [
        ("missing", "import no_such_library", "ModuleNotFoundError: No module named"),
        ("leaving", "raise SystemExit(3)", "SystemExit: 3"),
        ("raising", "raise ValueError('a\\nb')", "ValueError: a b"),
        ("mute", "x = 1", "PluginError: mute_hooks declares nothing"),
        (
            "listless",
            hooks().replace("return []", "return 3", 1),
            "a hook must return a list of MethodSpec",
        ),
        ("mixed", hooks(methods="'plane.mine'"), "list of MethodSpec, got an item 'plane.mine'"),
        ("speechless", SPEECHLESS, "Speechless: a Speechless without a message"),
        ("long", "raise ValueError('x' * 10**6)", "... (1000000 characters)"),
        ("interrupting", "raise KeyboardInterrupt", "KeyboardInterrupt"),
        ("limiting", LIMITING, "lowers Python's recursion limit"),
        (
            "portless",
            hooks(kinds="KindSpec(name='a', summary='-', inputs=None)"),
            "AttributeError: 'NoneType'",
        ),
        ("badid", hooks(methods=method("Mine", "a:B")), "method id must be kind.method in lower"),
        ("badtarget", hooks(methods=method("plane.x", "a.B")), "target must be package.module"),
        (
            "strayhook",
            "from orthoflow.sdk import hookimpl\n@hookimpl\ndef orthoflow_method():\n    return []",
            "PluginValidationError",
        ),
    ],
)
def test_a_plugin_that_fails_is_listed_and_harms_nobody(
    name: str, text: str, error: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit = sys.getrecursionlimit()
    monkeypatch.chdir(tmp_path)
    catalog = with_plugin(name, text, tmp_path, monkeypatch)
    assert (sys.getrecursionlimit(), Path.cwd()) == (limit, tmp_path)
    (broken,) = catalog.broken
    assert (broken.entry_point, broken.module) == (name, f"{name}_hooks")
    assert error in broken.error
    assert "\n" not in broken.error
    assert "Traceback" in broken.traceback
    assert str(broken).startswith(f"plugin {name} of {name} 1.0 cannot be loaded: ")
    assert len(catalog.methods) == 14


def test_a_plugin_that_loads_has_no_say_in_the_rest_of_the_program(tmp_path: Path) -> None:
    """It goes elsewhere, prints, and leaves a thread that does not end."""
    text = "import os, threading, time\nos.chdir('/')\nprint('hello')\n"
    text += "threading.Thread(target=time.sleep, args=[600]).start()\n"
    sources = {"threaded_hooks.py": text + hooks(methods=method("plane.mine", "a:B"))}
    folder = write_distribution(tmp_path / "site", "threaded", sources)
    done = subprocess.run(
        [sys.executable, "-m", "orthoflow", "plugins", "list"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([*sys.path, str(folder)])},
    )
    assert (done.returncode, done.stderr) == (0, "hello\n")
    assert "plane.mine" in done.stdout


@pytest.mark.parametrize("file", ["METADATA", "entry_points.txt"])
def test_a_distribution_that_nobody_can_read_harms_nobody(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = {"garbled_hooks.py": hooks(methods=method("plane.mine", "a:B"))}
    folder = write_distribution(tmp_path / "site", "garbled", sources)
    (folder / "garbled-1.0.dist-info" / file).write_bytes(bytes(range(128, 256)))
    monkeypatch.syspath_prepend(LABORATORY)
    monkeypatch.syspath_prepend(folder)
    catalog = discover_catalog()
    assert "simulate.room" in catalog.methods
    if file == "METADATA":
        assert str(catalog.method("plane.mine").distribution) == "garbled 0"
    packages.cache_clear()
    assert "laboratory" in packages()
    packages.cache_clear()


def test_ctrl_c_is_not_taken_for_a_broken_plugin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(5)"
    with pytest.raises(KeyboardInterrupt):
        with_plugin("stopping", source, tmp_path, monkeypatch)


def test_a_method_claimed_twice_is_named_by_its_distribution(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = hooks(methods=method("plane.ransac", "second_class:Mine"))
    source = CLASS.replace("plane.mine", "plane.ransac")
    catalog = with_plugin("second", text, tmp_path, monkeypatch, second_class=source)
    with pytest.raises(
        PluginError, match=r"write laboratory/plane\.ransac or second/plane\.ransac"
    ):
        catalog.method("plane.ransac")
    assert catalog.method("second/plane.ransac").load().__module__ == "second_class"
    assert catalog.method("laboratory/plane.ransac").load().id == "plane.ransac"
    assert catalog.method("plane.hough2d").load().id == "plane.hough2d"
    monkeypatch.setenv("ORTHOFLOW_DISABLED_PLUGINS", "other,Second")
    catalog = laboratory_catalog(monkeypatch, tmp_path / "second")
    assert catalog.method("plane.ransac").distribution.name == "laboratory"


def test_orthoflows_own_names_stay_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = hooks(methods=method("plane.hough2d", "a:B"))
    write_distribution(tmp_path, "impostor", {"impostor_hooks.py": text})
    monkeypatch.syspath_prepend(tmp_path)
    catalog = discover_catalog()
    assert catalog.method("plane.hough2d").distribution.name == DISTRIBUTION
    assert catalog.methods["impostor/plane.hough2d"].distribution.name == "impostor"


def test_methods_of_a_kind_claimed_twice_have_the_ports_of_their_own_plugin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = "KindSpec(name='plane', summary='-', inputs={}, outputs={'planes': 'planes'})"
    text = hooks(kinds=kind, methods=method("plane.mine", "two_class:Mine"))
    source = CLASS.replace("cloud: PointCloud", "pass").replace("        labels: PointLabels\n", "")
    catalog = with_plugin("two", text, tmp_path, monkeypatch, two_class=source)
    assert "kind plane is declared by laboratory 1.0 and two 1.0" in catalog.kinds["plane"].problem
    assert catalog.kinds["plane"].state == "fine"  # for methods of a third plugin
    for name in ("plane.mine", "plane.ransac"):
        assert catalog.method(name).load().id == name


def test_of_a_product_type_claimed_twice_the_first_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    product = "ProductSpec(type_name='planes', target='typed_class:Own', summary='-')"
    catalog = with_plugin("typed", hooks(products=product), tmp_path, monkeypatch)
    assert catalog.product_class("planes").__name__ == "Planes"
    assert "laboratory 1.0 and typed 1.0" in catalog.products["planes"].problem
    assert catalog.method("plane.hough2d").load()


def test_a_method_without_a_usable_kind_is_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds = "KindSpec(name='carve', summary='-', inputs={'x': 'unheard'}, outputs={})"
    methods = ", ".join(method(f"{kind}.mine", "a:B") for kind in ("sculpt", "carve"))
    catalog = with_plugin("lonely", hooks(methods, kinds), tmp_path, monkeypatch)
    for kind, problem in (
        (
            "sculpt",
            "method sculpt.mine of lonely 1.0 has the kind sculpt, which no plugin declares",
        ),
        (
            "carve",
            "kind carve of lonely 1.0 has ports with product types that no plugin declares: ",
        ),
    ):
        assert catalog.methods[f"{kind}.mine"].state == "broken"
        with pytest.raises(PluginError, match=problem):
            catalog.method(f"{kind}.mine")


def test_an_unknown_method_gets_a_suggestion_of_its_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    catalog = laboratory_catalog(monkeypatch)
    for name, hint in (
        ("plane.rnsac", r"unknown method plane\.rnsac \(did you mean plane\.ransac\?\)"),
        ("plane.voxels", r"kind plane has plane\.hough2d, plane\.ransac"),
        ("plain.ransac", r"plain\.ransac \(did you mean plane\.ransac\?\)"),
        ("ransac", r"ransac \(did you mean plane\.ransac\?\)"),
    ):
        with pytest.raises(WorkflowError, match=hint):
            catalog.method(name)
    with pytest.raises(PluginError, match=r"product type plans \(did you mean planes\?\)"):
        catalog.product_class("plans")


def test_an_unknown_method_mentions_plugins_that_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "import no_such_library\nid = 'plane.deep'\n"
    catalog = with_plugin("deep", text, tmp_path, monkeypatch)
    with pytest.raises(WorkflowError, match=r"unknown method plane\.odd; .* plugin deep of deep"):
        catalog.method("plane.odd")
    with pytest.raises(PluginError, match=r"method plane\.deep cannot be used: plugin deep of"):
        catalog.method("plane.deep")


CLASS = """\
from orthoflow.products import Cameras, Planes, PointCloud, PointLabels, Walls
from orthoflow.sdk import Method, MethodParams, MetricSpec, Ports

class Mine(Method):
    id = "plane.mine"
    Params = MethodParams

    class In(Ports):
        cloud: PointCloud

    class Out(Ports):
        planes: Planes
        labels: PointLabels

    def run(self, inputs, params, ctx):
        raise NotImplementedError
"""
RUN = "    def run("
CHANGES = {
    "other id": (
        '"plane.mine"',
        '"plane.yours"',
        "the id of its class must be plane.mine, got 'plane.yours'",
    ),
    "no Params": ("    Params = MethodParams\n", "", "Params must be a subclass of MethodParams"),
    "no run": ("def run(", "def go(", "it has no method run"),
    "no Method": ("class Mine(Method):", "class Mine:", "must be a subclass of Method"),
    "determinism": (RUN, f"    determinism = 'maybe'\n{RUN}", "exact, seeded or loose"),
    "version": (RUN, f"    result_version = 0\n{RUN}", "an integer of at least 1, got 0"),
    "citations": (RUN, f"    citations = 'doi'\n{RUN}", "must be a tuple of strings"),
    "metrics": (RUN, f"    metrics = [3]\n{RUN}", "a tuple of MetricSpec or of names, got [3]"),
    "invented port": ("cloud: P", "cloud: PointCloud\n        more: P", "kind plane has no input"),
    "other type": ("cloud: PointCloud", "cloud: Walls", "has the type cloud in kind plane"),
    "lacking output": ("        labels: PointLabels\n", "", "its outputs must be planes, labels"),
    "other output": (
        "labels: PointLabels",
        "labels: Planes",
        "port labels has the type labels in kind",
    ),
    "no product": ("cloud: PointCloud", "cloud: int", "its ports cannot be read: PluginError"),
}


@pytest.mark.parametrize("case", CHANGES)
def test_a_class_that_breaks_a_rule_is_refused_when_it_is_loaded(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, after, complaint = CHANGES[case]
    assert before in CLASS
    name = "rule_" + case.replace(" ", "_")
    text = hooks(methods=method("plane.mine", f"{name}_class:Mine"))
    source = CLASS.replace(before, after, 1)
    catalog = with_plugin(name, text, tmp_path, monkeypatch, **{f"{name}_class": source})
    entry = catalog.method("plane.mine")
    with pytest.raises(PluginError, match=rf"method plane\.mine of {name} 1\.0 ") as caught:
        entry.load()
    assert complaint in str(caught.value)


def test_publishers_are_loaded_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = "type_name='notes', target='orthoflow.products.planes:Planes', summary='-'"
    text = hooks(products=f"ProductSpec({spec}, publisher='press_files:publish')")
    press = {"press_files": "def publish(product, folder, digest):\n    return digest\n"}
    catalog = with_plugin("press", text, tmp_path, monkeypatch, **press)
    assert catalog.publisher("notes") is not None
    with pytest.raises(
        PluginError, match=r"notes of press .* the type_name of .* must be .*, got .planes."
    ):
        catalog.product_class("notes")


def test_a_list_says_which_classes_are_missing_and_how_they_are_mended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    announced = (
        ("plane.mine", "named.method:Mine"),
        ("plane.case", "named.method:Minee"),
        ("plane.lost", "named.methods:Mine"),
        ("plane.indented", "named.odd:Odd"),
        ("plane.stopped", "named.stop:Stop"),
    )
    sources = {
        "named_hooks.py": hooks(methods=", ".join(method(*one) for one in announced)),
        "named/__init__.py": "",
        "named/method.py": CLASS,
        "named/odd.py": "class Odd:\npass\n",
        "named/stop.py": "raise KeyboardInterrupt",
    }
    folder = write_distribution(tmp_path, "named", sources)
    (folder / "named-1.0.dist-info" / "direct_url.json").write_text("{}")
    monkeypatch.syspath_prepend(folder)
    listed = asked("plugins", "list", code=0).stdout
    rows = [line.split() for line in listed.splitlines()]
    states = {row[0]: row[1] for row in rows if len(row) > 1}
    assert [states[name] for name, _ in announced] == ["fine", *["broken"] * 4]
    for said in (
        "from named.method:Minee: AttributeError: module 'named.method' has no attribute 'Minee'; ",
        "ModuleNotFoundError: No module named 'named.methods'; install missing packages or an",
        "class definition on line 1 (odd.py, line 2); install missing",
    ):
        assert said in listed


# Where the code of a module lies, without importing it --------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the import path with a package, a module and a namespace package."""
    for name in ("regular", "regular/inner", "spaced/part"):
        (tmp_path / name).mkdir(parents=True)
    trap = "raise AssertionError('imported')\n"
    for name in ("regular/__init__", "regular/inner/__init__", "alone", "spaced/part/__init__"):
        (tmp_path / f"{name}.py").write_text(trap)
    (tmp_path / "spaced" / "single.py").write_text(trap)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path.resolve()


@pytest.mark.parametrize(
    ("module", "place"),
    [
        ("regular", "regular"),
        ("regular.inner.hooks", "regular"),
        ("alone", "alone.py"),
        ("spaced.part", "spaced/part"),
        ("spaced.part.hooks", "spaced/part"),
        ("spaced.single", "spaced/single.py"),
        *((nothing, None) for nothing in ("nowhere_to_be_found", "spaced", "spaced.missing", "")),
    ],
)
def test_the_outermost_regular_package_is_found_and_not_imported(
    folder: Path, module: str, place: str | None
) -> None:
    assert package_path(module) == (place if place is None else folder / place)
    assert not {"regular", "alone", "spaced.part", "spaced.single"} & sys.modules.keys()


@pytest.mark.parametrize(("module", "source"), [("regular.hooks", "regular"), ("alone", None)])
def test_an_entry_point_of_no_distribution_is_known_by_its_own_name(
    folder: Path, module: str, source: str | None
) -> None:
    assert describe_distribution(EntryPoint(name="mine", value=module, group="any")) == (
        DistributionInfo(
            name="mine",
            version="0",
            source_folder=None if source is None else folder / source,
        )
    )


def test_what_a_distribution_requires_is_followed(folder: Path) -> None:
    """Extras are left out; what is not installed has no requirements."""
    required = {
        "My.Plugin": ["one[Fast, x] >=2 ; python_version > '3'", 'docs; extra == "docs"'],
        "one": ["speed>=1 ; extra == 'fast'", "two"],
        "two": ["one", "gone"],
    }
    for name, texts in required.items():
        info = folder / f"{name}-1.dist-info"
        info.mkdir()
        lines = [f"Name: {name}", "Version: 1", *(f"Requires-Dist: {text}" for text in texts)]
        (info / "METADATA").write_text("\n".join(["Metadata-Version: 2.1", *lines]))
    found = required_distributions(frozenset({"my-plugin"}))
    assert found == {"my-plugin", "one", "two", "gone"}
    for unknown in ("gone", " ", "../x"):
        assert required_distributions(frozenset({"my-plugin", unknown})) is None
