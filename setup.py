"""Builds the native parts: before all else, side by side, and not without a compiler.

What they are is in pyproject.toml.
"""

from __future__ import annotations

import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build import build
from setuptools.command.build_ext import build_ext

sys.path.insert(0, str(Path(__file__).parent / "scripts"))
import preflight

_INCLUDED = {".h", ".pxd", ".pxi"}
"""Files that native parts include; a change of one builds all of them again."""


class Build(build):
    """Builds the native parts first, so that what they lack is reported alone."""

    sub_commands = sorted(build.sub_commands, key=lambda step: step[0] != "build_ext")


class BuildNative(build_ext):
    """Builds the native parts side by side."""

    def initialize_options(self) -> None:
        """Set the defaults of options."""
        super().initialize_options()
        self.parallel = 4

    def run(self) -> None:
        """Build, if this machine has what is needed."""
        if lacks := preflight.lacks_to_compile():
            sys.exit("\n".join(f"pbonet: {sentence}" for sentence in lacks))
        included = [
            str(file) for file in Path("pbonet").rglob("*") if file.suffix in _INCLUDED
        ]
        for part in self.extensions:
            part.depends = [*part.depends, *included]
        super().run()


setup(cmdclass={"build": Build, "build_ext": BuildNative})
