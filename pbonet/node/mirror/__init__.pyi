from .table_carrier import Mirrors as Mirrors
