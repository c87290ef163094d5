"""Functions that write the record of a run, and the API for reading it."""

# These names belong to the record format and are re-exported for other packages.
from orthoflow_provenance.document import COSTS as COSTS
from orthoflow_provenance.document import Metric as Metric
from orthoflow_provenance.document import RecordedCell as RecordedCell
from orthoflow_provenance.document import RecordedEnvironment as RecordedEnvironment
from orthoflow_provenance.document import RecordedFigure as RecordedFigure
from orthoflow_provenance.document import RecordedFile as RecordedFile
from orthoflow_provenance.document import RunRecord as RunRecord
