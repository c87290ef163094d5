"""Finished runs: writing the record, and the read API."""

# Names from the record format, re-exported for the packages above.
from orthoflow_provenance.document import COSTS as COSTS
from orthoflow_provenance.document import Metric as Metric
from orthoflow_provenance.document import RecordedCell as RecordedCell
from orthoflow_provenance.document import RecordedEnvironment as RecordedEnvironment
from orthoflow_provenance.document import RecordedFigure as RecordedFigure
from orthoflow_provenance.document import RecordedFile as RecordedFile
from orthoflow_provenance.document import RunRecord as RunRecord
