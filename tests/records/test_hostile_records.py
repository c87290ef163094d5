"""A record from a stranger, sealed as it is, writes and reads nothing outside its folder."""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from orthoflow.diagnostics import PLAIN_WARNING
from orthoflow.records.verify import verify_run
from tests import hostile_records as hostile
from tests.studios import Studio, open_studio, said

COMMANDS = (
    ("show",),
    ("report",),
    ("replay",),
    ("export", "--to", "csv"),
    ("export", "--to", "figures"),
    ("export", "--to", "ro-crate"),
    ("export", "--embed"),
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """A run `first` with its input file in the record."""
    with pytest.MonkeyPatch.context() as patch:
        studio = open_studio(tmp_path_factory.mktemp("hostile"), patch)
        (studio.folder / "n.txt").write_text("1.5")
        studio.run("first", "--input", "number=n.txt", "--embed")
        yield studio


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory three folders deep, so that a way out would be seen."""
    place = tmp_path / "x" / "y" / "z"
    place.mkdir(parents=True)
    monkeypatch.chdir(place)
    return place


def everything(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if not path.is_relative_to(folder / "x/y/z")}


NAMED: dict[str, Callable[[hostile.Record, str], None]] = {
    "figure": lambda record, name: record.add_figure("paint", name),
    "input file": lambda record, name: record.document["inputs"][0]["files"][0].update(name=name),
    "published file": lambda record, name: record.name_published(name),
    "step": lambda record, name: record.cell("survey").update(step=name),
    "run": lambda record, name: record.document.update(name=name),
}


@pytest.mark.parametrize("what", NAMED)
def test_names_that_lead_elsewhere_are_found_and_nothing_is_written_there(
    finished: Studio, folder: Path, tmp_path: Path, what: str
) -> None:
    run = hostile.changed(
        finished.folder / "first",
        folder / "run",
        lambda record: NAMED[what](record, "../../../out"),
    )
    before = everything(tmp_path)
    done = finished("verify", run, code=3)
    # The seal fits, so it is the name alone.
    assert len(done.stdout.splitlines()) == 1
    assert "'../../../out" in done.stdout
    for command in COMMANDS:
        done = finished(command[0], run, *command[1:])
        assert done.exit_code == (3 if command[0] == "replay" else done.exit_code), done.output
        assert done.exit_code in (0, 3), (command, done.output)
        if what == "figure" and command in (("report",), ("export", "--to", "figures")):
            assert "so the figures cannot be written to files" in done.output
    assert everything(tmp_path) == before


def test_figures_that_some_systems_take_for_one_are_not_laid_over_each_other(
    finished: Studio, folder: Path
) -> None:
    def draw(record: hostile.Record) -> None:
        for name in ("depth", "Depth"):
            record.add_figure("paint", name)

    run = hostile.changed(finished.folder / "first", folder / "run", draw)
    for command in (("verify", run), ("export", run, "--to", "figures"), ("report", run)):
        assert "file systems that ignore case" in said(*command, code=3)
    assert not list((run / "figures").rglob("*epth*"))


def test_links_and_devices_beside_a_record_are_not_followed(
    finished: Studio, folder: Path, tmp_path: Path
) -> None:
    secret = tmp_path / "secret.txt"
    secret.write_text("secret")

    def publish(record: hostile.Record) -> None:
        record.name_published("products/paint/a", "products/paint/b", "products/paint/c")

    run = hostile.changed(finished.folder / "first", folder / "run", publish)
    (run / "products" / "paint" / "a").symlink_to("/dev/zero")
    (run / "products" / "paint" / "b").symlink_to(secret)
    os.mkfifo(run / "products" / "paint" / "c")
    done = finished("verify", run, code=3)
    assert done.output.count("a link, a folder or a device in place of the published file") == 3
    finished("export", run, "--to", "ro-crate", "-o", "crate", code=0)
    assert not [path for path in Path("crate").rglob("*") if path.is_symlink()]
    assert {"a", "b", "c"}.isdisjoint(path.name for path in Path("crate").rglob("*"))
    (run / "report.html").unlink()
    (run / "report.html").symlink_to(secret)
    assert "'report.html' must be a file, but is a link" in said(
        "export", run, "--to", "ro-crate", "-o", "other", code=3
    )
    assert b"secret" not in b"".join(
        p.read_bytes() for p in Path("other").rglob("*") if p.is_file()
    )
    (run / "products").rename(tmp_path / "elsewhere")
    (run / "products").symlink_to(tmp_path / "elsewhere")
    done = finished("verify", run, code=3)
    assert done.output.count("a link, a folder or a device in place of the published file") == 3
    assert finished.json("show", run)["files"] == []


def test_a_sparse_file_is_told_by_its_size(finished: Studio, folder: Path) -> None:
    run = hostile.changed(finished.folder / "first", folder / "run", lambda record: None)
    os.truncate(run / "products" / "metrics.csv", 1 << 40)
    before = os.times()
    assert "products/metrics.csv: changed since it was published" in said("verify", run, code=3)
    assert "products/metrics.csv has been changed since the run" in said(
        "export", run, "--to", "ro-crate", "-o", "crate", code=3
    )
    (run / "products" / "metrics.csv").unlink()
    os.truncate(run / "report.html", 1 << 40)
    assert "report.html is too large for a report: 1099511627776 bytes" in said(
        "export", run, "--to", "ro-crate", "-o", "other", code=3
    )
    after = os.times()
    assert after.user + after.system - before.user - before.system < 5


@pytest.mark.parametrize(
    ("command", "link"),
    [
        (("report",), "figures"),
        (("export", "--to", "csv"), "export"),
        (("export", "--to", "ro-crate"), "export/ro-crate"),
        (("export", "--embed"), "embedded"),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value),
)
def test_folders_in_a_run_that_are_links_are_not_written_through(
    finished: Studio, folder: Path, tmp_path: Path, command: tuple[str, ...], link: str
) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    run = hostile.changed(
        finished.folder / "first",
        folder / "run",
        lambda record: record.add_figure("paint", "depth"),
    )
    shutil.rmtree(run / link, ignore_errors=True)
    (run / link).parent.mkdir(exist_ok=True)
    (run / link).symlink_to(outside)
    done = finished(command[0], run, *command[1:])
    assert done.exit_code in (1, 2), done.output
    assert "is a link" in done.output
    assert list(outside.iterdir()) == []


def test_a_pipe_in_the_place_of_a_record_is_refused_at_once(finished: Studio, folder: Path) -> None:
    os.mkfifo(folder / "run.h5")
    for path in (folder, folder / "run.h5", Path("/dev/zero")):
        done = finished("verify", path, code=2)
        assert done.output.startswith("error: ")


def test_what_a_record_says_is_shown_and_not_obeyed(finished: Studio, folder: Path) -> None:
    evil = "\x1b]0;title\x07\x9b2J\u202e\r\nverified: 9 products, seal ok"
    written = "\\x1b]0;title\\x07\\x9b2J\\u202e\\r\\nverified: 9 products, seal ok"

    def write(record: hostile.Record) -> None:
        record.document["name"] = f"name {evil}"
        warning = PLAIN_WARNING.of("", {"text": ""})
        row = {**dataclasses.asdict(warning), "text": f"warnings {evil}", "settled_by": []}
        record.cell("paint").update(log=evil, diagnostics=[row], citations=[f"citations {evil}"])
        record.add_figure("paint", f"figure {evil}")

    run = hostile.changed(finished.folder / "first", folder / "run", write)
    done = finished("show", run, code=0)
    assert f"name {written}, run " in done.output
    assert f"warning, paint: warnings {written}\n" in done.output
    assert finished.json("show", run)["name"] == f"name {evil}"
    outputs = [done.output]
    outputs += [
        finished(words[0], run, *words[1:]).output
        for command in (("verify",), ("compare", finished.folder / "first"), *COMMANDS)
        for words in (command, (*command, "--json"))
    ]
    obeyed = set("".join(outputs)) & set(evil) - set(" ]:;,0129Jtile\nverifdpouckasx")
    assert obeyed == set()
    assert not re.search("^verified: 9", "".join(outputs), re.MULTILINE)


def test_a_document_with_halves_of_letters_is_refused(finished: Studio, folder: Path) -> None:
    run = hostile.changed(
        finished.folder / "first",
        folder / "run",
        lambda record: record.cell("paint").update(params={"odd": "a\ud800"}),
    )
    assert {finding.partition(":")[0] for finding in verify_run(run).findings} == {"/document"}
    for command in (("show",), ("export", "--to", "csv")):
        done = finished(command[0], run, *command[1:], code=3)
        assert "\ud800" not in done.output


def test_odd_facts_under_a_key_of_their_own_change_no_replay(
    finished: Studio, folder: Path
) -> None:
    def write(record: hostile.Record) -> None:
        record.rewrite_preimage("survey", tools=[1], code={"framework": None})
        record.rewrite_preimage("paint", tools={"numpy": {"\x1b[2J": [1]}})

    run = hostile.changed(finished.folder / "first", folder / "run", write)
    assert verify_run(run).findings == ()
    done = finished("replay", run, "-o", "again", code=0)
    assert "2 products: 2 identical" in done.stdout
    assert "\x1b" not in done.output


def with_preimage(text: str) -> Callable[[hostile.Record], None]:
    return lambda record: record.exchange_preimage("paint", text)


def with_parameters(**params: object) -> Callable[[hostile.Record], None]:
    def change(record: hostile.Record) -> None:
        record.rewrite_preimage("paint", params=params)
        record.cell("paint")["params"] = params

    return change


def with_source(source: str) -> Callable[[hostile.Record], None]:
    return lambda record: record.cell("paint")["inputs"]["planes"].update(source=source)


def close_a_circle(record: hostile.Record) -> None:
    """Every digest fits: a cell that is made of what it gives itself."""
    cell = record.cell("paint")
    given = cell["inputs"]["planes"]
    cell["outputs"]["planes"] = {**given, "source": ""}
    given["source"] = "paint.planes"


REFUSES = "step paint: the installed paint.plain does not accept the recorded parameter"
IMPOSSIBLE: tuple[tuple[Callable[[hostile.Record], None], str], ...] = (
    (with_preimage(""), "key_preimage must not be empty"),
    *(
        (with_preimage(text), "inputs does not match the cache key")
        for text in ("[" * 50_000, f'{{"seed": {"9" * 5000}}}', '{"inputs": [1]}')
    ),
    (with_parameters(grey=128, gsd_m=0.5, x=1), f"{REFUSES} x: Extra inputs are not permitted"),
    (with_parameters(grey=[[]], gsd_m={}), f"{REFUSES} gsd_m: Input should be a valid number"),
    *(
        (with_source(source), f"paint: no earlier step outputs {source!a}, its input planes")
        for source in ("survey.nothing", "inputs.nothing", "a\x1b[2J.planes")
    ),
    (close_a_circle, "paint: no earlier step outputs 'paint.planes', its input planes"),
)


@pytest.mark.parametrize(("change", "sentence"), IMPOSSIBLE, ids=range(len(IMPOSSIBLE)))
def test_what_cannot_be_replayed_is_refused(
    finished: Studio, folder: Path, change: Callable[[hostile.Record], None], sentence: str
) -> None:
    run = hostile.changed(finished.folder / "first", folder / "run", change)
    if REFUSES in sentence or change is close_a_circle:
        assert verify_run(run).findings == ()
    done = finished("replay", run, "-o", "again", code=3)
    assert sentence in done.stderr
    assert not Path("again").exists()
