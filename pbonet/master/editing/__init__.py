"""A job being edited: tasks, wires and variables, judged after every change."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
