"""What `pbonet run` says of tasks that died, were stopped, or stand by."""

from rich.console import Console

from pbonet.errors import NoAnswerError
from pbonet.master.console import (
    Call,
    find,
    live_screen,
    live_status,
    summary,
    watch_status,
    watch_values,
)
from pbonet.xm.net import messages as m

COUNTS = ("crit", "cycle", "miss", "warn")
FIGURES = ("ref_f", "mez_f", "mez_t", "ptime", "tot_c", "tick", "min_c", "max_c")
LOOKED = dict.fromkeys(COUNTS, 0) | dict.fromkeys([*FIGURES, "last_c"], 0.0)
DIED = "the task ended by itself: signal SIGKILL (killed)"


def task(name, state, cycle, error="", on="c0"):
    more = {"cycle": cycle, "ref_f": 250.0, "error": error, "state": state}
    told = LOOKED | more
    return m.TaskStatus(rmod=name, task=name, rtpu=on, tid=1, S="P", **told)


def rtpu(*tasks, name="c0"):
    return m.RtpuStatus(rtpu=name, backend="fifo", scheduler="MUF", tasks=list(tasks))


def test_each_task_is_in_the_summary_though_it_was_gone_before_the_others():
    seen = summary.Seen()
    seen.update([rtpu(task("cart", "ON", 10), task("lqr", "ON", 5))])
    seen.update([rtpu(task("lqr", "ON", 6))])  # it sleeps in its cycle
    seen.update([rtpu()])
    found = summary.summarize(seen.last())
    assert [(one.task, one.state, one.cycles) for one in found] == [
        ("cart", "ON", 10),
        ("lqr", "ON", 6),
    ]
    since, head = summary.text(found).splitlines()[:2]
    assert since == "since each task was turned on last:"
    assert head.startswith("task  rtpu  last state  cycles")


def failures(seen, killed=()):
    found = summary.summarize(seen.last(killed))
    return {(one.task, one.rtpu, one.state): one.error for one in found}


def test_a_task_that_failed_and_was_spawned_elsewhere_has_not_failed():
    seen = summary.Seen()
    seen.update([rtpu(task("lqr", "ERROR", 5, "gain")), rtpu(name="c1")])
    assert failures(seen) == {("lqr", "c0", "ERROR"): "gain"}
    seen.update([rtpu(), rtpu(task("lqr", "ON", 9, on="c1"), name="c1")])
    assert failures(seen) == {("lqr", "c1", "ON"): ""}
    died = rtpu(task("lqr", "NOT-CREATED", 5, DIED))  # and is still shown there
    seen.update([rtpu(task("lqr", "ON", 10, on="c1"), name="c1"), died])
    assert failures(seen) == {("lqr", "c1", "ON"): ""}


def test_a_failed_task_that_an_operator_killed_has_not_failed_one_that_vanished_has():
    seen = summary.Seen()
    seen.update([rtpu(task("lqr", "ERROR", 5, "gain"), task("cart", "ERROR", 7, "x"))])
    seen.update([rtpu()])  # cart went with a stop
    assert failures(seen, {"lqr"}) == {
        ("lqr", "c0", "NOT-CREATED"): "",
        ("cart", "c0", "ERROR"): "x",
    }


def test_a_task_that_died_has_no_rate_and_a_reason(capsys):
    live_status.Plain().show(5.1, [rtpu(task("lqr", "NOT-CREATED", 521, DIED))], [])
    shown = capsys.readouterr().out.strip()
    assert shown == f"5.1 s  lqr             NOT-CREATED after 521 cycles: {DIED}"
    found = summary.summarize([rtpu(task("lqr", "NOT-CREATED", 521, DIED))])
    assert summary.text(found).endswith(f"ERROR> lqr: {DIED}")


def test_a_task_that_is_being_created_has_no_reason_yet(capsys):
    live_status.Plain().show(5.1, [rtpu(task("soft", "NOT-CREATED", 0, ""))], [])
    shown = capsys.readouterr().out.strip()
    assert shown == "5.1 s  soft            NOT-CREATED after 0 cycles"


def test_the_screen_shows_why_a_task_died():
    console = Console(width=160, record=True, force_terminal=True)
    with live_screen.Screen(console) as screen:
        screen.show(5.1, [rtpu(task("lqr", "NOT-CREATED", 521, DIED))], [])
    shown = console.export_text()
    assert f"lqr: {DIED}" in shown
    rows = [one for one in shown.splitlines() if one.startswith("lqr ")]
    assert rows
    assert not any("250" in row for row in rows), "it has no rate any more"


class Away:
    """A subsystem whose RTPU answers as the test says."""

    def __init__(self, warnings):
        self.warnings = warnings
        self.silent = False

    def rtpu_status(self):
        if self.silent:
            raise NoAnswerError("c0 does not answer")
        return [rtpu(task("lqr", "ON", 5), task("cart", "ON", 5))]


def test_watched_status_says_once_that_nobody_answers(capsys, monkeypatch):
    monkeypatch.setattr(watch_values.Listener, "open", lambda _: None)
    warnings = watch_status._Warnings()
    away = Away(warnings)
    table = watch_status._Table(away, Call(find("status"), {}), warnings)
    with table:
        for passed, silent in enumerate([False, True, True, False, True]):
            away.silent = silent
            table.show(float(passed))
    lines = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert lines == ["0.0", "0.0", "WARNING>", "3.0", "3.0", "WARNING>"]
    assert table.pause == 5.0, "no terminal"


def test_columns_of_the_screen_may_be_chosen():
    console = Console(width=160, record=True, force_terminal=True)
    with live_screen.Screen(console, fields=["state", "refF"], end="so") as screen:
        screen.show(5.1, [rtpu(task("lqr", "ON", 521))], [])
    lines = [line.split() for line in console.export_text().splitlines()]
    assert ["task", "state", "refF"] in lines
    assert ["lqr", "ON", "250"] in lines
    assert ["5", "s;", "so"] in lines
