"""The workflow document: reading it, checking it, and expanding it into cells."""

from __future__ import annotations

from orthoflow.workflow.cells import (
    Cell,
    CellOutput,
    Selection,
    WorkflowInput,
    check_step_names,
    derive_seed,
    expand_cells,
    variants_text,
)
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.doubts import doubts_about
from orthoflow.workflow.format import (
    Comparison,
    StepVariant,
    Workflow,
    WorkflowInputSpec,
    WorkflowStep,
)
from orthoflow.workflow.inputs import present_inputs, resolve_input_files
from orthoflow.workflow.problems import (
    InvalidArgumentsError,
    InvalidWorkflowError,
    Problem,
    UnusablePluginError,
)
from orthoflow.workflow.recipes import shipped_workflow, shipped_workflows
from orthoflow.workflow.resolved import resolved_json
from orthoflow.workflow.schema import workflow_schema
from orthoflow.workflow.shapes import Reference
from orthoflow.workflow.wiring import topological_steps

__all__ = [
    "Cell",
    "CellOutput",
    "Comparison",
    "InvalidArgumentsError",
    "InvalidWorkflowError",
    "Problem",
    "Reference",
    "Selection",
    "StepVariant",
    "UnusablePluginError",
    "Workflow",
    "WorkflowInput",
    "WorkflowInputSpec",
    "WorkflowStep",
    "check_step_names",
    "derive_seed",
    "doubts_about",
    "expand_cells",
    "load_workflow",
    "present_inputs",
    "resolve_input_files",
    "resolved_json",
    "shipped_workflow",
    "shipped_workflows",
    "topological_steps",
    "variants_text",
    "workflow_schema",
]
