"""Creation of new plugins: a project that can be installed and passes its tests immediately."""

from orthoflow.scaffold.projects import Project, write_project

__all__ = ["Project", "write_project"]
