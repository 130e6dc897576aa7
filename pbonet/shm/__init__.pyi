from .closeable import Closeable as Closeable
from .files import Files as Files, remove_same as remove_same
from .paths import folder as folder, own as own, path_of as path_of
