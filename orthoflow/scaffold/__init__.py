"""Creation of new plugins: a project that can be installed and passes its tests immediately."""

from orthoflow.scaffold.projects import Project, unwritten, write_project

__all__ = ["Project", "unwritten", "write_project"]
