"""The installed methods, kinds and product types of all plugins, and problems of plugins.

The package imports numpy, pydantic and networkx only when a method is loaded.
"""
