"""Where numbers come from: environments and data, told apart by letters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from string import ascii_uppercase

from orthoflow.records import RecordedEnvironment, Run


@dataclass(frozen=True, kw_only=True)
class Origins:
    """Capital letters for the environments, small ones for the data of one or more runs.

    Attributes:
        environments: id -> letter.
        data: identity of a run's data -> letter.
        legend: what each sign in use stands for; empty when nothing needs to be told apart.
    """

    environments: Mapping[str, str]
    data: Mapping[tuple[str, ...], str]
    legend: Mapping[str, str]

    @staticmethod
    def of(runs: Sequence[Run]) -> Origins:
        """Look through the environments and the data of runs."""
        environments = {
            environment.id: environment for run in runs for environment in run.record.environments
        }
        letters = {key: _letter(index) for index, key in enumerate(environments)}
        sources = dict.fromkeys(_data_of(run) for run in runs)
        # No digits: raised behind a number they would look like powers.
        small = {key: _letter(index).lower() for index, key in enumerate(sources)}
        legend: dict[str, str] = {}
        if len(environments) > 1:
            legend |= {
                letters[key]: environment_words(environment)
                for key, environment in environments.items()
            }
        if len(sources) > 1:
            legend |= {
                small[key]: "data of run "
                + ", ".join(run.record.run_id for run in runs if _data_of(run) == key)
                for key in sources
            }
        return Origins(environments=letters, data=small, legend=legend)

    def letters(self, run: Run, environment: str) -> str:
        """Give the sign of a value; empty when all values are of one kind."""
        letter = self.environments.get(environment, "?") if len(self.environments) > 1 else ""
        small = self.data[_data_of(run)] if len(self.data) > 1 else ""
        return letter + small


def environment_words(environment: RecordedEnvironment) -> str:
    """Say in one line where something was computed."""
    commit = f", code at commit {environment.git_commit}" if environment.git_commit else ""
    return (
        f"Python {environment.python}, {environment.os}, {environment.cpu}, "
        f"{environment.cores} processors, {environment.threads} threads{commit}"
    )


def _letter(index: int) -> str:
    # 27 environments in one report: AA follows Z.
    first, last = divmod(index, len(ascii_uppercase))
    return (ascii_uppercase[first - 1] if first else "") + ascii_uppercase[last]


def _data_of(run: Run) -> tuple[str, ...]:
    """What the run's methods were given: digests of its input files, and of simulated data."""
    return tuple(sorted(_digests(run)))


def _digests(run: Run) -> Iterator[str]:
    for given in run.record.inputs:
        for file in given.files:
            yield file.sha256
    for cell in run.record.cells:
        if cell.status == "ok" and not cell.inputs:
            yield from (product.digest for product in cell.outputs.values())
