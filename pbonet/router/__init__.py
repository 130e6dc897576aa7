"""The router: a process through which the agents and masters of many machines meet.

It is zenoh's router, as in `zenohd`, with the same configuration file. It knows neither
RTPUs nor subsystems, and keeps nothing.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
