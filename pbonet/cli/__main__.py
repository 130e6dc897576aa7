"""``python -m pbonet.cli``: the same as the command ``pbonet``."""

from . import main

if __name__ == "__main__":
    main()
