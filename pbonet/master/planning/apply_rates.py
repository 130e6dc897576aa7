"""Writes rates into a job, and sets them in the running subsystem."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import structs

from pbonet.config import rewrite_job
from pbonet.errors import PbonetError
from pbonet.master.console import oneshot
from pbonet.master.editing import JobEditor, SavedFiles

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from pbonet.master.configuration import Place

    from .tune_job import Tuning


def draft(
    job: str | Path, rates: Mapping[str, float], libraries: Iterable[str | Path] = ()
) -> JobEditor:
    """Return an editor of a job with other rates of tasks; nothing is saved."""
    editor = JobEditor(job, libraries)
    for task, hz in rates.items():
        editor.set_field(task, "freq", hz)
    return editor


def save_copy(editor: JobEditor) -> list[Path]:
    """Write a draft into a copy of its job beside it, such as ``arm_tuned.job``.

    Its name is the job's with ``_tuned``, and a number if there is one of that name.

    Raises:
        ConfigFileError: The copy cannot be written.
    """
    files = editor.files
    stem, number = f"{files.job_path.stem}_tuned", 1
    path = files.job_path.with_name(f"{stem}.job")
    while path.exists():
        number += 1
        path = files.job_path.with_name(f"{stem}_{number}.job")
    job = structs.replace(files.draft.job, name=path.stem, file=str(path))
    text = rewrite_job(files.draft.texts[files.job_path], job).text
    return SavedFiles().save({path: text}, path)


def set_rates(
    job: str | Path, found: Tuning, place: Place, save: Callable[[], list[Path]]
) -> tuple[list[tuple[str, float]], list[Path]]:
    """Set the rates of running tasks, and save them; return those, and the files.

    Tasks that become slower go first, so that no RTPU has too much in between. If one
    is refused, or the files cannot be saved, those that were set get their former rate
    again.

    Raises:
        PbonetError: One is refused, or the files cannot be saved.
    """
    before, lost = found.present.rates, list[str]()
    order = sorted(found.rates.items(), key=lambda pair: pair[1] / before[pair[0]])
    done: list[tuple[str, float]] = []
    try:
        for task, hz in order:
            done.append((
                task,
                hz,
            ))  # it may be set though Ctrl-C comes before the reply
            try:
                oneshot.run(job, "freq", {"task": task, "hz": hz}, place)
            except PbonetError:
                done.pop()
                raise
        return done, save()
    except BaseException as error:
        for task, _ in reversed(done):
            try:
                oneshot.run(job, "freq", {"task": task, "hz": before[task]}, place)
            except PbonetError:
                lost.append(task)
        if isinstance(error, PbonetError) and done:
            error.add_note(_note(lost))
        raise


def _note(lost: Sequence[str]) -> str:
    if not lost:
        return "the tasks have their former rates again"
    return f"{' and '.join(lost)} could not be set back: 'pbonet freq' shows the rates"
