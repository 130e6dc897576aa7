"""``pbonet doctor`` warns of agents that are linked with too many machines."""

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
