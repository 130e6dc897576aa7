"""The library of modules: one per file, each with an .rmod file beside it.

A module is loaded by its file's name. Names that begin with an underscore are shared
subroutines and no modules.
"""
