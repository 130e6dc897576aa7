"""What becomes of tasks whose RTPU process or machine was lost: restart, takeover."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
