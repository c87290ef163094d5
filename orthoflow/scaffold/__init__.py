"""Writing a plugin's first files: a project that installs, works and passes its tests at once."""

from orthoflow.scaffold.projects import Project, unwritten, write_project

__all__ = ["Project", "unwritten", "write_project"]
