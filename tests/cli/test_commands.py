"""What commands share: the words that repeat one."""

from __future__ import annotations

import shlex
from pathlib import Path

import click
from click.testing import CliRunner

from orthoflow.cli.commands import command_again
from orthoflow.cli.tables import echo


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
