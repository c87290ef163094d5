"""What commands are made of: groups that load them on first use, `--debug`, one call's session."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import click
from click.core import ParameterSource

from orthoflow.errors import GeometryError, OrthoflowError, ProductError, RecordError

DEBUG_HELP: Final = "Show tracebacks of errors."


@dataclass
class Session:
    """State of one call of the program.

    Attributes:
        debug: show tracebacks.
        resume_hint: sentence that says how to go on after Ctrl-C, empty when there is no way.
    """

    debug: bool = False
    resume_hint: str = ""


def current_session() -> Session:
    """Give the session of the running command; one of its own for a command called alone."""
    context = click.get_current_context(silent=True)
    session = context.find_object(Session) if context is not None else None
    return session if session is not None else Session()


def command_again(output: Path) -> str:
    """Write the running command as a shell takes it, with a folder behind -o."""
    context = click.get_current_context()
    words = [context.command_path]
    for item in context.command.params:
        name = str(item.name)
        is_given = context.get_parameter_source(name) is ParameterSource.COMMANDLINE
        if not is_given or name == "output":
            continue
        value = context.params[name]
        for text in value if isinstance(value, tuple) else (value,):
            is_flag = isinstance(item, click.Option) and item.is_flag
            words += [item.opts[0]] if isinstance(item, click.Option) else []
            words += [] if is_flag else [shlex.quote(str(text))]
    return " ".join([*words, "-o", shlex.quote(str(output))])


def debug_parameter() -> click.Option:
    """Give the `--debug` flag, which may stand before or behind the name of a command."""
    return click.Option(
        ["--debug"], is_flag=True, expose_value=False, callback=_keep_debug, help=DEBUG_HELP
    )


class Command(click.Command):
    """A command that also takes `--debug` behind its name."""

    # Any: click passes its own keyword arguments through.
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.params.append(debug_parameter())

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments; where a shell took a list apart, say so."""
        given = list(args)
        try:
            return super().parse_args(ctx, args)
        except click.UsageError as error:
            broken = (one for one in given if one.count("[") > one.count("]"))
            found = next(broken, "")
            # Behind a space, a negative number looks like an option.
            is_number = isinstance(error, click.NoSuchOption) and error.option_name[1:2].isdigit()
            if not found or not (is_number or "unexpected extra argument" in error.message):
                raise
            sentence = (
                f"{error.message.rstrip('.')}; {found} was taken apart at its spaces: put all of "
                "the value in quotes, as --set 'wall.near=[[1, 2, 3]]'"
            )
            raise click.UsageError(sentence, ctx) from error


class RecordCommand(Command):
    """A command whose arguments are runs: what fails on a damaged record is said to be its fault.

    Reading checks the form of a record, not what one part of it says of another; verifying does.
    """

    def invoke(self, ctx: click.Context) -> object:
        """Run the command; where it fails on what a record holds, say what is wrong with that."""
        try:
            return super().invoke(ctx)
        except (GeometryError, ProductError) as error:
            raise RecordError(f"a product of this run breaks its own rules: {error}") from error
        except (OrthoflowError, OSError, click.ClickException, click.Abort, click.exceptions.Exit):
            raise
        except Exception as error:
            from orthoflow.records.verification import verify_run

            for path in self._runs(ctx):
                if findings := verify_run(path, also_published=False).findings:
                    raise RecordError(f"{path} is not as it was written: {findings[0]}") from error
            raise

    def _runs(self, ctx: click.Context) -> Iterator[str | Path]:
        for item in self.params:
            if isinstance(item, click.Argument):
                given = ctx.params[str(item.name)]
                yield from given if isinstance(given, tuple) else (given,)


@dataclass(frozen=True, kw_only=True)
class LazyCommand:
    """Where a command is.

    Attributes:
        target: import string `package.module:attribute`.
        summary: one line for `--help`, so that listing loads nothing.
    """

    target: str
    summary: str

    def load(self) -> click.Command:
        """Import the command's module and give the command."""
        module_name, _, attribute = self.target.partition(":")
        command = getattr(import_module(module_name), attribute)
        if not isinstance(command, click.Command):
            raise TypeError(f"{self.target} is a {type(command).__name__}, not a command")
        return command


class LazyGroup(click.Group):
    """A group whose `--help` lists summaries without importing a single command."""

    # Any: click passes its own keyword arguments through.
    def __init__(self, *args: Any, lazy: Mapping[str, LazyCommand], **kwargs: Any) -> None:
        # Click wants a callback on a group, though nothing happens before its command.
        super().__init__(*args, **{"callback": lambda: None, **kwargs})
        self._lazy = dict(lazy)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Give the names in the order of the table, which is the order of work."""
        return list(self._lazy)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Load one command."""
        found = self._lazy.get(cmd_name)
        return found.load() if found is not None else None

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command, and say which one was probably meant when there is none."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            from orthoflow.catalog.wording import nearest

            near = nearest(args[0], self._lazy)
            if not near or "did you mean" in error.message.lower():
                raise
            sentence = f"{error.message.rstrip('.')}; did you mean {near!r}?"
            raise click.UsageError(sentence, ctx) from error

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands from the table."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.summary) for name, entry in self._lazy.items()])


def _keep_debug(ctx: click.Context, _param: click.Parameter, value: bool) -> None:  # noqa: FBT001
    session = ctx.find_object(Session)
    if session is not None and value:
        session.debug = True
