"""Problems of a workflow, all collected before any is reported, each with its place."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, NoReturn

from orthoflow.errors import ArgumentError, OrthoflowError, PluginError, WorkflowError

if TYPE_CHECKING:
    from orthoflow.files.yaml_positions import Position


MOST_PROBLEMS: Final = 100
_SNIPPET_WIDTH: Final = 120


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One thing that is wrong.

    Attributes:
        file: the workflow file as the user named it, or the command-line option.
        line: from 1; 0 for a command-line option.
        column: from 1; 0 for a command-line option.
        path: where in the document, keys joined by dots, e.g. `steps.wall.params.gsd_m`.
        message: one sentence.
        text: the offending line, empty for a command-line option.
    """

    file: str
    line: int
    column: int
    path: str
    message: str
    text: str = ""

    @property
    def place(self) -> str:
        """Where it is, as it begins: `hall.yaml:3:9: steps.wall: `."""
        where = f"{self.file}:{self.line}:{self.column}" if self.line else self.file
        return f"{where}: {self.path}: " if self.path else f"{where}: "

    def __str__(self) -> str:
        head = f"{self.place}{self.message}"
        snippet = self._snippet()
        return f"{head}\n{snippet}" if snippet else head

    def _snippet(self) -> str:
        # Around the column, so that a line of a thousand characters does not bury the message.
        is_long = len(self.text) > _SNIPPET_WIDTH
        start = max(0, self.column - 1 - _SNIPPET_WIDTH // 2) if is_long else 0
        cut = self.text[start : start + _SNIPPET_WIDTH]
        shown = "".join(char if char.isprintable() else " " for char in cut)
        if not shown.strip():
            return ""
        indent = len(shown) - len(shown.lstrip())
        caret = " " * max(0, self.column - 1 - start - indent) + "^"
        return f"    {shown.strip()}\n    {caret}"


class _ProblemsError(OrthoflowError):
    """Some problems, a line each or more; `problems` holds them for tools."""

    def __init__(self, problems: tuple[Problem, ...]) -> None:
        self.problems = problems
        super().__init__("\n".join(str(problem) for problem in problems))


class InvalidWorkflowError(_ProblemsError, WorkflowError):
    """A workflow file has problems."""


class UnusablePluginError(_ProblemsError, PluginError):
    """A workflow is fine, but plugins it needs are not; `problems` says where it needs them."""


class InvalidArgumentsError(_ProblemsError, ArgumentError):
    """Command-line options do not fit the workflow."""


@dataclass
class ProblemLog:
    """Collects problems while a workflow is read.

    Attributes:
        file: the workflow file as the user named it.
        lines: its text.
    """

    file: str
    lines: tuple[str, ...] = ()
    _in_file: list[Problem] = field(default_factory=list)
    _in_plugins: list[Problem] = field(default_factory=list)
    _in_inputs: list[Problem] = field(default_factory=list)
    _in_options: list[Problem] = field(default_factory=list)

    def add(self, position: Position, path: str, message: str) -> None:
        """Keep a problem of the file.

        Raises:
            InvalidWorkflowError: there are so many that the file must be something else.
        """
        problem = self._at(position, path, message)
        if problem in self._in_file:
            return
        if len(self._in_file) == MOST_PROBLEMS:
            message = f"more than {MOST_PROBLEMS} problems; correct those above and try again"
            self._in_file.append(self._at(position, path, message))
            self._raise()
        self._in_file.append(problem)

    def beside(self, file: str, text: str) -> ProblemLog:
        """Give a log of another file, whose problems are told together with those of this one."""
        return replace(self, file=file, lines=tuple(text.splitlines()))

    @property
    def has_any(self) -> bool:
        """Whether there is a problem."""
        return bool(self._in_file or self._in_plugins or self._in_options)

    def place(self, position: Position, path: str) -> Problem | None:
        """Give a problem of something without its message; None of what comes from no file."""
        return self._at(position, path, "") if position.line else None

    def add_plugin(self, position: Position, path: str, message: str) -> None:
        """Keep a problem of a plugin that the file needs here."""
        problem = self._at(position, path, message)
        if problem not in self._in_plugins:
            self._in_plugins.append(problem)

    def add_input(self, place: Problem | None, message: str) -> None:
        """Keep a problem of input files, named at a place; what is wrong besides says its kind."""
        nowhere = Problem(file=self.file, line=0, column=0, path="", message="")
        if len(self._in_inputs) < MOST_PROBLEMS:
            self._in_inputs.append(replace(place or nowhere, message=message))

    def add_option(self, option: str, message: str) -> None:
        """Keep a problem of a command-line option, e.g. `--set wall.gsd_m=0`."""
        problem = Problem(file=option, line=0, column=0, path="", message=message)
        if problem not in self._in_options:
            self._in_options.append(problem)

    def raise_any(self) -> None:
        """End with all problems found so far, if there are any.

        Raises:
            InvalidWorkflowError: the file has problems.
            InvalidArgumentsError: only command-line options have.
            UnusablePluginError: only plugins have.
        """
        if self.has_any:
            self._raise()

    def _raise(self) -> NoReturn:
        in_order = sorted(
            self._in_file + self._in_plugins + self._in_inputs,
            key=lambda problem: (problem.file, problem.line, problem.column),
        )
        everything = tuple(in_order + self._in_options)
        if self._in_file:
            raise InvalidWorkflowError(everything)
        if self._in_options:
            raise InvalidArgumentsError(everything)
        raise UnusablePluginError(everything)

    def _at(self, position: Position, path: str, message: str) -> Problem:
        text = self.lines[position.line - 1] if 0 < position.line <= len(self.lines) else ""
        return Problem(
            file=self.file,
            line=position.line,
            column=position.column,
            path=path,
            message=message,
            text=text,
        )
