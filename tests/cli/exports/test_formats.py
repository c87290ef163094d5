"""Formats of exports: which options belong to which, and what is said of those that do not."""

from __future__ import annotations

from dataclasses import fields
from typing import Final

import pytest

from orthoflow.cli.export import format_options
from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.formats import FORMATS, FormatOption, check_choices
from orthoflow.errors import ArgumentError

OPTIONS: Final = format_options()


def refused(chosen: Choices, target: str | None) -> str:
    """What is said of options that do not go together; nothing where they do."""
    try:
        check_choices(chosen, target, OPTIONS)
    except ArgumentError as error:
        return str(error).partition(";")[0]
    return ""


def test_every_option_is_one_of_the_choices_and_every_format_has_its_writer() -> None:
    assert {str(option.name) for option in OPTIONS} <= {field.name for field in fields(Choices)}
    assert all({*option.formats} <= FORMATS.keys() for option in OPTIONS)
    assert all(callable(entry.load()) for entry in FORMATS.values())


@pytest.mark.parametrize("option", OPTIONS, ids=lambda option: option.name)
def test_an_option_goes_with_the_formats_that_it_belongs_to(option: FormatOption) -> None:
    # 0 is the first wall, and a grid of none.
    value = 0 if option.name in ("wall", "grid") else ("x",)
    chosen = Choices(**{str(option.name): value})  # type: ignore[arg-type]
    for target in FORMATS:
        said = f"{option.opts[0]} cannot be combined with --to {target}"
        assert refused(chosen, target) == ("" if target in option.formats else said)
        assert refused(Choices(), target) == ""


@pytest.mark.parametrize(
    ("chosen", "target", "said"),
    [
        (Choices(embed=True), "ro-crate", ""),
        (Choices(embed=True, inputs=("scan=a.laz",)), None, ""),
        (Choices(split=True), None, ""),
        (Choices(), None, "choose a format: --to "),
        (Choices(split=True), "csv", "--split cannot be combined with --to csv"),
        (Choices(split=True, embed=True), None, "--embed cannot be combined with --split"),
        (Choices(embed=True), "csv", "--embed cannot be combined with --to csv"),
        (Choices(inputs=("a=b",)), "csv", "--input cannot be combined with --to csv"),
        (Choices(wall=1, embed=True), None, "--wall cannot be combined with --embed"),
    ],
)
def test_what_contradicts_itself_is_refused(chosen: Choices, target: str | None, said: str) -> None:
    assert refused(chosen, target).startswith(said)
    assert bool(refused(chosen, target)) == bool(said)
