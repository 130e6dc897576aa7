"""Builds the native parts: before all else, side by side, and not without a compiler.

What they are is in pyproject.toml.
"""

from __future__ import annotations

import os
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
    """Builds the native parts side by side; with ``--debug``, for a debugger."""

    def initialize_options(self) -> None:
        """Set the defaults of options."""
        super().initialize_options()
        self.parallel = os.cpu_count() or 1

    def run(self) -> None:
        """Build, if this machine has what is needed."""
        if lacks := preflight.lacks_to_compile():
            sys.exit("\n".join(f"pbonet: {sentence}" for sentence in lacks))
        included = [
            str(file) for file in Path("pbonet").rglob("*") if file.suffix in _INCLUDED
        ]
        self.translate()
        for part in self.extensions:
            part.depends = [*part.depends, *included]
            if not self.debug:  # Python's own flags ask for a debugger's symbols
                part.extra_compile_args = [*part.extra_compile_args, "-g0"]
        super().run()

    def translate(self) -> None:
        """Translate all parts to C, in processes, and have the largest compiled first.

        One at a time and in threads, as setuptools has it done, they would wait for
        each other: Cython holds the interpreter's lock.
        """
        from Cython.Build import cythonize

        translated = cythonize(
            self.extensions,
            nthreads=self.parallel,
            quiet=True,
            force=self.force,
            include_path=["."],
            shared_utility_qualified_name="pbonet._cython",
        )
        for part, found in zip(self.extensions, translated, strict=True):
            part.sources = found.sources
        self.extensions.sort(
            key=lambda part: Path(part.sources[0]).stat().st_size, reverse=True
        )


setup(cmdclass={"build": Build, "build_ext": BuildNative})
