"""`--input NAME=PATH`: files from the command line in the place of those that a workflow names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from orthoflow.catalog import did_you_mean
from orthoflow.workflow.model import WorkflowInputSpec
from orthoflow.workflow.problems import ProblemLog


@dataclass(frozen=True, kw_only=True)
class InputOption:
    """One `--input`.

    Attributes:
        name: of the workflow's input.
        path: a file, a folder or a glob, relative to the working directory.
    """

    name: str
    path: str

    def __str__(self) -> str:
        return f"--input {self.name}={self.path}"

    @property
    def without_folder(self) -> str:
        """The option as a record keeps it, which names no folder of this machine."""
        return f"--input {self.name}={Path(self.path).name}"


def read_input_options(texts: Sequence[str], log: ProblemLog) -> tuple[InputOption, ...]:
    """Read what stands behind each `--input`; what is no NAME=PATH goes to the log."""
    options = []
    for text in texts:
        name, _, path = text.partition("=")
        if name and path:
            options.append(InputOption(name=name, path=path))
        else:
            log.add_option(f"--input {text}", "expected NAME=PATH")
    return tuple(options)


def override_inputs(
    specs: Mapping[str, WorkflowInputSpec], options: Sequence[InputOption], log: ProblemLog
) -> dict[str, WorkflowInputSpec]:
    """Put files from the command line over the file's inputs; several of one name add up."""
    changed = dict(specs)
    for option in options:
        name = option.name
        if name not in specs:
            known = ", ".join(specs) or "none"
            log.add_option(
                str(option),
                f"there is no input {name}{did_you_mean(name, specs)}; inputs: {known}",
            )
        else:
            before = changed[name].files if changed[name].is_given else ()
            changed[name] = replace(
                specs[name], files=(*before, option.path), folder=Path.cwd(), is_given=True
            )
    return changed
