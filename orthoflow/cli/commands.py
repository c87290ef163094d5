"""Building blocks of commands: groups, shared options, error messages and exit codes."""

from __future__ import annotations

import contextlib
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click
from click.core import ParameterSource

from orthoflow.cli.tables import counted, echo
from orthoflow.errors import GeometryError, OrthoflowError, ProductError, RecordError

if TYPE_CHECKING:
    from orthoflow.catalog.catalog import Catalog
    from orthoflow.products.product import JsonValue
    from orthoflow.workflow.model import Workflow


DEBUG_HELP: Final = "Show tracebacks of errors."
# These settings are passed to each command, because click caches the help option that the first
# call creates.
HELP_OPTIONS: Final = {"help_option_names": ["-h", "--help"]}


@dataclass
class Session:
    """State of one call of the program.

    Attributes:
        debug: whether tracebacks are shown.
        resume_hint: sentence on how to continue after Ctrl-C; empty if that is not possible.
    """

    debug: bool = False
    resume_hint: str = ""


def current_session() -> Session:
    """Return the session of the running command, or a new session if there is no such command."""
    context = click.get_current_context(silent=True)
    session = context.find_object(Session) if context is not None else None
    return session if session is not None else Session()


def command_again(output: Path) -> str:
    """Return the running command as a shell command line with the given folder after -o."""
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
    """Return the `--debug` flag, which is accepted before and after the name of a command."""
    return click.Option(
        ["--debug"], is_flag=True, expose_value=False, callback=_keep_debug, help=DEBUG_HELP
    )


class Command(click.Command):
    """A command that accepts `--debug` after its name."""

    # The types are `Any` because the arguments are passed on to click.
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"context_settings": HELP_OPTIONS, **kwargs})
        self.params.append(debug_parameter())


class RecordCommand(Command):
    """A command whose arguments are runs; it reports damaged records as the cause of errors.

    Reading a record checks only its format. If reading succeeds but the command then fails, the
    record is verified to find out whether its parts are consistent.
    """

    def invoke(self, ctx: click.Context) -> object:
        """Run the command; if it fails because a record is damaged, report the damage."""
        try:
            return super().invoke(ctx)
        except (GeometryError, ProductError) as error:
            raise RecordError(f"a product of this run is invalid: {error}") from error
        except (OrthoflowError, OSError, click.ClickException, click.Abort, click.exceptions.Exit):
            raise
        except Exception as error:
            from orthoflow.records.verify import verify_run

            for path in self._runs(ctx):
                if findings := verify_run(path, also_published=False).findings:
                    raise RecordError(
                        f"{path} has been changed since it was written: {findings[0]}"
                    ) from error
            raise

    def _runs(self, ctx: click.Context) -> Iterator[str | Path]:
        for item in self.params:
            if isinstance(item, click.Argument):
                given = ctx.params[str(item.name)]
                yield from given if isinstance(given, tuple) else (given,)


class LazyGroup(click.Group):
    """A group of commands whose `--help` does not import the commands.

    Args:
        summaries: name of a command -> its one-line summary, in the order shown in the help.
        target: import string of the commands, `package.module:attribute`; `{}` is replaced by the
            name.
    """

    # The types are `Any` because the arguments are passed on to click.
    def __init__(
        self, *args: Any, summaries: Mapping[str, str], target: str, **kwargs: Any
    ) -> None:
        # Click requires a callback even for a group that does nothing itself.
        super().__init__(
            *args, **{"callback": lambda: None, "context_settings": HELP_OPTIONS, **kwargs}
        )
        self._summaries = summaries
        self._target = target

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands in the order of the table."""
        return list(self._summaries)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command; return None if there is no such command."""
        if cmd_name not in self._summaries:
            return None
        module_name, _, attribute = self._target.replace("{}", cmd_name).partition(":")
        command: click.Command = getattr(import_module(module_name), attribute)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; if there is none, suggest a similar name."""
        if args and self.get_command(ctx, args[0]) is None:
            from orthoflow.errors import nearest

            near = nearest(args[0], self._summaries)
            hint = f"; did you mean {near!r}?" if near else "."
            raise click.UsageError(f"No such command {args[0]!r}{hint}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands."""
        with formatter.section("Commands"):
            formatter.write_dl(list(self._summaries.items()))


def _keep_debug(ctx: click.Context, _param: click.Parameter, value: bool) -> None:  # noqa: FBT001
    session = ctx.find_object(Session)
    if session is not None and value:
        session.debug = True


# The bound is `Any` because click decorates functions as well as commands.
_Decorated = TypeVar("_Decorated", bound=Callable[..., Any] | click.Command)

DEFAULT_STORE: Final = Path(".orthoflow")


@dataclass(frozen=True, kw_only=True)
class Changes:
    """Options of a command that change the settings of a workflow file."""

    sets: tuple[str, ...]
    inputs: tuple[str, ...]
    datasets: str | Mapping[str, JsonValue]
    only_data: tuple[str, ...]
    set_files: tuple[str, ...] = ()

    def load(self, workflow: str, catalog: Catalog) -> Workflow:
        """Load the workflow with these changes; `load_workflow` documents the errors."""
        from orthoflow.workflow.document import load_workflow

        return load_workflow(workflow, catalog, also_files=True, **vars(self))


def workflow_arguments(run: Callable[..., int]) -> Callable[..., int]:
    """Add the argument WORKFLOW and the options for `Changes`, such as `--set`."""

    # The type is `Any` because click has checked the parameters of the command.
    @wraps(run)
    def command(**given: Any) -> int:
        changes = Changes(**{item.name: given.pop(item.name) for item in fields(Changes)})
        return run(changes=changes, **given)

    return _workflow_options(command)


def _together(*options: Callable[[_Decorated], _Decorated]) -> Callable[[_Decorated], _Decorated]:
    """Return a decorator that adds arguments and options, in the order of the help."""

    def add(command: _Decorated) -> _Decorated:
        for option in reversed(options):
            command = option(command)
        return command

    return add


input_option = click.option(
    "--input",
    "inputs",
    multiple=True,
    metavar="NAME=PATH",
    help="Set an input: a file, a folder or a quoted glob, relative to the working directory.",
)
store_option = click.option(
    "--store",
    type=click.Path(path_type=Path, file_okay=False),
    default=DEFAULT_STORE,
    show_default=True,
    metavar="DIR",
    help="Folder of stored results.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
_workflow_options = _together(
    click.argument("workflow", metavar="WORKFLOW"),
    click.option(
        "--set",
        "sets",
        multiple=True,
        metavar="STEP.PARAM=VALUE",
        help="Change a parameter, e.g. wall.gsd_m=0.002, plane.ransac.tolerance_m=0.05 or, quoted, "
        "'wall.near=[[1, 2, 3]]'.",
    ),
    click.option(
        "--set-file",
        "set_files",
        multiple=True,
        metavar="FILE",
        help="Change parameters as listed in a YAML file, as step.parameter: value.",
    ),
    input_option,
    click.option(
        "--datasets",
        default="",
        metavar="FILE",
        help="Run on each dataset of a CSV file with the column `name` and a column per input.",
    ),
    click.option(
        "--only-data",
        "only_data",
        multiple=True,
        metavar="NAMES",
        help="Run only on these datasets (comma-separated names).",
    ),
)
#: Options that select steps.
selection_options = _together(
    *(
        click.option(option, name, metavar="STEP", multiple=True, help=f"{text} Repeatable.")
        for option, name, text in (
            (
                "--only",
                "only",
                "Run this step and the steps that it needs, unless their results are stored.",
            ),
            (
                "--from",
                "from_",
                (
                    "Run this step, all steps that depend on it, and the steps that these need, "
                    "unless their results are stored."
                ),
            ),
            (
                "--until",
                "until",
                "Run this step and all steps that it needs; stored results are not recomputed.",
            ),
            ("--force", "force", "Run this step even if its result is already stored."),
        )
    )
)
#: Options for the execution of steps.
execution_options = _together(
    click.option(
        "--jobs", type=int, default=1, metavar="N", help="Number of steps that run in parallel."
    ),
    click.option(
        "--executor",
        type=click.Choice(["local", "inline", "dask"]),
        default="local",
        help="local: a process for each step; inline: all steps in this process, for debugging "
        "(the memory of a step then includes that of earlier steps); dask: Dask workers.",
    ),
    click.option(
        "--scheduler",
        default="",
        metavar="ADDRESS",
        help="With dask: address of the scheduler, tcp://HOST:PORT; by default, N local workers.",
    ),
    click.option(
        "--retries",
        type=int,
        default=2,
        show_default=True,
        metavar="N",
        help="With dask: how often a step is repeated, at most, if its worker is lost.",
    ),
)


def output_option(name: str) -> Callable[[_Decorated], _Decorated]:
    """Return a decorator that adds `-o`; `name` is the name of the default folder in `runs`."""
    return click.option(
        "-o",
        "--output",
        type=click.Path(path_type=Path, file_okay=False),
        metavar="RUNDIR",
        help=f"Run folder.  [default: runs/{name}]",
    )


EXIT_GOOD: Final = 0
EXIT_CELL_FAILED: Final = 1
EXIT_RECORD_DIFFERS: Final = 3
EXIT_PLUGIN_MISSING: Final = 4
EXIT_INTERRUPTED: Final = 130


def explain(error: Exception, session: Session) -> int:
    """Report an error that ended a command.

    Returns:
        The exit code of the process.
    """
    from orthoflow.engine.measuring import is_for_want_of_memory
    from orthoflow.sdk.lines import one_line

    if session.debug:
        import traceback

        echo_error(*"".join(traceback.format_exception(error)).rstrip("\n").split("\n"))
    if isinstance(error, click.Abort | KeyboardInterrupt):
        echo_error(session.resume_hint or "interrupted")
        return EXIT_INTERRUPTED
    if isinstance(error, OrthoflowError):
        interrupted = error.exit_code == EXIT_INTERRUPTED
        hint = session.resume_hint if interrupted else ""
        echo_error(*([hint] if hint else _sentences(error)))
        return error.exit_code
    if is_for_want_of_memory(error):
        echo_error("error: not enough memory to continue; free memory or raise the memory limit")
        return EXIT_CELL_FAILED
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename else ""
        echo_error(f"error: {where}{error.strerror.lower()}")
        return EXIT_CELL_FAILED
    if isinstance(error, ImportError):
        echo_error(
            f"error: a library cannot be imported: {one_line(error)}; `orthoflow doctor` lists "
            "missing libraries"
        )
        return EXIT_PLUGIN_MISSING
    echo_error(
        f"error: orthoflow itself failed ({type(error).__name__}: {one_line(error)}); "
        "repeat the command with --debug and report its output"
    )
    return EXIT_CELL_FAILED


def _sentences(error: OrthoflowError) -> list[str]:
    n_problems = len(getattr(error, "problems", ()))
    if not n_problems:
        return [f"error: {str(error) or type(error).__name__}"]
    # Print the problems unchanged: each begins with file:line:column, which editors and other tools
    # parse.
    return [*str(error).split("\n"), f"error: {counted(n_problems, 'problem')}"]


def echo_error(*lines: str) -> None:
    """Write lines to standard error; do nothing if the stream is closed."""
    with contextlib.suppress(BrokenPipeError):
        echo(*lines, err=True)


def echo_lint(workflow: Workflow) -> None:
    """Write probable mistakes in a valid workflow to standard error."""
    from orthoflow.workflow.checks import lint_workflow

    for warning in lint_workflow(workflow):
        echo_error(f"workflow: warning: {warning}")


def code_for(findings: Iterable[str], consequence: str) -> int:
    """Report findings on broken seals with their consequence, and return the exit code."""
    lines = [f"error: {one}; {consequence}" for one in findings if one]
    if not lines:
        return EXIT_GOOD
    echo_error(*lines)
    return EXIT_RECORD_DIFFERS


def silence_stdout() -> None:
    """Discard further output, so that a closed pipe does not cause an error at exit."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
