"""Where things lie in a record: names of groups, datasets and columns, for writer and reader."""

from __future__ import annotations

from typing import Final

from orthoflow_provenance.tables import Columns

RUN_FORMAT: Final = "orthoflow-run"
RUN_FORMAT_VERSION: Final = "1.1"

WORKFLOW: Final = "workflow"
INPUTS: Final = "inputs"
INPUT_CONTENTS: Final = "content"
ENVIRONMENTS: Final = "environments"
CELLS: Final = "cells"
CELL_INPUTS: Final = "in"
CELL_OUTPUTS: Final = "out"
FIGURES: Final = "figures"
PUBLISHED: Final = "published"

FILE_COLUMNS: Final[Columns] = (("name", str), ("size_bytes", int), ("sha256", str))
PUBLISHED_COLUMNS: Final[Columns] = (("path", str), ("size_bytes", int), ("sha256", str))
PACKAGE_COLUMNS: Final[Columns] = (("name", str), ("version", str))
ASSIGNMENT_COLUMNS: Final[Columns] = (("step", str), ("variant", str))
METRIC_COLUMNS: Final[Columns] = (("name", str), ("value", float), ("unit", str))
