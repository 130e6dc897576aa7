"""Changes of connections and variables: SVARALIAS lines, entries of the table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import structs

from pbonet.analysis.legality import intermediate
from pbonet.config import Variable, element_type
from pbonet.errors import ConfigError, UnknownVariableError, did_you_mean
from pbonet.xm.net import convert

from .draft_files import DraftFiles
from .task_edits import change_rmod, record_of, task_names

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.config import Rmod

_INPUTS, _OUTPUTS = ("inconst", "invar"), ("outconst", "outvar")


def connect(files: DraftFiles, *, task: str, port: str, variable: str) -> None:
    """Connect a port to a variable: SVARALIAS, or none where the names are equal."""
    record = record_of(files, task)
    _must_have_port(record, port)
    aliases = {key: name for key, name in record.aliases.items() if key != port}
    if variable != port:
        aliases[port] = variable
    change_rmod(files, structs.replace(record, aliases=aliases))


def connect_ports(
    files: DraftFiles, *, task: str, port: str, other: str, other_port: str
) -> None:
    """Connect an output and an input: the input gets the variable of the output."""
    one, two = record_of(files, task), record_of(files, other)
    for record, name in ((one, port), (two, other_port)):
        _must_have_port(record, name)
    writes = [port in ports_of(one, _OUTPUTS), other_port in ports_of(two, _OUTPUTS)]
    if all(writes):
        raise ConfigError(
            f"{port} of {task} and {other_port} of {other} are both outputs",
            where=files.draft.job.file,
            expected="an output and an input, or two inputs",
            remedy="join the two with a join connector",
        )
    if writes[0]:
        connect(files, task=other, port=other_port, variable=one.svar_name(port))
    else:
        connect(files, task=task, port=port, variable=two.svar_name(other_port))


def disconnect(files: DraftFiles, *, task: str, port: str) -> None:
    """Connect a port to a variable that no other task has: its own, or a new one.

    The table gets an entry for it like that of the variable which the port had.
    """
    record = record_of(files, task)
    _must_have_port(record, port)
    before = record.svar_name(port)
    taken = {
        other.svar_name(name)
        for other in (record_of(files, name) for name in task_names(files))
        for name in ports_of(other, (*_INPUTS, *_OUTPUTS))
        if (other.name, name) != (task, port)
    }
    if before not in taken:
        return
    new = port if port not in taken else free_names(files, port, 1, taken)[0]
    if new != port or port not in _names(files):
        copy_variable(files, of=before, name=new)
    connect(files, task=task, port=port, variable=new)


def add_variable(
    files: DraftFiles,
    *,
    name: str,
    type: str = "double",  # noqa: A002 - as the file's keyword
    nelem: int = 1,
    units: str = "none",
    desc: str = "",
    init: list[float] | None = None,
) -> None:
    """Add an entry to the table."""
    if name in _names(files):
        raise ConfigError(
            f"the table has a variable {name} already",
            where=files.draft.table.file,
            remedy="change that one, or choose another name",
        )
    new = Variable(
        name=name,
        type=type,
        nelem=nelem,
        units=units,
        desc=desc,
        init=_values(type, init),
    )
    files.set_variables((*files.draft.table.variables, new))


def copy_variable(files: DraftFiles, *, of: str, name: str) -> None:
    """Add an entry like another one; none if that is missing, or it is there."""
    variables = {one.name: one for one in files.draft.table.variables}
    like = variables.get(of)
    if like is not None and name not in variables:
        new = structs.replace(like, name=name)
        files.set_variables((*variables.values(), new))


def set_variable(files: DraftFiles, *, name: str, field: str, value: Any) -> None:  # noqa: ANN401 - as the field's type
    """Change an entry of the table.

    Args:
        files: The files.
        name: The variable.
        field: ``type desc units nelem init min max maxage rate limit`` or ``finite``.
        value: A number, text, truth value or list; None: what is the default.
    """
    _must_be_there(files, name)
    fields = {one.name: one for one in structs.fields(Variable)}
    known = [*fields.keys() - {"name", "place"}]
    if field not in known:
        raise ConfigError(
            f"a variable has no setting {field}",
            where=name,
            expected=" or ".join(sorted(known)),
            got=field,
            remedy=did_you_mean(field, known) or "name one of these",
        )
    changed: list[Variable] = []
    for one in files.draft.table.variables:
        if one.name == name:
            wanted = _field(fields[field], value, one)
            changed.append(structs.replace(one, **{field: wanted}))
        else:
            changed.append(one)
    files.set_variables(changed)


def remove_variable(files: DraftFiles, *, name: str) -> None:
    """Remove an entry of the table that no task of this job uses."""
    _must_be_there(files, name)
    users = [
        task
        for task in task_names(files)
        if name in map(record_of(files, task).svar_name, _all(record_of(files, task)))
    ]
    if users:
        raise ConfigError(
            f"the variable {name} is in use",
            where=files.draft.table.file,
            expected="a variable that no task uses",
            got=f"used by {', '.join(users)}",
            remedy="connect these to others first",
        )
    variables = files.draft.table.variables
    files.set_variables(one for one in variables if one.name != name)


# -- parts of them --------------------------------------------------------------------


def ports_of(record: Rmod, lists: Sequence[str]) -> list[str]:
    """Return the ports in some lists of an RMOD."""
    return [port for name in lists for port in getattr(record, name)]


def free_names(
    files: DraftFiles, variable: str, count: int, taken: set[str]
) -> list[str]:
    """Return names like that of a variable that neither the table nor a task has."""
    used = taken | _names(files)
    for more in range(count, count + len(used) + 1):
        found = [n for n in intermediate(variable, more) if n not in used]
        if len(found) >= count:
            return found[:count]
    return []  # pragma: no cover - one of so many is free


def _all(record: Rmod) -> list[str]:
    return ports_of(record, (*_INPUTS, *_OUTPUTS))


def _names(files: DraftFiles) -> set[str]:
    return {one.name for one in files.draft.table.variables}


def _must_have_port(record: Rmod, port: str) -> None:
    """Refuse a port that an RMOD does not list.

    Raises:
        ConfigError: It is none.
    """
    known = _all(record)
    if port not in known:
        raise ConfigError(
            f"{record.name} has no port {port}",
            where=record.file,
            expected=" or ".join(known) or "a task with ports",
            got=port,
            remedy=did_you_mean(port, known) or "name one of these",
        )


def _must_be_there(files: DraftFiles, name: str) -> None:
    """Refuse a variable that the table does not have.

    Raises:
        UnknownVariableError: It is none.
    """
    known = _names(files)
    if name not in known:
        raise UnknownVariableError(
            f"the table has no variable {name}",
            where=files.draft.table.file,
            remedy=did_you_mean(name, known) or "add it first",
        )


def _field(about: structs.FieldInfo, value: Any, variable: Variable) -> Any:  # noqa: ANN401 - as above
    """Return a value of the type that a field has.

    Raises:
        ConfigError: It has none.
    """
    if value is None:
        return about.default
    try:
        wanted = convert(value, about.type, strict=False)
    except msgspec.ValidationError as error:
        raise ConfigError(
            f"{about.name.upper()} cannot be {value!r}",
            where=variable.name,
            got=str(error),
            remedy="correct the value",
        ) from None
    if about.name in {"init", "min", "max"}:
        return _values(variable.type, wanted)
    return wanted


def _values(
    kind: str, values: Sequence[float] | None
) -> tuple[float | int, ...] | None:
    """Return values as the type of a variable has them: whole numbers without point."""
    about = element_type(kind)
    if values is None or about is None or about.is_float:
        return None if values is None else tuple(map(float, values))
    return tuple(int(one) if float(one).is_integer() else float(one) for one in values)
