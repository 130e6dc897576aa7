"""Requests to several RTPUs at once: each one's own, under its own claim."""

from __future__ import annotations

from types import NoneType

from pbonet.config import parse_sbs
from pbonet.master.subsystem.rtpu_clients import RtpuClients
from pbonet.xm.net import messages as m

SBS = "SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nRTPU arm1\nEOF\n"


class Client:
    """Takes requests and sends none."""

    def call_all(self, requests, _result, **_limit):
        self.sent = requests
        return {}, []


def test_one_request_for_all_is_signed_for_each():
    client = Client()
    fleet = RtpuClients(client, parse_sbs(SBS, "t.sbs"))
    fleet.epochs = {"arm0": 7, "arm1": 9}
    request = m.Sigmask(names=["WARNING"])
    fleet.each(lambda _: request, NoneType)
    assert {rtpu: one.epoch for rtpu, one in client.sent.items()} == fleet.epochs
    assert {one.subsystem for one in client.sent.values()} == {"t"}
    assert client.sent["arm0"] is not client.sent["arm1"], "each gets its own number"
