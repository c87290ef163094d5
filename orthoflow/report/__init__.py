"""The report page: what came out and how good it is, in one file without network."""

from orthoflow.report.pages import write_page, write_report

__all__ = ["write_page", "write_report"]
