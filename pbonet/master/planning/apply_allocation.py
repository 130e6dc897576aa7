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
    from pbonet.master.editing import FileChange

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
        editor.files.show(editor.files.first)
        editor.save()
        if isinstance(error, PbonetError):
            error.add_note(
                "the job's files are as they were before; 'pbonet status' shows which "
                "tasks run"
            )
        raise
    return replies


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
