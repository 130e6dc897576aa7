"""``pbonet completion``: have the shell complete verbs, options and names."""

from __future__ import annotations

from typing import Annotated as A, Literal

from . import options
from .parser import Argument, Option


def command(
    *,
    shell: A[Literal["bash", "zsh", "fish"], Argument("Your shell.")],
    install: A[
        bool, Option("Install it for new shells, and print where it stands.")
    ] = False,
    json_: options.Json = False,
) -> None:
    """Print or install the script that completes commands in your shell.

    Examples:
        Complete in every bash that you start from now on:
        pbonet completion bash --install
        Complete in this zsh:
        eval "$(pbonet completion zsh)"
    """
    from . import completing

    if install:
        options.show_files(completing.install(shell), as_data=json_)
        return
    script = completing.SCRIPTS[shell]
    options.show(script.rstrip(), {"script": script}, as_data=json_)
