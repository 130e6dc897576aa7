"""Changes of the tasks of a job: which run, where, how often, with what parameters."""

from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import structs

from pbonet.config import (
    MAX_LABEL,
    Condition,
    JobTask,
    LocalLine,
    Rmod,
    meaning,
    own_rmod,
    parse_rmod,
)
from pbonet.errors import ConfigError, UnknownTaskError, did_you_mean
from pbonet.xm.net import check_name, convert

from .draft_files import DraftFiles

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

JOB_FIELDS = ("rtpu", "freq", "takeover", "restart")
"""Settings of a task that the job says; RTPU and FREQ of a standby are its RMOD's."""
RMOD_FIELDS = (
    "desc",
    "tasktype",
    "critical",
    "crit",
    "handler",
    "capacity",
    "minc",
    "maxc",
    "effc",
    "softness",
    "stale",
    "settle",
    "safe_at",
    "needs",
)
"""Settings of a task that its RMOD says."""
_OF_STANDBYS = ("rtpu", "freq")


def add_task(
    files: DraftFiles,
    *,
    module: str,
    name: str = "",
    rtpu: str | None = None,
    freq: float | None = None,
    params: dict[str, str] | None = None,
    aliases: dict[str, str] | None = None,
) -> None:
    """Add a task at the end of the job.

    Its ports are connected by their names; `legality` reports those that are not. The
    RMOD is copied beside the job if something of it differs, or if the job has a task
    of that name already.

    Args:
        files: The files.
        module: An RMOD, or a module without one.
        name: The task's name; by default that of the RMOD, with a number if taken.
        rtpu: The RTPU; by default that of the RMOD, else the first.
        freq: Hz; by default that of the RMOD.
        params: Parameters that differ, as LOCAL lines have them.
        aliases: Variables of ports, by the port's name in the module.
    """
    record = _record(files, module, freq, params or {})
    local = _with_params(record, params or {})
    made = structs.replace(
        record, local=local, aliases={**record.aliases, **(aliases or {})}
    )
    if made != record and not name and files.is_shared(record):
        name = own_name(files, record.name)
    new = _free_name(files, record.name, name)
    if new != record.name or made != record:
        files.set_rmod(made, "" if new == record.name else new)
    else:
        files.keep(new)
    task = JobTask(rmod=new, rtpu=rtpu or None, freq=freq)
    files.set_job(tasks=(*files.draft.job.tasks, task))


def remove_task(files: DraftFiles, *, task: str) -> None:
    """Remove a task with its fallback; or, of a standby, the fallback alone."""
    line, standby = find_line(files, task)
    job = files.draft.job
    if standby:
        _replace_line(files, line, fallback=None, takeover=0.0)
        return
    gone = {task, line.fallback}
    record = [
        structs.replace(one, names=tuple(n for n in one.names if n not in gone))
        for one in job.record
    ]
    files.set_job(
        tasks=tuple(one for one in job.tasks if one.rmod != task),
        off_order=tuple(name for name in job.off_order if name != task),
        record=tuple(
            now
            for now, before in zip(record, job.record, strict=True)
            if now.names or not before.names
        ),
    )


def rename_task(files: DraftFiles, *, task: str, name: str) -> None:
    """Give a task another name: its RMOD is copied under that name."""
    record = record_of(files, task)
    if check_name("a task", name) != task:
        _rename(files, record, _free_name(files, "", name))


def set_field(files: DraftFiles, *, task: str, field: str, value: Any) -> None:  # noqa: ANN401 - as the field's type
    """Change a setting of a task.

    Args:
        files: The files.
        task: The task.
        field: One of `JOB_FIELDS` or `RMOD_FIELDS`.
        value: A number, text or truth value; None or empty text: what is the default.
    """
    line, standby = find_line(files, task)
    if field not in {*JOB_FIELDS, *RMOD_FIELDS}:
        known = (*JOB_FIELDS, *RMOD_FIELDS)
        raise ConfigError(
            f"a task has no setting {field}",
            where=task,
            expected=" or ".join(known),
            got=field,
            remedy=did_you_mean(field, known) or "name one of these",
        )
    in_rmod = field in RMOD_FIELDS or (standby and field in _OF_STANDBYS)
    wanted = _converted(Rmod if in_rmod else JobTask, field, value, task)
    if in_rmod:
        change_rmod(files, structs.replace(record_of(files, task), **{field: wanted}))
    else:
        free = {"fixed": False} if field == "rtpu" and wanted is None else {}
        _replace_line(files, line, **{field: wanted}, **free)


def set_parameter(
    files: DraftFiles, *, task: str, name: str, value: str | None
) -> None:
    """Change a parameter of a task; None: it gets its default."""
    record = record_of(files, task)
    local = _with_params(record, {name: value})
    change_rmod(files, structs.replace(record, local=local))


def set_fallback(
    files: DraftFiles,
    *,
    task: str,
    fallback: str | None,
    takeover: float = 0.0,
) -> None:
    """Have an RMOD stand by for a task; None: nothing does."""
    line, standby = find_line(files, task)
    if standby:
        raise ConfigError(
            f"{task} stands by itself, for {line.rmod}",
            where=files.draft.job.file,
            expected="a task that is ON",
            remedy=f"give {line.rmod} another fallback",
        )
    if fallback:
        files.rmod(fallback)  # refused if there is none
        files.keep(fallback)
    _replace_line(
        files, line, fallback=fallback or None, takeover=takeover if fallback else 0.0
    )


def set_off_order(files: DraftFiles, *, tasks: list[str]) -> None:
    """Say in which order tasks are turned off; empty: the reverse of turning on."""
    files.set_job(off_order=tuple(tasks))


def set_job(
    files: DraftFiles,
    *,
    name: str | None = None,
    desc: str | None = None,
    pre: list[str] | None = None,
    post: list[str] | None = None,
) -> None:
    """Change the job's name, description or conditions; None: as it is."""
    changes: dict[str, object] = {"name": name, "desc": desc}
    for key, texts in (("pre", pre), ("post", post)):
        if texts is not None:
            changes[key] = tuple(Condition(text) for text in texts)
    files.set_job(**{k: v for k, v in changes.items() if v is not None})


# -- parts of them --------------------------------------------------------------------


def find_line(files: DraftFiles, task: str) -> tuple[JobTask, bool]:
    """Return the TASK line of a task, and whether it stands by in it.

    Raises:
        UnknownTaskError: There is none of that name.
    """
    for line in files.draft.job.tasks:
        if task in {line.rmod, line.fallback}:
            return line, task == line.fallback
    names = task_names(files)
    raise UnknownTaskError(
        f"the job has no task {task}",
        where=files.draft.job.file,
        expected=" or ".join(names) or "a task that was added",
        got=task,
        remedy=did_you_mean(task, names) or "add it first",
    )


def task_names(files: DraftFiles) -> list[str]:
    """Return the names of all tasks, standbys too."""
    lines = files.draft.job.tasks
    return [name for line in lines for name in (line.rmod, line.fallback) if name]


def record_of(files: DraftFiles, task: str) -> Rmod:
    """Return the RMOD of a task.

    Raises:
        UnknownTaskError: There is none of that name.
        ConfigError: Its file is wrong.
    """
    line, standby = find_line(files, task)
    return files.rmod(task, None if standby else line.freq).record


def change_rmod(files: DraftFiles, record: Rmod) -> None:
    """Change the RMOD of a task.

    One of a library is copied beside the job; under a name of its own if other jobs use
    it, because they would find the copy, too. Then the task has that name.
    """
    if meaning(record) == meaning(record_of(files, record.name)):
        return
    if files.is_shared(record):
        _rename(files, record, own_name(files, record.name))
    else:
        files.set_rmod(record)


def own_name(files: DraftFiles, rmod: str) -> str:
    """Return a name for a copy of an RMOD that this job alone uses."""
    return next(
        name
        for number in count(2)
        if (name := numbered(rmod, number)) not in task_names(files)
        and files.is_free(name)
    )


def _rename(files: DraftFiles, record: Rmod, new: str) -> None:
    """Copy the RMOD of a task under another name, which the task has from then on."""
    task = record.name
    line, standby = find_line(files, task)
    files.set_rmod(record, new)
    job = files.draft.job

    def renamed(names: Iterable[str]) -> tuple[str, ...]:
        return tuple(new if one == task else one for one in names)

    if not standby:
        files.note_new_name(task, new)
    changed = structs.replace(line, **{"fallback" if standby else "rmod": new})
    files.set_job(
        tasks=tuple(changed if one is line else one for one in job.tasks),
        off_order=renamed(job.off_order),
        record=tuple(
            structs.replace(one, names=renamed(one.names)) for one in job.record
        ),
    )


def _replace_line(files: DraftFiles, line: JobTask, **changes: Any) -> None:  # noqa: ANN401 - fields of a line
    changed = structs.replace(line, **changes)
    tasks = files.draft.job.tasks
    files.set_job(tasks=tuple(changed if one is line else one for one in tasks))


def _record(
    files: DraftFiles, module: str, freq: float | None, params: Mapping[str, str]
) -> Rmod:
    """Return the RMOD to begin with.

    A module without one gets that of its class, where `params` have the values that
    its class does not.
    """
    known = files.library.files()
    if module not in known or not params or files.has_rmod(module):
        return files.rmod(module, freq).record
    info = files.library.load(module).info
    given = {name.lower() for name in params}
    told = tuple(
        structs.replace(one, required=one.required and one.name.lower() not in given)
        for one in info.params
    )
    text = own_rmod(structs.replace(info, params=told), freq)
    return parse_rmod(text, info.file)


def _with_params(
    record: Rmod, values: Mapping[str, str] | Mapping[str, str | None]
) -> dict[str, LocalLine]:
    """Return the LOCAL lines of an RMOD with other values; None takes a line out."""
    local = dict(record.local)
    for name, value in values.items():
        key = next((key for key in local if key.lower() == name.lower()), name)
        if value is None:
            local.pop(key, None)
        else:
            local[key] = LocalLine(tuple(value.split()))
    return local


def _free_name(files: DraftFiles, base: str, wanted: str) -> str:
    """Return the name of a new task.

    Raises:
        NodeError: No task can have the one that is wanted.
        ConfigError: It is taken.
    """
    taken = task_names(files)
    if wanted and wanted != base:
        check_name("a task", wanted)
        if wanted in taken or not files.is_free(wanted):
            raise ConfigError(
                f"the name {wanted} is taken",
                where=files.draft.job.file,
                expected="a name that no task, RMOD or module has",
                got=wanted,
                remedy="choose another name",
            )
        return wanted
    return own_name(files, base) if base in taken else base


def numbered(base: str, number: int) -> str:
    """Return a name with a number, short enough for a task."""
    ending = f"_{number}"
    return base[: MAX_LABEL - len(ending)] + ending


def _converted(kind: type[msgspec.Struct], field: str, value: Any, task: str) -> Any:  # noqa: ANN401 - as above
    """Return a value of the type that a field has.

    Raises:
        ConfigError: It has none.
    """
    about = next(one for one in structs.fields(kind) if one.name == field)
    if value is None or (value == "" and field != "desc"):
        return about.default
    if about.type == tuple[str, ...] and isinstance(value, str):
        value = value.split()
    try:
        return convert(value, about.type, strict=False)
    except msgspec.ValidationError as error:
        raise ConfigError(
            f"{field.upper()} cannot be {value!r}",
            where=task,
            got=str(error),
            remedy="correct the value",
        ) from None
