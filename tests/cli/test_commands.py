"""What commands share: the words that repeat one."""

from __future__ import annotations

import shlex
from pathlib import Path

import click
import h5py
import pytest
from click.testing import CliRunner

from orthoflow.cli.commands import (
    LazyGroup,
    RecordCommand,
    command_again,
)
from orthoflow.cli.tables import echo
from orthoflow.errors import GeometryError, ProductError, RecordError
from tests.provenance_records import write_sample


@click.command()
@click.argument("recipe")
@click.option("--set", "settings", multiple=True)
@click.option("--jobs", type=int, default=2)
@click.option("--force", is_flag=True)
@click.option("-o", "--output")
def bake(**_given: object) -> None:
    echo(command_again(Path("new one")))


def test_a_command_is_repeated_with_what_was_given_and_another_folder() -> None:
    given = ["my cake.yaml", "--set", "a=[1, 2]", "--set", "b=3", "--force", "-o", "old"]
    words = shlex.split(CliRunner().invoke(bake, given).output)
    assert words[0] == "bake"
    assert sorted(words[1:-2]) == sorted(given[:-2])
    assert words[words.index("a=[1, 2]") - 1] == words[words.index("b=3") - 1] == "--set"
    assert words[-2:] == ["-o", "new one"]


@pytest.mark.parametrize(
    ("name", "said"),
    [("bakee", "No such command 'bakee'; did you mean 'bake'?"), ("zzz", "No such command 'zzz'.")],
)
def test_a_group_says_which_of_its_commands_was_meant(name: str, said: str) -> None:
    summaries = {verb: f"{verb} it" for verb in ("wash", "bake")}
    group = LazyGroup("kitchen", summaries=summaries, target=f"{__name__}:{{}}")
    done = CliRunner().invoke(group, [name])
    assert done.exit_code == 2
    assert said in done.output
    listed = CliRunner().invoke(group, ["--help"]).output
    # In the order of work.
    assert listed.index("wash it") < listed.index("bake it")
    assert group.list_commands(click.Context(group)) == ["wash", "bake"]


# --- what fails on a record ---


def failing(error: Exception, *runs: Path) -> BaseException:
    """Give runs to a command that ends with an error, and take what becomes of it."""

    @click.command(cls=RecordCommand)
    @click.argument("first", type=click.Path(path_type=Path))
    @click.argument("others", nargs=-1, type=click.Path(path_type=Path))
    @click.option("--at", default="nowhere")
    def fail(**_given: object) -> None:
        raise error

    with pytest.raises(BaseException) as caught:  # noqa: PT011 - which one is what is asked
        fail.main([str(run) for run in runs], standalone_mode=False)
    return caught.value


@pytest.fixture
def intact(tmp_path: Path) -> Path:
    path, _, _ = write_sample(tmp_path)
    return path


@pytest.fixture
def changed(intact: Path, tmp_path: Path) -> Path:
    path = tmp_path / "changed.h5"
    path.write_bytes(intact.read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["seed"] = type(file.attrs["seed"])(b"8")
    return path


def test_what_fails_on_an_intact_record_is_our_own_fault(intact: Path) -> None:
    error = KeyError("wall")
    assert failing(error, intact) is error
    assert failing(error, intact, intact) is error


def test_what_fails_on_a_changed_record_is_that_ones(intact: Path, changed: Path) -> None:
    for runs in ((changed,), (intact, changed), (changed, intact), (intact, intact, changed)):
        error = KeyError("wall")
        told = failing(error, *runs)
        assert isinstance(told, RecordError)
        assert str(told).startswith(f"{changed} is not as it was written: ")
        assert told.__cause__ is error


@pytest.mark.parametrize("kind", [GeometryError, ProductError])
def test_a_product_that_breaks_its_rules_is_the_records(
    intact: Path, kind: type[Exception]
) -> None:
    told = failing(kind("no plane"), intact)
    assert isinstance(told, RecordError)
    assert str(told) == "a product of this run breaks its own rules: no plane"
