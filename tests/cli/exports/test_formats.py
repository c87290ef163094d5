"""Formats of exports: which options belong to which, and what is said of those that do not."""

from __future__ import annotations

from dataclasses import fields
from importlib import import_module
from typing import Final

import pytest

from orthoflow.cli.export import format_options
from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.formats import FORMATS, FormatOption, check_choices, listed
from orthoflow.errors import ArgumentError

OPTIONS: Final = format_options()


def test_every_option_is_one_of_the_choices_and_belongs_to_formats_that_there_are() -> None:
    assert {str(option.name) for option in OPTIONS} <= {field.name for field in fields(Choices)}
    assert all({*option.formats} <= FORMATS.keys() for option in OPTIONS)


@pytest.mark.parametrize("target", FORMATS)
def test_every_format_has_its_writer(target: str) -> None:
    module, _, name = FORMATS[target].writer.partition(":")
    assert callable(getattr(import_module(f"orthoflow.cli.exports.{module}"), name))


@pytest.mark.parametrize("option", OPTIONS, ids=lambda option: option.name)
def test_an_option_goes_with_the_formats_that_it_belongs_to(option: FormatOption) -> None:
    # 0 is the first wall, and a grid of none.
    value = 0 if option.name in ("wall", "grid") else ("x",)
    chosen = Choices(**{str(option.name): value})  # type: ignore[arg-type]
    owners = [target for target in FORMATS if target in option.formats]
    for target in FORMATS:
        if target in owners:
            check_choices(chosen, target, OPTIONS)
            continue
        with pytest.raises(ArgumentError) as caught:
            check_choices(chosen, target, OPTIONS)
        said = f"{option.opts[0]} applies to --to {listed(owners)}, not to --to {target}"
        assert str(caught.value) == said


def test_nothing_else_is_refused() -> None:
    for target in FORMATS:
        check_choices(Choices(), target, OPTIONS)
    check_choices(Choices(embed=True), "ro-crate", OPTIONS)
    check_choices(Choices(embed=True, inputs=("scan=a.laz",)), None, OPTIONS)
    check_choices(Choices(split=True), None, OPTIONS)


@pytest.mark.parametrize(
    ("chosen", "target", "said"),
    [
        (Choices(), None, "choose a format: --to "),
        (Choices(split=True), "csv", "--split cannot be combined with --to csv: split first"),
        (
            Choices(split=True, embed=True),
            None,
            "--split cannot be combined with --embed: split fir",
        ),
        (Choices(embed=True), "csv", "--to csv writes no record, so nothing can be embedded"),
        (Choices(inputs=("a=b",)), "csv", "--input applies to --embed, not to --to csv"),
        (Choices(inputs=("a=b",), split=True), None, "--input applies to --embed, not to --split"),
        (Choices(wall=1, embed=True), None, ", not to --embed"),
        (Choices(wall=1, split=True), None, ", not to --split"),
    ],
)
def test_what_contradicts_itself_is_refused(chosen: Choices, target: str | None, said: str) -> None:
    with pytest.raises(ArgumentError) as caught:
        check_choices(chosen, target, OPTIONS)
    assert said in str(caught.value)
