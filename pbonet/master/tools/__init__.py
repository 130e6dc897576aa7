"""Tools around a subsystem: doctor, new files, playback, live view, schedules."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
