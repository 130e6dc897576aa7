from ._ring import Ring as Ring
from ._ring import parse as parse
