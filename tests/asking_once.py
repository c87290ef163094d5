"""Workers of a test's cluster ask one new interpreter what is installed, for all of them.

Dask loads this module in each worker with the folder in which the answers lie.
"""

from __future__ import annotations

import fcntl
import hashlib
from pathlib import Path

import click
from distributed import Worker

from orthoflow.engine import keys


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
def dask_setup(_: Worker, folder: Path) -> None:
    """Let this worker take the answer that another one got, where there is one."""
    ask = keys._methods_here

    def ask_once(names: tuple[str, ...]) -> str:
        name = hashlib.sha256(" ".join(names).encode()).hexdigest()
        with (folder / name).open("a+") as answer:
            fcntl.flock(answer, fcntl.LOCK_EX)
            answer.seek(0)
            if not (said := answer.read()):
                said = ask(names)
                answer.write(said)
        return said

    keys._methods_here = ask_once  # type: ignore[assignment]
