from ._ring import Ring as Ring, parse as parse
