"""The report of a run, which is one HTML file that needs no network."""

from orthoflow.report.figures import write_figures
from orthoflow.report.pages import write_page, write_report

__all__ = ["write_figures", "write_page", "write_report"]
