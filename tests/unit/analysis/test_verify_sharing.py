"""RTPUs on one core: what their reports are still worth, and who says so."""

from __future__ import annotations

import pytest
from verify_parts import configuration, rtpu, task
from xm_rig import agent_info

from pbonet.analysis import legality
from pbonet.analysis.schedule import CoreShare
from pbonet.config.model import TaskType
from pbonet.master.tools import doctor
from pbonet.xm.net import run_folder


def reports(*shares, scheduler="MUF", **settings):
    """Return the reports of an RTPU for each share: one task of 100 Hz."""
    names = [f"arm{n}" for n in range(len(shares))]
    given = [settings | ({} if s is None else {"maxc": s / 100.0}) for s in shares]
    tasks = [task(n, rtpu=n, **more) for n, more in zip(names, given, strict=True)]
    rtpus = [rtpu(name, scheduler) for name in names]
    return legality.report(
        configuration(*tasks, rtpus=rtpus, core=CoreShare(share=0.95))
    )


def test_what_fits_together_keeps_its_promise():
    found = legality.sharing(reports(0.4, 0.5))
    assert found.kept
    assert found.as_text(1) == (
        "arm0, arm1 share core 1, but each was analysed as if it had the core alone; "
        "together they need 90.0% of at most 95.0%, so that the results hold"
    )


def test_what_does_not_fit_together_is_no_promise():
    each = reports(0.4, 0.6)
    assert {one.outlook for one in each} == {legality.Outlook.SCHEDULABLE}
    found = legality.sharing(each)
    assert not found.kept
    assert found.as_text(3) == (
        "arm0, arm1 share core 3, but each was analysed as if it had the core alone; "
        "together they need 100.0% of at most 95.0%, so that no deadline is "
        "guaranteed; give each a core of its own (pbonet agent --core), or analyse "
        "their tasks on one RTPU"
    )


def test_what_nobody_knows_is_said():
    text = legality.sharing(reports(0.4, None)).as_text(1)
    assert "at least 40.0%" in text
    assert text.endswith("the results hold, if tasks of unknown MAXC take no time")


@pytest.mark.parametrize(
    ("scheduler", "settings"),
    [
        ("RM", {}),
        ("MUF", {"crit": 7}),
        ("MUF", {"tasktype": TaskType.SPORADIC, "capacity": 0.001}),
    ],
)
def test_nothing_is_proven_of_rates_servers_and_given_criticalities(
    scheduler, settings
):
    assert not legality.sharing(reports(0.1, 0.1, scheduler=scheduler, **settings)).kept


def agent(name, core, machine=None):
    return agent_info(
        name, host="robot", machine=machine or run_folder.machine(), core=core, cores=4
    )


def test_doctor_warns_of_agents_on_one_core():
    infos = [agent("b", 1), agent("a", 1), agent("c", 2), agent("d", 1, "other")]
    found = list(doctor.cores(infos, [0, 1, 2]))
    assert [str(one) for one in found] == [
        "WARN a, b share core 1 of robot; `pbonet check` judges each as the owner of a "
        "core; add their utilizations up, or give each a core of its own (pbonet agent "
        "--core)"
    ]


def test_doctor_warns_when_no_core_is_left():
    found = list(doctor.cores([agent("a", 0), agent("b", 1)], [0, 1]))
    assert [one.what for one in found] == [
        "RTPUs own every core of this machine; none is left for housekeeping"
    ]


def test_doctor_tells_rtpus_of_other_domains():
    """On a core of this domain's, on one of their own; together they may take all."""
    others = [doctor.Neighbour("lab", "x", 1), doctor.Neighbour("lab", "y", 0)]
    texts = [str(one) for one in doctor.cores([agent("a", 1)], [0, 1], others)]
    assert texts[0] == "PASS x of domain lab has core 1 of this machine"
    assert texts[1] == "PASS y of domain lab has core 0 of this machine"
    assert texts[2].startswith("WARN a, x of domain lab share core 1 of ")
    assert texts[3].startswith("WARN RTPUs own every core of this machine")
    assert [one.level for one in doctor.cores([], [0, 1], others[:1])] == [
        doctor.Level.PASS
    ]
