"""``pbonet check``: is this file right?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

from . import options
from .parser import Argument, Option


def command(
    *,
    file: A[list[Path], Argument("The .svar, .rmod, .sbs, .job, .seq or .toml files.")],
    no_code: A[
        bool, Option("Import no module: judge what the files alone say.")
    ] = False,
    allow_outside: A[
        bool, Option("Read the files that a job names outside its folder, too.")
    ] = False,
    host: options.Host = "",
    library: options.Library = None,
    json_: options.Json = False,
) -> int:
    """Check files and report their errors.

    Of a job it also says which deadlines are met, and which execution times that rests
    on; of a sequence of jobs, whether these fit each other. Modules of the file's
    folder and of the libraries are imported, so their code runs, with your rights:
    check files that you do not trust with --no-code, which reads files only. The status
    is 1 if a file is wrong.

    Examples:
        Check a job with the files it names, and whether its deadlines are met:
        pbonet check puma.job
        Check every module configuration of this folder:
        pbonet check *.rmod
        Judge files that you do not trust without running their code:
        pbonet check --no-code puma.job
    """
    import msgspec

    from pbonet.master.configuration import check_file

    found = [
        check_file(path, library or (), host, code=not no_code, outside=allow_outside)
        for path in file
    ]
    data = [{**msgspec.to_builtins(one), "legal": one.legal} for one in found]
    text = "\n".join(line for one in found for line in one.lines())
    options.show(text, data, as_data=json_)
    return int(not all(one.legal for one in found))
