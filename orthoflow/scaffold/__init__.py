"""Writing a plugin's first files: a project that installs, works and passes its tests at once."""

from orthoflow.scaffold.projects import Project, write_project

__all__ = ["Project", "write_project"]
