"""Writes an allocation into its job, and changes the running subsystem to it.

A task has one name in the whole subsystem, so a running task is moved by a copy of its
RMOD under another name, which takes over on the new RTPU as in any other `switch`.
"""

from __future__ import annotations

import re
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import structs

from pbonet.config import rewrite_job
from pbonet.errors import PbonetError
from pbonet.master.console import oneshot
from pbonet.master.editing import JobEditor

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from pbonet.master.configuration import Place
    from pbonet.master.console import Reply
    from pbonet.master.editing import DraftFiles, FileChange

_ON = "ON"
_NUMBER = re.compile(r"_\d+$")


def draft(
    job: str | Path, places: Mapping[str, str], libraries: Iterable[str | Path] = ()
) -> JobEditor:
    """Return an editor of a job with other RTPUs of tasks; nothing is saved.

    Args:
        job: The ``.job`` file.
        places: The new RTPU of each task that moves.
        libraries: Folders of module libraries.
    """
    editor = JobEditor(job, libraries)
    for task, rtpu in places.items():
        editor.set_field(task, "rtpu", rtpu)
    return editor


def draft_of_copies(
    job: str | Path, places: Mapping[str, str], libraries: Iterable[str | Path] = ()
) -> JobEditor:
    """Return an editor of a job where each task that moves has a new name.

    Args:
        job: The ``.job`` file.
        places: The new RTPU of each task that moves.
        libraries: Folders of module libraries.
    """
    editor = JobEditor(job, libraries)
    for task, rtpu in places.items():
        name = _copy_name(editor, task)
        editor.rename_task(task, name)
        editor.set_field(name, "rtpu", rtpu)
    return editor


def _copy_name(editor: JobEditor, task: str) -> str:
    base, number = _NUMBER.sub("", task), 2
    while not editor.files.is_free(f"{base}_{number}"):
        number += 1
    return f"{base}_{number}"


def switch(editor: JobEditor, place: Place, *, dry_run: bool) -> list[Reply]:
    """Change the running subsystem to a draft; only verify it with `dry_run`.

    The change is verified first, with files in a folder that is removed again. The
    draft is saved only if it would be accepted, and taken back if it fails.

    Returns:
        What `switch` gave: of the trial, and of the change.

    Raises:
        PbonetError: The change is refused or failed; the files are as they were.
    """
    with tempfile.TemporaryDirectory(prefix="pbonet-") as folder:
        trial = _written(editor, Path(folder))
        replies = [_switch(editor, trial, place, dry_run=True)]
    if dry_run:
        return replies
    editor.save()
    try:
        replies.append(_switch(editor, editor.files.job_path, place, dry_run=False))
    except BaseException as error:
        copies = editor.files.draft.renamed
        editor.files.show(editor.files.first)
        editor.save()
        if isinstance(error, PbonetError):
            error.add_note("the job's files are as they were before")
            for note in _left(editor.files, copies, place):
                error.add_note(note)
        raise
    return replies


def _left(files: DraftFiles, copies: Mapping[str, str], place: Place) -> list[str]:
    """Return which copies a failed change has left, each with what to do.

    Args:
        files: The subsystem's files.
        copies: The copy of each task that was to move.
        place: Where the subsystem is.
    """
    try:
        data = oneshot.run(files.path, "status", {}, place).data
    except PbonetError as error:
        return [f"which tasks run is not known: {error}; 'pbonet status' shows it"]
    states = {one["task"]: one["fields"]["state"] for one in data["tasks"]}
    answered = {one["rtpu"] for one in data["rtpus"]}
    silent = [one.name for one in files.sbs.rtpus if one.name not in answered]
    absent = f"is not known: {' and '.join(silent)} gave no answer"
    notes: list[str] = []
    for task, copy in copies.items():
        former = states.get(task, "")
        begin = f"its copy {copy} is {states.get(copy)}, and {task}"
        if copy in states and (former or not silent):
            todo = _todo(files.path, task, copy, former, states[copy])
            notes.append(f"{begin} {todo}")
        elif copy in states:
            notes.append(f"{begin} {absent}")
        elif silent:
            notes.append(f"whether its copy {copy} was left {absent}")
        elif former != _ON:
            notes.append(f"no copy was left, and {task} is {former or 'not there'}")
    return notes or ["no copy was left: the tasks run as before"]


def _todo(path: Path, task: str, copy: str, former: str, state: str) -> str:
    """Return the state of a task whose copy remained, and what to do.

    Args:
        path: The subsystem's file.
        task: The task.
        copy: Its copy.
        former: The task's state; empty: it does not exist.
        state: The copy's state.
    """
    if former == _ON:
        return f"is ON as before: remove the copy with 'pbonet kill {path} {copy}'"
    if not former:
        return (
            f"does not exist: 'pbonet explain {path} {copy}' says why, or stop and "
            "start the job"
        )
    again = f"swap {path} {copy}" if state == _ON else f"on {path}"
    return (
        f"is {former}: 'pbonet {again} {task}' continues with it, then "
        f"'pbonet kill {path} {copy}' removes the copy"
    )


def _switch(editor: JobEditor, job: Path, place: Place, *, dry_run: bool) -> Reply:
    args = {"job": str(job.resolve()), "dry_run": dry_run}
    return oneshot.run(editor.files.path, "switch", args, place)


def _written(editor: JobEditor, folder: Path) -> Path:
    """Write a draft into a folder, with the RMODs beside the job; return the job."""
    files = editor.files
    for path in files.job_path.parent.glob("*.rmod"):
        shutil.copy(path, folder)
    for path, text in files.draft.texts.items():
        if path.suffix == ".rmod":
            (folder / path.name).write_text(text, encoding="utf-8")
    job = structs.replace(files.draft.job, sbs=str(files.path.resolve()))
    target = folder / files.job_path.name
    text = rewrite_job(files.draft.texts[files.job_path], job).text
    target.write_text(text, encoding="utf-8")
    return target


def changes_text(changes: Iterable[FileChange]) -> str:
    """Return the diffs of files with their notes."""
    lines: list[str] = []
    for one in changes:
        lines += [one.diff.rstrip(), *(f"note: {note}" for note in one.notes)]
    return "\n".join(lines)
