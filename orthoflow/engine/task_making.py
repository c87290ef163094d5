"""Makes the tasks of a run: what is known of each cell, and where everything lies."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from orthoflow.engine.environment import environment
from orthoflow.engine.keys import CellKey, MethodFacts
from orthoflow.engine.plan import PlannedInput, ProductTarget, RunPlan
from orthoflow.engine.results import MethodIdentity, ProductRef, shared_fields
from orthoflow.engine.run_folder import cell_file_name
from orthoflow.engine.store import Store
from orthoflow.engine.tasks import Task, TaskFile, TaskInput, TaskOutput
from orthoflow.workflow.expand import Cell, WorkflowInput


@dataclass(frozen=True, kw_only=True)
class TaskMaker:
    """Makes the tasks of one run.

    Attributes:
        plan: of the run.
        store: where products and results go.
        scratch: folder of the run for work in progress, on the store's file system.
        logs: folder for the logs of steps.
        run_id: of the run.
    """

    plan: RunPlan
    store: Store
    scratch: Path
    logs: Path
    run_id: str

    def make(self, cell: Cell, key: CellKey, refs: Mapping[str, ProductRef], cores: int) -> Task:
        """Give the task of a cell.

        Args:
            cell: the cell.
            key: its key.
            refs: port -> product.
            cores: threads it may use.
        """
        facts = self.plan.methods[cell.method]
        return Task(
            address=cell.address,
            run_id=self.run_id,
            target=facts.target,
            key=key.key,
            key_preimage=key.preimage,
            params=cell.params,
            seed=cell.seed,
            inputs={port: self._input(cell, port, ref) for port, ref in refs.items()},
            outputs=self._outputs(facts),
            cores=cores,
            timeout_s=cell.timeout_s,
            store=str(self.store.folder),
            folder=str(self.scratch / uuid.uuid4().hex[:12]),
            log=str(self.logs / f"{cell_file_name(cell.address)}.log"),
            kernels=facts.compiled_digest,
            environment=environment(cores),
            **shared_fields(facts, MethodIdentity),
        )

    def _input(self, cell: Cell, port: str, ref: ProductRef) -> TaskInput:
        source = cell.inputs[port]
        if not isinstance(source, WorkflowInput):
            return TaskInput(ref=ref, target=self.plan.products[ref.type_name].target)
        given = self.plan.inputs[source.name]
        return TaskInput(ref=ref, input_name=source.name, files=_task_files(given) if given else ())

    def _outputs(self, facts: MethodFacts) -> dict[str, TaskOutput]:
        return {
            port: TaskOutput(
                type_name=type_name, **shared_fields(self.plan.products[type_name], ProductTarget)
            )
            for port, type_name in facts.outputs.items()
        }


def _task_files(given: PlannedInput) -> tuple[TaskFile, ...]:
    return tuple(
        TaskFile(path=str(path.absolute()), identity=file.identity, sha256=file.sha256)
        for path, file in zip(given.paths, given.files, strict=True)
    )
