"""``pbonet allocate`` on files: costs, pins, what is refused, and what is written."""

from __future__ import annotations

import json
import re

import msgspec
import pytest
from edited_jobs import content, puma

from pbonet.analysis.schedule import CoreShare
from pbonet.config import Library, read_job
from pbonet.errors import PbonetError, UnknownTaskError, VerificationError
from pbonet.master.configuration import Files, Place, Saved, check_file
from pbonet.master.configuration.saved_profiles import setup_of
from pbonet.master.planning import allocate, known_rtpus
from pbonet.master.planning.allocation_problem import problem_of
from pbonet.master.planning.known_rtpus import KnownRtpus, cores_of

__all__ = ["puma"]

pytest.importorskip("scipy")
HERE = Place()


def rtpus(found):
    return {one.rtpu: one.tasks for one in found.rtpus}


def edit(path, *pairs):
    """Replace texts of a file."""
    text = path.read_text()
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)


def test_all_that_fits_comes_together(puma):
    found, _ = allocate(puma, HERE, assume=0.2)
    assert found.places == {"puma_pidg": "arm1"}
    assert (found.gap, found.keeps) == (0.0, True)
    assert (found.traffic_before > 40_000, found.traffic_after) == (True, 0.0)
    (chain,) = found.chains
    assert chain.tasks == ["jttrace", "qrdiff", "puma_pidg", "grav_comp", "puma_pidg"]
    # grav_comp runs half as often as puma_pidg: on one RTPU it reads what is new
    assert chain.after < chain.before
    assert [one.before for one in found.rtpus] == pytest.approx([0.2, 0.6])
    assert [one.after for one in found.rtpus] == pytest.approx([0.0, 0.8])


def test_a_load_that_does_not_fit_together_is_parted_at_the_least_traffic(puma):
    found, _ = allocate(puma, HERE, assume=0.3)
    away = min(rtpus(found).values(), key=len)
    assert away == ["jttrace"]  # 2 variables at the lowest rate
    assert all(one.after <= 0.95 for one in found.rtpus)


def test_rtpus_of_one_machine_exchange_for_nothing(puma):
    found, _ = allocate(
        puma, HERE, assume=0.3, machines=["arm0=m", "arm1=m"], weight=1.0
    )
    assert (found.traffic_before, found.traffic_after, found.moves) == (0.0, 0.0, [])
    with pytest.raises(PbonetError, match=r"--machine cannot be 'amr0=m'.*mean.*arm0"):
        allocate(puma, HERE, machines=["amr0=m"])
    with pytest.raises(PbonetError, match=r"--machine cannot be 'arm0=n'"):
        allocate(puma, HERE, machines=["arm0=m", "arm0=n"])


def test_marks_in_the_job_and_of_the_command_are_respected(puma):
    edit(puma, ("puma_pidg  arm0", "puma_pidg  arm0 FIXED"))
    found, _ = allocate(puma, HERE, assume=0.2)
    assert {*found.places} == {"grav_comp", "qrdiff", "jttrace"}
    assert found.pins == {"puma_pidg": "FIXED in the job"}
    found, _ = allocate(puma, HERE, assume=0.2, fixed=["grav_comp"])
    assert "grav_comp" not in found.places
    with pytest.raises(UnknownTaskError, match="did you mean grav_comp"):
        allocate(puma, HERE, assume=0.2, fixed=["grav_com"])


def test_unknown_times_are_refused(puma):
    with pytest.raises(VerificationError, match=r"not known .* puma_pidg, grav_comp"):
        allocate(puma, HERE)


def test_what_does_not_fit_is_told_with_what_would_help(puma):
    lines = puma.read_text()
    puma.write_text(re.sub(r"(TASK .* arm[01])", r"\1 FIXED", lines))
    with pytest.raises(VerificationError) as caught:
        allocate(puma, HERE, assume=0.35)
    told = str(caught.value)
    assert "RTPU arm1 would have 10.4% of a core too much" in told
    assert "grav_comp 35.0%, FIXED in the job" in told
    assert "105.4% on arm1" in told
    assert "dispatching 0.4%" in told
    assert "let grav_comp run elsewhere (FIXED in the job)" in told
    puma.write_text(lines)
    with pytest.raises(VerificationError, match=r"all RTPUs together .* 50.9% .* no s"):
        allocate(puma, HERE, assume=0.6)
    with pytest.raises(VerificationError, match=r"puma_pidg alone is too much for arm"):
        allocate(puma, HERE, assume=0.96)


def test_dispatching_takes_its_part_as_the_scheduler_counts_it(puma):
    """A task of 500 Hz takes 94.8 % of a core, and its releases 0.5 % more."""
    with pytest.raises(
        VerificationError, match=r"puma_pidg alone .* \(10 us a release"
    ):
        allocate(puma, HERE, assume=0.948, fixed=["grav_comp", "qrdiff", "jttrace"])


@pytest.mark.parametrize(
    ("limit", "a", "b"), [(None, 0.9, 0.95), (0.8, 0.8, 0.8), (0.97, 0.9, 0.97)]
)
def test_a_limit_takes_from_what_an_agent_grants(limit, a, b):
    granted = CoreShare(share=0.9, dispatch=3e-5)
    known = KnownRtpus(machines={"a": "m", "b": "m"}, shares={"a": granted})
    found = cores_of(known, limit)
    assert (found["a"].share, found["b"].share) == (a, b)
    assert (found["a"].dispatch, found["b"].dispatch) == (3e-5, 1e-5)


def test_a_lower_frequency_that_was_offered_is_enough(puma):
    for name in ("puma_pidg", "grav_comp", "qrdiff", "jttrace"):
        record = Files(puma, Library(())).rmod(name)
        maxc = 0.55 / record.record.freq
        text = re.sub(r"(FREQ.*\n)", rf"\1MAXC {maxc:.9f}\n", record.text, count=1)
        (puma.parent / f"{name}.rmod").write_text(text)
    edit(puma.parent / "puma.sbs", ("EOF", "RTPU arm2\nEOF"))
    with pytest.raises(VerificationError) as caught:
        allocate(puma, HERE)
    told = str(caught.value)
    assert "add an RTPU to the .sbs file" in told
    task, hz = re.search(r"run (\w+) at ([\d.]+) Hz or less", told).groups()
    puma.write_text(re.sub(rf"(TASK *{task} .*)", rf"\1 FREQ {hz}", puma.read_text()))
    found, _ = allocate(puma, HERE)
    assert not found.keeps
    assert all(one.after <= 0.95 for one in found.rtpus)


def test_standbys_that_take_over_stay_apart(puma):
    files = Files(puma, Library(()))
    text = files.rmod("puma_pidg").text.replace("EOF", "")
    rmod = re.sub(r"(FREQ.*\n)", r"\1CRITICAL\nRTPU arm1\n", text, count=1)
    rmod = rmod.replace("CRITICAL\nRTPU arm1\nCRITICAL", "CRITICAL\nRTPU arm1")
    (puma.parent / "spare.rmod").write_text(f"{rmod}EOF\n")
    edit(puma, ("puma_pidg  arm0", "puma_pidg  arm0 FALLBACK spare TAKEOVER 4"))
    edit(puma.parent / "puma.sbs", ("MASTER     arm0", "MASTER     arm1"))
    found, _ = allocate(puma, HERE, assume=0.2)
    place = {task: one.rtpu for one in found.rtpus for task in one.tasks}
    assert (place["puma_pidg"], place["spare"]) == ("arm0", "arm1")
    with pytest.raises(VerificationError, match=r"no machine is left for spare"):
        allocate(puma, HERE, assume=0.2, machines=["arm0=m", "arm1=m"])


def test_a_standby_that_must_stay_keeps_its_original_there(puma):
    files = Files(puma, Library(()))
    (puma.parent / "spare.rmod").write_text(files.rmod("puma_pidg").text)
    edit(puma, ("puma_pidg  arm0", "puma_pidg  arm0 FALLBACK spare"))
    found, _ = allocate(puma, HERE, assume=0.2)
    assert found.places == {"puma_pidg": "arm1", "spare": "arm1"}
    found, _ = allocate(puma, HERE, assume=0.2, fixed=["spare"])
    assert not {"puma_pidg", "spare"} & {*found.places}
    assert found.pins["puma_pidg"] == "spare FIXED in --fix"


@pytest.mark.parametrize(("cores", "warned"), [((1, 1), True), ((1, 2), False)])
def test_rtpus_on_one_core_are_warned_of(puma, monkeypatch, cores, warned):
    known = KnownRtpus(
        machines={"arm0": "m", "arm1": "m"},
        cores=dict(zip(("arm0", "arm1"), cores, strict=True)),
        asked=True,
    )
    monkeypatch.setattr(known_rtpus, "ask_agents", lambda *_: known)
    _, warnings = allocate(puma, HERE, running=True, assume=0.3)
    assert ["arm0, arm1 share core 1" in one for one in warnings] == [True] * warned
    if warned:
        assert "they would use 120.0% of it" in warnings[0]


def test_times_are_those_of_each_machine(puma):
    files = Files(puma, Library(()))
    rmod = files.rmod("grav_comp").record
    version = files.library.load_rmod(rmod).info.version
    for host, most in (("fast", 0.0001), ("slow", 0.0006)):
        saved = Saved(
            rmod=rmod.name,
            module=rmod.module,
            version=version,
            setup=setup_of(rmod, files.table),
            host=host,
            rtpu="arm0",
            when="",
            hz=250.0,
            cycles=100,
            least=most / 2,
            most=most,
            mean=most,
            bins=((100, 100),),
        )
        path = puma.parent / "profiles" / host / "grav_comp.json"
        path.parent.mkdir(parents=True)
        path.write_bytes(msgspec.json.encode(saved))
    known = KnownRtpus(
        machines={"arm0": "a", "arm1": "b"}, hosts={"arm0": "slow", "arm1": "fast"}
    )
    problem, _ = problem_of(files, known, "fast", assume=0.1)
    item = problem.by_name["grav_comp"]
    assert item.share("arm0") == pytest.approx(0.15)
    assert item.share("arm1") == pytest.approx(0.025)
    assert problem.by_name["qrdiff"].share("arm0") == pytest.approx(0.1)


def test_devices_keep_tasks_where_they_are(tmp_path):
    folder = tmp_path / "rig"
    folder.mkdir()
    (folder / "rig.svar").write_text(
        "NAME Z\nTYPE double\nDESC value\nUNITS m\nNELEM 1\nEOF\n"
    )
    (folder / "rig.sbs").write_text(
        "SUBSYSTEM rig\nSVARFILE rig.svar\nRTPU a\nRTPU b\nRTPU c\nEOF\n"
    )
    (folder / "rig.job").write_text("JOB rig\nDESC r\nSBS rig.sbs\nTASK eye a\nEOF\n")
    (folder / "looks.py").write_text(
        "from typing import Annotated as A\n"
        "from pbonet import OutVar, Params, PortBasedObject, param\n"
        "class LooksParams(Params):\n"
        "    eye: A[str, param('none', 'which device', device=True)]\n"
        "class Looks(PortBasedObject[LooksParams]):\n"
        "    '''Looks.'''\n"
        "    z: A[float, OutVar('Z', '1', 'm', 'what it sees')]\n"
        "    def cycle(self, dt):\n        self.z = 0.0\n"
    )
    (folder / "eye.rmod").write_text(
        "MODULE looks\nDESC it looks\nINCONST none\nOUTCONST none\nINVAR none\n"
        "OUTVAR Z\nTASKTYPE periodic\nFREQ 10\nMAXC 0.01\nLOCAL\neye cam\nEOF\n"
    )
    files = Files(folder / "rig.job", Library([folder]))
    machines = {name: name for name in "abc"}
    problem, _ = problem_of(files, KnownRtpus(machines=machines), "here")
    assert list(problem.items[0].tasks) == ["a"]
    assert problem.items[0].pin == "opens device cam, and no agent was asked who has it"
    names = {"a": {"device": []}, "b": {"device": ["cam"]}, "c": {"device": ["arm"]}}
    known = KnownRtpus(machines=machines, names=names, asked=True)
    problem, _ = problem_of(files, known, "here")
    assert list(problem.items[0].tasks) == ["b"]


def test_it_is_written_line_by_line_or_only_shown(puma, call):
    edit(puma, ("puma_pidg  arm0", "puma_pidg  arm0   # its core is quiet"))
    before = content(puma.parent)
    status, out, _ = call("allocate", puma, "--assume", 0.2, "--write", "--dry-run")
    assert (status, content(puma.parent)) == (0, before)
    assert "+TASK  puma_pidg arm1   # its core is quiet\n" in out
    status, out, _ = call("allocate", puma, "--assume", 0.2, "--write", "--json")
    data = json.loads(out)
    assert (status, data["files"]) == (0, [str(puma)])
    assert data["moves"] == [{"task": "puma_pidg", "from": "arm0", "to": "arm1"}]
    assert read_job(puma).tasks[0].rtpu == "arm1"
    assert "# its core is quiet" in puma.read_text()
    assert check_file(puma).legal
    status, out, _ = call("allocate", puma, "--assume", 0.2, "--write")
    assert "the present assignment stays" in out
    assert "proven best" in out


@pytest.mark.parametrize(
    "words",
    [
        ("--write", "--apply"),
        ("--dry-run",),
        ("--running", "--machine", "arm0=m"),
        ("--latency", 1e300),
    ],
)
def test_options_that_do_not_go_together(puma, call, words):
    assert call("allocate", puma, *words)[0] == 2
