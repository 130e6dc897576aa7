"""Rules that hold for every module of the library, each on a bench as it is used.

What is no number: a module in ERROR that names the variable, or numbers and no jump.
Turned on: outputs go on from where they stand. Robot interfaces: no cycle on old data.
Robots from files: a wrong file, frame or number of joints is refused by name.
"""

from __future__ import annotations
