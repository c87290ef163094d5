"""What is installed: methods, kinds and product types of all plugins, and what is wrong with them.

Light on purpose: nothing here loads numpy, pydantic or networkx until a method is loaded.
"""
