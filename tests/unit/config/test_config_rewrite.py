"""A file that is changed keeps its comments and the lines that stay the same."""

import pytest
from msgspec import structs

from pbonet.config import (
    JobTask,
    LocalLine,
    parse_job,
    parse_rmod,
    parse_svar,
    rewrite_job,
    rewrite_rmod,
    rewrite_svar,
)
from pbonet.errors import ConfigError

JOB = """\
# the arm
JOB   arm
DESC  moves # this belongs to the text

SBS   arm.sbs
# both are needed
TASK  pid   arm0 FREQ 200   # the servo loop
TASK  sine  arm1
RECORD all pid
OFF   sine pid
EOF
"""
SVAR = """\
DEFINE N 3
NAME  Q     # joint position
TYPE  double
DESC  where it is
UNITS rad
NELEM N
MAXAGE 0.5

# a size
NAME  SIZE
TYPE  int
DESC  how many
UNITS none
NELEM 1
INIT  N
EOF
"""
RMOD = """\
# tuned on Monday
MODULE pid
DESC   a controller
SVARALIAS Z = Q
INCONST none
OUTCONST none
INVAR  Z
OUTVAR T
TASKTYPE periodic
PERIOD 0.005
LOCAL
KP     3    # stiff
KD     0.1
EOF
"""


def test_a_record_that_means_the_same_changes_nothing():
    assert rewrite_job(JOB, parse_job(JOB, "arm.job")).text == JOB
    assert rewrite_svar(SVAR, parse_svar(SVAR, "arm.svar")).text == SVAR
    assert rewrite_rmod(RMOD, parse_rmod(RMOD, "pid.rmod")).text == RMOD


def test_a_line_of_a_job_changes_and_its_comment_stays():
    job = parse_job(JOB, "arm.job")
    pid, sine = job.tasks
    wanted = structs.replace(
        job, tasks=(structs.replace(pid, freq=100.0), sine, JobTask(rmod="log"))
    )
    text, comments = rewrite_job(JOB, wanted)
    assert comments
    assert text == JOB.replace(
        "TASK  pid   arm0 FREQ 200   # the servo loop\n",
        "TASK  pid arm0 FREQ 100.0   # the servo loop\n",
    ).replace("TASK  sine  arm1\n", "TASK  sine  arm1\nTASK      log\n")


def test_a_line_that_goes_leaves_the_comment_above_it():
    job = parse_job(JOB, "arm.job")
    wanted = structs.replace(job, tasks=job.tasks[1:], off_order=(), record=())
    text, _ = rewrite_job(JOB, wanted)
    assert text == (
        "# the arm\nJOB   arm\nDESC  moves # this belongs to the text\n\n"
        "SBS   arm.sbs\n# both are needed\nTASK  sine  arm1\nEOF\n"
    )


def test_variables_come_go_and_change_and_constants_stay():
    table = parse_svar(SVAR, "arm.svar")
    q, size = table.variables
    new = structs.replace(q, name="Q_REF", maxage=None, desc="where it is to be")
    wanted = structs.replace(
        table, variables=(structs.replace(q, maxage=0.2), size, new)
    )
    text, _ = rewrite_svar(SVAR, wanted)
    assert text.startswith(SVAR.replace("MAXAGE 0.5", "MAXAGE 0.2")[: -len("EOF\n")])
    assert "\n\nNAME      Q_REF\n" in text
    fewer = structs.replace(table, variables=(size,))
    text, _ = rewrite_svar(SVAR, fewer)
    assert "# a size\nNAME  SIZE" in text
    assert "joint position" not in text
    assert parse_svar(text).variables[0].init == (3,)


def test_parameters_and_aliases_change_where_they_stand():
    rmod = parse_rmod(RMOD, "pid.rmod")
    wanted = structs.replace(
        rmod,
        aliases={"Z": "Q_MEZ", "T": "TAU"},
        freq=100.0,
        local={"KP": LocalLine(("5",)), "KI": LocalLine(("1", "2"))},
    )
    assert rewrite_rmod(RMOD, wanted).text == RMOD.replace(
        "SVARALIAS Z = Q\n", "SVARALIAS Z=Q_MEZ\nSVARALIAS T=TAU\n"
    ).replace("PERIOD 0.005\n", "FREQ      100.0\n").replace(
        "KP     3    # stiff\nKD     0.1\n", "KP     5    # stiff\nKI        1 2\n"
    )


def test_a_first_parameter_brings_the_line_local():
    plain = RMOD[: RMOD.index("LOCAL")] + "EOF\n"
    rmod = parse_rmod(plain, "pid.rmod")
    wanted = structs.replace(rmod, local={"KP": LocalLine(("5",))})
    text = rewrite_rmod(plain, wanted).text
    assert text == plain[: -len("EOF\n")] + "\nLOCAL\nKP        5\nEOF\n"
    assert rewrite_rmod(text, rmod).text.replace("\n\n", "\n") == plain


def test_ends_of_lines_stay_as_they_are():
    crlf = JOB.replace("\n", "\r\n")
    job = parse_job(crlf, "arm.job")
    text, _ = rewrite_job(crlf, structs.replace(job, desc="stands"))
    assert text == crlf.replace(
        "DESC  moves # this belongs to the text", "DESC  stands"
    )


def test_a_combination_keeps_its_own_lines_only():
    whole = RMOD.replace("MODULE pid", "COMBINE one two").replace(
        "SVARALIAS Z = Q\n", ""
    )
    part = RMOD.replace("PERIOD 0.005", "FREQ 1")
    text = f"{whole}PART one one.rmod\n{part}PART two two.rmod\n{part}"
    rmod = parse_rmod(text, "both.rmod")
    wanted = structs.replace(rmod, desc="two of them")
    now = rewrite_rmod(whole, wanted).text
    assert now == whole.replace("DESC   a controller", "DESC   two of them")


@pytest.mark.parametrize("desc", ["two\nTASK other", "ends in a blank ", "a\rb"])
def test_a_text_that_would_mean_something_else_is_refused(desc):
    job = parse_job(JOB, "arm.job")
    with pytest.raises(ConfigError):
        rewrite_job(JOB, structs.replace(job, desc=desc))


def test_a_value_that_no_file_can_have_is_refused_in_the_readers_words():
    rmod = parse_rmod(RMOD, "pid.rmod")
    with pytest.raises(ConfigError, match=r"CRIT cannot be '-5'"):
        rewrite_rmod(RMOD, structs.replace(rmod, crit=-5))


def test_comments_that_cannot_stay_are_reported():
    table = parse_svar(SVAR, "arm.svar")
    now, comments = rewrite_svar(SVAR, structs.replace(table, defines={}))
    assert not comments
    assert "#" not in now
    assert parse_svar(now).variables[1].init == (3,)
