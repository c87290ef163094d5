"""Methods that read files, run on them as a step runs them, with what they reported."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from orthoflow.products import InputFiles, Product
from orthoflow.sdk import Method, StepContext


class Reader:
    """Runs a method on files.

    Attributes:
        folder: where files may lie; scratch folders are made there.
        ctx: of the last run.
    """

    def __init__(self, method: type[Method], folder: Path) -> None:
        self.folder = folder
        self.ctx: StepContext
        # Any: ports and parameters differ by method.
        self._method: Any = method

    def run(
        self, paths: tuple[Path, ...], params: Mapping[str, object], **inputs: Product | None
    ) -> Any:
        """Return what the method returns for files, parameters as in a workflow, other inputs."""
        scratch = Path(tempfile.mkdtemp(prefix="scratch-", dir=self.folder))
        self.ctx = StepContext(rng=np.random.default_rng(0), cores=1, scratch=scratch)
        files = InputFiles(name=self._method.id.partition(".")[2], paths=paths)
        checked = self._method.Params.model_validate_json(json.dumps(params), strict=True)
        return self._method().run(self._method.In(files=files, **inputs), checked, self.ctx)

    @property
    def warnings(self) -> str:
        return "\n".join(self.ctx.warnings)

    @property
    def metrics(self) -> dict[str, float]:
        return {metric.name: metric.value for metric in self.ctx.metrics}


# Any: ports and parameters differ by method.
def run(method: Any, ctx: StepContext, inputs: Mapping[str, object], /, **params: Any) -> Any:
    """What a method makes of its inputs."""
    return method().run(method.In(**inputs), method.Params(**params), ctx)
