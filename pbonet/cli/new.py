"""``pbonet new``: write the first files of a module, a table, a job, a program."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

from . import options
from .parser import Argument, Option

HELP = "Write the first files of a module, a variable table, a job, or a program."

Name = A[str, Argument("Its name: letters, digits, underscores.")]
Rmods = A[
    list[str],
    Argument("The tasks: .rmod files of this folder or a library, or modules.", "RMOD"),
]
Sizes = A[
    list[str] | None,
    Option("A size that no port declares.", "NAME=NUMBER", names=("--size",)),
]
Folder = A[Path, Option("Where the files are written.", "FOLDER")]
Force = A[bool, Option("Replace files that exist.")]


def module(
    *,
    name: Name,
    inputs: A[
        list[str] | None,
        Option("An in-var: NAME[:SHAPE[:UNIT[:TYPE]]].", "PORT", names=("--in",)),
    ] = None,
    outputs: A[
        list[str] | None, Option("An out-var.", "PORT", names=("--out",))
    ] = None,
    inconst: A[list[str] | None, Option("An in-const.", "PORT")] = None,
    outconst: A[list[str] | None, Option("An out-const.", "PORT")] = None,
    svar: A[
        Path | None,
        Option("A .svar file that has the shapes and units of the ports.", "FILE"),
    ] = None,
    desc: A[str, Option("What it does, in one line.")] = "",
    freq: A[float, Option("Its frequency, Hz.", "HZ", least=1e-3)] = 100.0,
    timing_failure: A[bool, Option("Write a handler of timing failures too.")] = False,
    c: A[bool, Option("Write it in C, with a Makefile.")] = False,
    folder: Folder = Path(),
    force: Force = False,
    json_: options.Json = False,
) -> None:
    """Write a module, its .rmod file (module configuration) and its test.

    Examples:
        Begin a module that reads six joint angles and writes six torques:
        pbonet new module spring --in Q_MEZ:6:rad --out T_CMD:6:N*m
        Take shapes and units from a table of variables:
        pbonet new module spring --in Q_MEZ --out T_CMD --svar puma.svar
        Write it in C:
        pbonet new module spring --c --in Q_MEZ:6:rad --out T_CMD:6:N*m
    """
    from pbonet.master.tools import write_new_files

    ports = {
        "in": inputs or [],
        "out": outputs or [],
        "inconst": inconst or [],
        "outconst": outconst or [],
    }
    paths = write_new_files.new_module(
        name,
        ports,
        svar=svar,
        desc=desc,
        freq=freq,
        timing_failure=timing_failure,
        in_c=c,
        folder=folder,
        force=force,
    )
    options.show_files(paths, as_data=json_)


def svar(
    *,
    name: Name,
    rmods: Rmods,
    sizes: Sizes = None,
    library: options.Library = None,
    folder: Folder = Path(),
    add: A[bool, Option("Add what an existing table lacks; the rest stays.")] = False,
    force: Force = False,
    json_: options.Json = False,
) -> None:
    """Write the table (.svar) of the variables that tasks need.

    Examples:
        Write the table of two tasks:
        pbonet new svar arm sine joint_pid --size n=6
        Add the variables of a third task to it:
        pbonet new svar arm jttrace --add
        Write it into another folder:
        pbonet new svar arm sine joint_pid --size n=6 --folder cell
    """
    from pbonet.master.tools import write_new_files

    paths, warnings = write_new_files.new_svar(
        name,
        rmods,
        sizes=sizes or (),
        libraries=library or (),
        folder=folder,
        add=add,
        force=force,
    )
    options.show_files(paths, warnings, as_data=json_)


def job(
    *,
    name: Name,
    rmods: Rmods,
    sbs: A[Path | None, Option("The subsystem; a new one if left out.", "FILE")] = None,
    sizes: Sizes = None,
    desc: A[str, Option("What it does, in one line.")] = "",
    library: options.Library = None,
    folder: Folder = Path(),
    force: Force = False,
    json_: options.Json = False,
) -> None:
    """Write a job of tasks; without --sbs also its subsystem and table.

    Examples:
        Write all that is needed to check and run two tasks:
        pbonet new job hold sine joint_pid --size n=6
        Write a job for a subsystem that exists:
        pbonet new job hold sine joint_pid --sbs arm.sbs
    """
    from pbonet.master.tools import write_new_files

    paths, warnings = write_new_files.new_job(
        name,
        rmods,
        sbs=sbs,
        sizes=sizes or (),
        desc=desc,
        libraries=library or (),
        folder=folder,
        force=force,
    )
    options.show_files(paths, warnings, as_data=json_)


def program(
    *,
    file: A[Path, Argument("The .seq file.", "FILE")],
    output: A[
        Path | None,
        Argument("The program; by default beside the file, as NAME.py.", "PROGRAM"),
    ] = None,
    force: Force = False,
    json_: options.Json = False,
) -> None:
    """Write a sequence of jobs (.seq) as a program in Python.

    The program does the same; it needs the jobs, and no longer the .seq file.

    Examples:
        Write carry.py, to be run by 'python carry.py' or 'python carry.py --sim':
        pbonet new program carry.seq
        Write it under another name, over an older one:
        pbonet new program carry.seq main.py --force
    """
    from pbonet.master.tools import export_program

    options.show_files(
        export_program.new_program(file, output, force=force), as_data=json_
    )


COMMANDS = (module, svar, job, program)
