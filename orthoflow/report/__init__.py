"""The report page: what came out and how good it is, in one file without network."""

from orthoflow.report.figures import write_figures
from orthoflow.report.pages import write_page, write_report

__all__ = ["write_figures", "write_page", "write_report"]
