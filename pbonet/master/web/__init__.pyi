from .server import Served as Served, serve as serve
