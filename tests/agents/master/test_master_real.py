"""A master over real agents, RTPU processes and tasks: what fakes cannot show."""

from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
from watching import states, wait_for

from pbonet.errors import (
    ClaimError,
    MethodError,
    ModuleLoadError,
    PbonetError,
    SeveralError,
    StateError,
    UnreachableError,
    VerificationError,
)
from pbonet.master.subsystem.status_fields import profile
from pbonet.master.subsystem.subsystem import Subsystem

ROOT = Path(__file__).parents[3]
FOUR = {"puma_pidg", "grav_comp", "qrdiff", "jttrace"}


def kernel_cpu(pid):
    """Return the CPU seconds that the kernel charged to a process's main thread."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0]) * 1e-9


def cycles(arm, task, more):
    """Wait until a task has run `more` cycles; return its status."""
    goal = arm.status(task).cycle + more

    def there():
        status = arm.status(task)
        return status if status.cycle >= goal else None

    return wait_for(there, f"{more} cycles of {task}")


def rate_of(fields):
    """Return the releases a second, granted and missed."""
    return (fields["cycle"] + fields["miss"]) / fields["ptime"]


def test_job_is_assembled_runs_and_is_gone_after(arm, two):
    arm.start("puma")
    assert states(arm) == dict.fromkeys(FOUR, "ON")
    cycles(arm, "puma_pidg", 200)
    shown = {value.name: value for value in arm.display()}
    assert shown["Q_MEZ"].writer == "puma_pidg"
    assert shown["T_GRAV"].writer == "grav_comp"
    assert abs(shown["T_GRAV"].values[1]) > 1.0  # the arm is held up
    assert shown["NDOF"].values == [6.0]
    assert not any(rtpu.illegal for rtpu in arm.rtpu_status())
    pids = [status.tid for status in arm.status_all()]
    arm.finish()
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)
    assert two.client().rtpus() == ["arm0", "arm1"]


def test_status_agrees_with_the_kernel(arm):
    arm.start("puma")
    tid = arm.status("puma_pidg").tid

    def look():
        """Return a status between two looks at the clock and at the kernel's figure."""
        begun = time.monotonic(), kernel_cpu(tid)
        status = arm.status("puma_pidg")
        return begun, status, (time.monotonic(), kernel_cpu(tid))

    def counted():
        """A core that stands still just now has not counted yet what that costs."""
        still, now, over = look()
        fields = profile(now, before).fields
        return rate_of(fields) == pytest.approx(500.0, rel=0.05) and (
            still,
            fields,
            over,
        )

    begun, before, going = look()
    cycles(arm, "puma_pidg", 500)
    still, fields, over = wait_for(counted, "500 releases a second")
    assert fields["refT"] == 0.002
    assert fields["cycle"] >= 500
    # The kernel's figure covers the waiting and waking between the cycles too.
    assert fields["totC"] <= (over[1] - begun[1]) * 1.1
    assert fields["totC"] >= (still[1] - going[1]) * 0.6
    assert still[0] - going[0] <= fields["ptime"] <= over[0] - begun[0]
    assert fields["mezT"] == pytest.approx(1.0 / rate_of(fields))
    assert fields["minC"] <= fields["avgC"] <= fields["maxC"]
    assert fields["avgU"] == pytest.approx(100 * fields["avgC"] * 500.0)
    assert fields["S"] == "P"
    assert str(fields["crit"]).endswith("?")  # no MAXC is declared


def test_gain_of_a_running_task_changes_within_its_bounds(arm):
    arm.start("puma")
    version = arm.status("puma_pidg").version
    changed = arm.set("puma_pidg", "kd", [200, 190, 60, 12, 11, 12])
    assert changed[0].value == [200.0, 190.0, 60.0, 12.0, 11.0, 12.0]
    assert arm.get("puma_pidg", "kd")[0].value == changed[0].value
    with pytest.raises(PbonetError) as caught:
        arm.set("puma_pidg", "kd", [-1] * 6)
    assert "-1" in str(caught.value)
    assert arm.get("puma_pidg", "kd")[0].value == changed[0].value
    status = cycles(arm, "puma_pidg", 20)
    assert (status.state, status.version) == ("ON", version)


def test_loop_by_hand_raises_the_flag_until_it_is_closed(arm):
    arm.spawn("puma_pidg", "arm0")
    arm.control("puma_pidg", "on")
    (text,) = [text for text in arm.heard if "T_GRAV" in text]
    assert "in the library, grav_comp and gravity do" in text
    assert any(rtpu.illegal for rtpu in arm.rtpu_status())
    for name in ("grav_comp", "qrdiff", "jttrace"):
        arm.spawn(name, "arm1")
        arm.control(name, "on")
    # The inputs of the robot were too old; the flag goes some cycles later.
    wait_for(
        lambda: not any(rtpu.illegal for rtpu in arm.rtpu_status()), "the flag to go"
    )
    assert cycles(arm, "puma_pidg", 20).state == "ON"


def test_second_writer_is_refused_before_it_runs(arm, puma):
    text = Path(arm.files.library.find_rmod("jttrace")).read_text()
    (puma.parent / "second.rmod").write_text(text)
    arm.start("puma")
    arm.spawn("second", "arm1")
    with pytest.raises(VerificationError, match="Q_REF"):
        arm.control("second", "on")
    arm.reconfig([("jttrace", "off"), ("second", "on")])
    assert states(arm)["second"] == "ON"
    cycles(arm, "second", 2)
    values = arm.display(["Q_REF"])
    assert values[0].writer == "second"


def test_two_masters_for_an_exclusive_rtpu(arm, two, puma, tmp_path):
    with pytest.raises(SeveralError) as caught:
        Subsystem(puma, domain=two.domain).open()
    assert all(isinstance(error, ClaimError) for error in caught.value.errors)
    assert arm.clients.client.name in str(caught.value)
    leg = puma.read_text().replace("puma\n", "leg\n", 1)
    (tmp_path / "leg.sbs").write_text(leg)
    with pytest.raises(SeveralError, match="subsystem puma uses the RTPU"):
        Subsystem(tmp_path / "leg.sbs", domain=two.domain).open()


MASTER = """
import sys, time
from pbonet.master.subsystem import Subsystem
arm = Subsystem(sys.argv[1], domain=sys.argv[2]).open()
arm.start("puma")
print("running", flush=True)
time.sleep(600)
"""


def test_tasks_outlive_a_killed_master_and_the_next_takes_them_up(two, puma):
    master = subprocess.Popen(
        [sys.executable, "-c", MASTER, str(puma), two.domain],
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    assert master.stdout.readline() == "running\n"
    master.kill()
    master.wait()
    master.stdout.close()
    with Subsystem(puma, domain=two.domain) as arm:
        assert states(arm) == dict.fromkeys(FOUR, "ON")
        first = arm.status("puma_pidg")
        assert cycles(arm, "puma_pidg", 50).tid == first.tid
        assert arm.model.find("qrdiff").rmod.module == "diff"
        arm.control("grav_comp", "off")  # it steers them, too
        arm.control("grav_comp", "on")


@pytest.mark.own_limits
@pytest.mark.parametrize("hung", ["arm0", "arm1"])
def test_agent_that_hangs_keeps_nobody_from_the_other(arm, two, puma, hung):
    """Also the one through which the master reaches the others."""
    other = {"arm0": "arm1", "arm1": "arm0"}[hung]
    arm.spawn("puma_pidg", "arm0")
    arm.spawn("jttrace", "arm1")
    arm.control("jttrace", "on")
    two.processes[hung].send_signal(signal.SIGSTOP)
    try:
        wait_for(lambda: arm.clients.client.rtpus() == [other], f"loss of {hung}")
        with pytest.raises(UnreachableError, match=f"{hung}: .* which is stopped"):
            arm.spawn("qrdiff", hung)
        with Subsystem(puma, domain=two.domain, watch=True) as watcher:
            assert {status.rtpu for status in watcher.status_all()} == {other}
        with pytest.raises(SeveralError, match=f"(?s)did not confirm.*{hung}"):
            arm.stop()
        assert {member.rtpu for member in arm.model} == {hung}
    finally:
        two.processes[hung].send_signal(signal.SIGCONT)
    wait_for(lambda: len(arm.clients.client.rtpus()) == 2, f"return of {hung}")
    assert {status.rtpu for status in arm.status_all()} == {hung}


def rmod(module, out="T_GRAV", freq=50):
    return (
        f"MODULE {module}\nDESC a test\nSVARALIAS Y={out}\nINCONST none\n"
        f"OUTCONST none\nINVAR none\nOUTVAR Y\nTASKTYPE periodic\nFREQ {freq}\nEOF\n"
    )


BODY = """
    from typing import Annotated as A

    from pbonet import OutVar, Params, PortBasedObject, Vector


    class Bad(PortBasedObject[Params]):
        '''Something that goes wrong.'''

        y: A[Vector, OutVar("Y", "6", "any", "nothing much")]

        def {method}:
            {code}

        def cycle(self, dt: float) -> None:
            self.y[:] = 1.0
"""


def test_syntax_error_of_a_module_names_file_and_line(arm, two, puma):
    path = two.write_module("bad", "x = 1\ndef f(:\n    pass\n")
    (puma.parent / "bad.rmod").write_text(rmod("bad"))
    with pytest.raises(ModuleLoadError) as caught:
        arm.spawn("bad")
    assert f"{path}:2" in str(caught.value)
    assert states(arm) == {}


def test_start_is_rolled_back_when_an_on_raises(arm, two, puma):
    text = textwrap.dedent(BODY).format(method="on(self) -> None", code="1 / 0")
    two.write_module("bad", text)
    (puma.parent / "bad.rmod").write_text(rmod("bad"))
    job = puma.parent / "puma.job"
    job.write_text(job.read_text().replace("grav_comp", "bad"))
    with pytest.raises(MethodError, match="division by zero"):
        arm.start("puma")
    assert states(arm) == {}
    assert not any(rtpu.illegal for rtpu in arm.rtpu_status())


def test_task_in_error_is_shown_and_cleared(arm, two, puma):
    code = "self.task.fail('no luck')"
    text = textwrap.dedent(BODY).format(method="on(self) -> None", code=code)
    two.write_module("bad", text)
    (puma.parent / "bad.rmod").write_text(rmod("bad"))
    arm.spawn("bad", "arm1")
    with pytest.raises(PbonetError):
        arm.control("bad", "on")
    shown = profile(arm.status("bad"))
    assert shown.fields["state"] == "ERROR"
    assert "no luck" in shown.error
    assert any("no luck" in event.text for event in arm.events())
    with pytest.raises(StateError):
        arm.control("bad", "on")
    assert arm.control("bad", "clear").state == "OFF"
    assert profile(arm.status("bad")).error == ""


def test_rates_are_set_between_cycles(arm):
    arm.start("puma")
    assert arm.freq("jttrace") == 50.0
    assert arm.freq("jttrace", 100.0) == 100.0
    before = arm.status("jttrace")
    cycles(arm, "jttrace", 100)

    def fields():
        return profile(arm.status("jttrace"), before).fields

    assert fields()["refF"] == 100.0
    wait_for(lambda: rate_of(fields()) == pytest.approx(100.0, rel=0.05), "100 Hz")


def test_priorities_follow_the_data_flow(arm):
    arm.start("puma")
    priority = {status.task: status.priority for status in arm.status_all()}
    assert sorted(priority.values()) == [1, 2, 3, 4]
    assert priority["jttrace"] > priority["qrdiff"]
