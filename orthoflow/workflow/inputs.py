"""From the files that a workflow names to the files that are there."""

from __future__ import annotations

import glob
from collections.abc import Mapping
from pathlib import Path

from orthoflow.errors import InputError
from orthoflow.products.input_files import InputFiles
from orthoflow.workflow.model import Workflow, WorkflowInputSpec


def resolve_input_files(workflow: Workflow) -> Mapping[str, InputFiles | None]:
    """Find the files of every input, sorted by name; None for optional data that are absent.

    A file stands for itself, a folder for the files directly in it (hidden ones left out), a
    pattern for the files it matches (`**` for folders at any depth).

    Raises:
        InputError: a file is missing, a folder is empty, a pattern matches nothing, or an input
            that is not optional was given no files. An optional input may be missing unless it
            was named on the command line.
    """
    return {spec.name: _resolve(spec) for spec in workflow.inputs.values()}


def present_inputs(workflow: Workflow) -> frozenset[str]:
    """Names of the inputs that are there; those that are not optional always count as there."""
    return frozenset(
        spec.name
        for spec in workflow.inputs.values()
        if not spec.optional or _resolve(spec) is not None
    )


def _resolve(spec: WorkflowInputSpec) -> InputFiles | None:
    if not spec.files:
        if spec.optional:
            return None
        raise InputError(
            f"input {spec.name} has no files; name them in the workflow or with "
            f"--input {spec.name}=PATH"
        )
    try:
        paths = {path for pattern in spec.files for path in _find(spec, pattern)}
    except InputError:
        if spec.optional and not spec.is_given:
            return None
        raise
    return InputFiles(name=spec.name, paths=tuple(sorted(paths, key=lambda p: (p.name, str(p)))))


def _find(spec: WorkflowInputSpec, pattern: str) -> list[Path]:
    path = spec.folder / pattern
    where = " in the working directory" if spec.is_given else f" beside the workflow ({path})"
    if Path(pattern).is_absolute():
        where = ""
    if path.is_dir():
        files = [item for item in path.iterdir() if item.is_file() and item.name[0] != "."]
        missing = f"the folder {pattern}{where} holds no files"
    elif path.exists():
        files, missing = [path], ""
    elif glob.has_magic(pattern):
        # Names may themselves hold brackets; only what is no existing path is taken as a pattern.
        matches = glob.glob(str(path), recursive=True)  # noqa: PTH207 - pathlib refuses absolute ones
        files = [Path(match) for match in matches if Path(match).is_file()]
        missing = f"no file matches {pattern}{where}"
    else:
        files, missing = [], f"there is no file {pattern}{where}"
    if not files:
        raise InputError(f"input {spec.name}: {missing}")
    return [item.absolute() for item in files]
