"""Ports: what a port-based object exchanges with others (Stewart 1994, 3.3, 3.5).

A port is declared by an annotation in a module's class body and by nothing else. This
package knows what a port is, checks how it was declared, unifies the sizes of a
module's ports, and makes the attributes through which a module uses them.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
