"""The built-in methods, one sub-package per kind; `hooks` announces them like a stranger's."""
