"""The built-in methods, one sub-package per kind; `hooks` declares them as any plugin does."""
