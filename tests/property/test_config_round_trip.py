"""A record written and read again means the same, whatever it says."""

import math

from hypothesis import given, settings, strategies as st
from msgspec import structs

from pbonet import config
from pbonet.config.model import (
    Condition,
    EndRepeat,
    ErrPrint,
    Finish,
    Goto,
    JobFile,
    JobTask,
    Limit,
    LocalLine,
    Order,
    Repeat,
    Rmod,
    RtpuEntry,
    SbsFile,
    Scheduler,
    SeqFile,
    SeqLine,
    Step,
    StepEnd,
    SvarFile,
    TaskType,
    Usage,
    Variable,
)
from pbonet.config.types import TYPES, element_type
from pbonet.config.write import meaning
from pbonet.pbo import TimingFailure

FAILURES = [one.value for one in TimingFailure]
LETTERS = "ABCXYZabcxyz_"
names = st.builds(
    str.__add__, st.sampled_from(LETTERS), st.text(LETTERS + "019^'.", max_size=14)
).filter(lambda name: name.lower() != "none")
labels = st.builds(
    str.__add__, st.sampled_from(LETTERS), st.text(LETTERS + "019-", max_size=12)
)
text = st.text(st.characters(exclude_categories=("Cc", "Cs")), max_size=30).map(
    lambda words: words.strip(" \t")
)
words = st.text(
    st.characters(exclude_categories=("Cc", "Cs"), exclude_characters=" \t#"),
    min_size=1,
    max_size=8,
)
sentence = st.lists(words, min_size=1, max_size=4).map(" ".join)
questions = st.builds(
    "{} {} {}  {}  {}".format,
    st.sampled_from(["", "not", "-"]),
    names,
    st.sampled_from(["<", ">=", "+ 2.5 [rad/s] ==", "*"]),
    names,
    st.sampled_from(["", "and X > 0x1f", "or (A != 1 < B[0:2])"]),
).map(str.strip)
seconds = st.floats(1e-6, 1e6)
hertz = st.floats(1e-6, 1e6)


@st.composite
def variables(draw: st.DrawFn, name: str) -> Variable:
    size = draw(st.integers(1, 4096))
    kind = element_type(draw(st.sampled_from([*TYPES, f"struct[{size}]"])))
    assert kind is not None
    nelem = draw(st.integers(1, 6))
    finite = not kind.is_float or draw(st.booleans())
    values = st.integers(int(kind.low), int(kind.high))
    ranges = values
    if kind.is_float:
        width = 8 * kind.size
        ranges = st.floats(kind.low, kind.high, width=width)
        values = ranges if finite else st.floats(width=width)
    init = low = high = None
    if not kind.is_struct:
        init = draw(st.none() | st.lists(values, min_size=1, max_size=nelem))
    if not kind.is_struct and draw(st.booleans()):
        pairs = [sorted([draw(ranges), draw(ranges)]) for _ in range(nelem)]
        low, high = zip(*pairs, strict=True)
    limit = Limit.NONE
    started = [*(init or []), *[0] * (nelem - len(init or []))]
    if (
        low
        and high
        and not any(map(math.isnan, started))
        and all(
            least <= value <= most
            for least, value, most in zip(low, started, high, strict=True)
        )
    ):
        limit = draw(st.sampled_from(Limit))
    return Variable(
        name=name,
        type=kind.name,
        desc=draw(text),
        units=draw(sentence),
        nelem=nelem,
        init=tuple(init) if init else None,
        min=low,
        max=high,
        maxage=draw(st.none() | seconds),
        limit=limit,
        finite=finite,
    )


@st.composite
def svars(draw: st.DrawFn) -> SvarFile:
    chosen = draw(st.lists(names, min_size=1, max_size=4, unique=True))
    return SvarFile(
        file="a.svar",
        defines=draw(st.dictionaries(st.sampled_from(["A1", "B1"]), words)),
        variables=tuple(draw(variables(name)) for name in chosen),
    )


@st.composite
def rmods(draw: st.DrawFn) -> Rmod:
    ports = draw(st.lists(names, max_size=8, unique=True))
    spare = [f"V{number}" for number in range(8)]
    aliases = {
        port: spare[number]
        for number, port in enumerate(ports)
        if not set(spare) & set(ports) and draw(st.booleans())
    }
    cut = sorted(draw(st.tuples(*[st.integers(0, len(ports))] * 3)))
    tasktype = draw(st.sampled_from(TaskType))
    timed = tasktype in {TaskType.PERIODIC, TaskType.SYNCHRONOUS}
    server = tasktype in {TaskType.SPORADIC, TaskType.DEFERRABLE}
    freq = draw(hertz) if timed or server else None
    softness = None
    if tasktype is TaskType.PERIODIC:
        softness = draw(st.none() | st.floats(0, 1, exclude_max=True))
    times = sorted([draw(seconds), draw(seconds), draw(seconds)])
    keys = words.filter(lambda key: key not in {"EOF", "DEFINE"})
    local = draw(st.dictionaries(keys, st.lists(words, max_size=4).map(tuple)))
    return Rmod(
        name="a",
        file="folder/a.rmod",
        module=draw(names.map(lambda name: "m" + "".join(filter(str.isalnum, name)))),
        desc=draw(text),
        aliases=aliases,
        inconst=tuple(ports[: cut[0]]),
        outconst=tuple(ports[cut[0] : cut[1]]),
        invar=tuple(ports[cut[1] : cut[2]]),
        outvar=tuple(ports[cut[2] :]),
        tasktype=tasktype,
        freq=freq,
        critical=draw(st.booleans()),
        capacity=draw(st.floats(1e-9, 1 / (freq or 1))) if server else None,
        minc=draw(st.sampled_from([None, times[0]])),
        maxc=draw(st.sampled_from([None, times[2]])),
        effc=draw(st.sampled_from([None, times[1]])) if softness else None,
        softness=softness,
        crit=draw(st.none() | st.integers(1, 62)),
        handler=draw(st.none() | st.integers(1, 62)),
        safe_at=tuple(draw(st.lists(st.sampled_from(FAILURES), unique=True))),
        rtpu=draw(st.none() | labels),
        local={key: LocalLine(value) for key, value in local.items()},
    )


@st.composite
def sbss(draw: st.DrawFn) -> SbsFile:
    rtpus: list[RtpuEntry] = []
    for name in draw(st.lists(labels, min_size=1, max_size=4, unique=True)):
        low, high = sorted(draw(st.lists(hertz, min_size=2, max_size=2, unique=True)))
        entry = RtpuEntry(
            name=name,
            scheduler=draw(st.sampled_from(Scheduler)),
            usage=draw(st.sampled_from(Usage)),
            errprint=draw(st.sampled_from(ErrPrint)),
            minfreq=low,
            maxfreq=high,
            hangtime=draw(st.floats(1e-6, 3600.0)),
        )
        rtpus.append(entry)
    return SbsFile(
        file="a.sbs",
        subsystem=draw(labels),
        svarfile=draw(text.filter(bool)),
        master=draw(st.sampled_from([None, *(rtpu.name for rtpu in rtpus)])),
        strict=draw(st.booleans()),
        rtpus=tuple(rtpus),
    )


OPTIONS = {"FIXED", "FREQ", "FALLBACK", "RESTART"}


def _cost(mean: str) -> Condition:
    return Condition(f"{mean}(Q_REF - 2 [deg] * Q_MEZ[0:2])")


@st.composite
def jobs(draw: st.DrawFn) -> JobFile:
    chosen = draw(st.lists(labels, min_size=1, max_size=4, unique=True))
    off = draw(st.lists(st.sampled_from(chosen), unique=True))
    conditions = st.lists(questions.map(Condition), max_size=3).map(tuple)
    rtpu = st.none() | labels.filter(lambda name: name not in OPTIONS)
    return JobFile(
        file="a.job",
        name=draw(labels),
        desc=draw(text),
        sbs=draw(text.filter(bool)),
        pre=draw(conditions),
        post=draw(conditions),
        cost=draw(st.none() | st.sampled_from(["rms", "peak"]).map(_cost)),
        tasks=tuple(
            JobTask(
                rmod=rmod,
                rtpu=(home := draw(rtpu)),
                fixed=home is not None and draw(st.booleans()),
                freq=draw(st.none() | hertz),
                fallback=(safe := draw(st.none() | st.just(f"{rmod}_safe"))),
                takeover=draw(st.just(0.0) | st.floats(0.5, 30.0)) if safe else 0.0,
                restart=draw(st.sampled_from(["never", "off", "on"])),
            )
            for rmod in chosen
        ),
        off_order=tuple(off),
    )


@given(svars())
def test_svar(record: SvarFile) -> None:
    again = config.parse_svar(config.write_svar(record), record.file)
    assert meaning(again) == meaning(record)


@st.composite
def combinations(draw: st.DrawFn, inner: st.SearchStrategy[Rmod]) -> Rmod:
    """Two or three of `inner` as one task."""
    whole = draw(rmods())
    found = [draw(inner) for _ in range(draw(st.integers(2, 3)))]
    parts = tuple(_named(part, f"p{n}") for n, part in enumerate(found))
    module = "+".join(part.module for part in parts)
    return structs.replace(whole, parts=parts, module=module)


def _named(part: Rmod, name: str) -> Rmod:
    parts = tuple(_named(one, f"{name}{n}") for n, one in enumerate(part.parts))
    return structs.replace(part, name=name, parts=parts)


@given(rmods())
def test_rmod(record: Rmod) -> None:
    again = config.parse_rmod(config.write_rmod(record), record.file)
    assert meaning(again) == meaning(record)


@settings(max_examples=30)  # a record of up to nine
@given(combinations(rmods() | combinations(rmods())))
def test_combined_rmod(record: Rmod) -> None:
    again = config.parse_rmod(config.write_rmod(record), record.file)
    assert meaning(again) == meaning(record)


@given(sbss())
def test_sbs(record: SbsFile) -> None:
    again = config.parse_sbs(config.write_sbs(record), record.file)
    assert meaning(again) == meaning(record)


@given(jobs())
def test_job(record: JobFile) -> None:
    again = config.parse_job(config.write_job(record), record.file)
    assert meaning(again) == meaning(record)


def end_signals(condition: st.SearchStrategy[str]) -> st.SearchStrategy[StepEnd]:
    signals = st.builds(StepEnd, signal=labels, task=st.just("") | labels)
    return signals | st.builds(StepEnd, condition=condition)


@st.composite
def steps(draw: st.DrawFn, label: str, targets: list[str]) -> Step:
    until = tuple(draw(st.lists(end_signals(questions), max_size=3)))
    lasts = draw(st.none() | seconds)
    within = draw(st.none() | seconds) if until and lasts is None else None
    return Step(
        job=draw(labels),
        label=label,
        until=until,
        seconds=lasts,
        within=within,
        otherwise=draw(st.sampled_from(["", *targets])),
    )


@st.composite
def orders(draw: st.DrawFn) -> Order:
    command = draw(st.sampled_from(["spawn", "kill", "set", "write"]))
    floats = st.floats(-1e9, 1e9).map(repr)
    rest = {
        "spawn": st.lists(labels, max_size=1),
        "kill": st.lists(labels, max_size=3),
        "set": st.lists(words, min_size=2, max_size=4),
        "write": st.lists(floats, min_size=1, max_size=4),
    }
    given_words = (draw(labels), *draw(rest[command]))
    return Order(command=command, words=given_words)  # type: ignore[arg-type]


@st.composite
def gotos(draw: st.DrawFn, targets: list[str], above: Step) -> Goto:
    known = [one for one in above.until if one.signal]
    whens = st.none() | st.builds(StepEnd, condition=questions)
    return Goto(
        step=draw(st.sampled_from(targets)),
        when=draw(whens | st.sampled_from(known) if known else whens),
    )


@st.composite
def seqs(draw: st.DrawFn) -> SeqFile:
    """Steps, each with a label, lines after it, and maybe a loop around some."""
    targets = [f"L{number}" for number in range(draw(st.integers(1, 5)))]
    lines: list[SeqLine] = []
    for target in targets:
        step = draw(steps(target, targets))
        lines.append(step)
        for _ in range(draw(st.integers(0, 3))):
            ends = st.builds(Finish, failed=st.booleans(), text=text)
            lines.append(draw(orders() | gotos(targets, step) | ends))
    times = st.integers(0, 1000)
    if draw(st.booleans()):  # around the whole, so that no line leads into it
        lines = [Repeat(times=draw(times)), *lines, EndRepeat()]
    safe = draw(st.none() | steps("", [""]))
    return SeqFile(
        file="a.seq",
        name=draw(labels),
        desc=draw(text),
        sbs=draw(sentence),
        safe=safe,
        wait=draw(st.just(0.0) | seconds),
        within=draw(st.none() | seconds),
        lines=tuple(lines),
    )


@given(seqs())
def test_seq(record: SeqFile) -> None:
    written = config.write_seq(record)
    again = config.parse_seq(written, record.file)
    assert meaning(again) == meaning(record)
    assert config.write_seq(again) == written
