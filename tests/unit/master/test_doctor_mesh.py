"""``pbonet doctor`` warns of agents that are linked with too many others."""

from xm_rig import agent_info

from pbonet.master.tools import doctor
from pbonet.xm.net import client_of_router, messages as m


def warned(hops):
    ways = [
        m.Way(rtpu=f"m{n}", host=f"host-{n // 2}", trip=1e-3, hops=hops)
        for n in range(2 * client_of_router.MESH)
    ]
    report = m.LinkReport(rtpu="hub", ways=ways)
    fewer = m.LinkReport(rtpu="hub", ways=ways[2:])
    assert not list(doctor.meshed("hub", fewer))
    return [str(one) for one in doctor.meshed("hub", report)]


def test_links_of_its_own_to_many_machines():
    (text,) = warned(hops=1)
    assert text.startswith("WARN hub has links to agents of 8 other machines")
    assert "start a router (`pbonet router`)" in text


def test_many_machines_by_a_router():
    assert not warned(hops=2)


def test_agents_of_one_machine_that_are_linked_each_with_each():
    def warned(count, routers=(), ended=0):
        sockets = [f"unixsock-stream/run/a{n}.sock" for n in range(count)]
        infos = [
            agent(f"a{n}", routers or sockets[:n], "one") for n in range(ended, count)
        ] + [agent("b", [*sockets[:3], "tcp/10.0.0.7:7447"], "two")]
        return [str(one) for one in doctor.crowded(infos)]

    most = client_of_router.MESH
    assert not warned(most)
    (text,) = warned(most + 1)
    assert text.startswith(f"WARN {most + 1} agents of one-pc are linked each with")
    assert "remove listen, connect and multicast from agent.toml of all but" in text
    assert not warned(most + 1, ["tcp/127.0.0.1:7447"])
    assert not warned(most + 1, ended=1)


def agent(name, dials, machine):
    return agent_info(name, host=f"{machine}-pc", machine=machine, dials=list(dials))
