"""The library of ready modules, one a file, each with an .rmod beside it.

A module is loaded by its file's name. Names that begin with an underscore are shared
subroutines and no modules.
"""
