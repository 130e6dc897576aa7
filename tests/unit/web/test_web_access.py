"""Who may open the page: links that work once, signed cookies, hosts, rates."""

from __future__ import annotations

import pytest
from hypothesis import given, strategies as st

from pbonet.master.web.access import COOKIE_TIME, Access, KeyFile, Rate, Role


class Clock:
    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now


def access(key=b"k" * 32, clock=lambda: 1000.0, **given_):
    given_ = {"hosts": ["127.0.0.1", "localhost", "::1"], "port": 8080} | given_
    return Access(given_.pop("hosts"), given_.pop("port"), key, clock=clock, **given_)


def token(link):
    return link.partition("token=")[2]


def test_a_link_works_once():
    asked = access()
    link = token(asked.links[Role.OPERATOR])
    assert asked.use(link) is Role.OPERATOR
    assert asked.use(link) is None
    again = asked.renew(Role.OPERATOR)
    assert asked.links[Role.OPERATOR] == again
    assert asked.use(token(again)) is Role.OPERATOR


def test_a_renewed_link_replaces_the_one_before():
    asked = access()
    old = token(asked.links[Role.OBSERVER])
    asked.renew(Role.OBSERVER)
    assert asked.use(old) is None


def test_cookies_of_each_role_are_known_until_they_expire():
    clock = Clock()
    asked = access(clock=clock)
    cookies = {role: asked.sign(role) for role in Role}
    assert {role: asked.role(cookie) for role, cookie in cookies.items()} == {
        role: role for role in Role
    }
    clock.now += COOKIE_TIME + 1
    assert [asked.role(cookie) for cookie in cookies.values()] == [None, None]


def test_a_cookie_of_another_key_or_of_a_missing_role_is_void():
    cookie = access().sign(Role.OPERATOR)
    assert access(b"other").role(cookie) is None
    assert access(roles=(Role.OBSERVER,)).role(cookie) is None


def test_an_observers_cookie_cannot_be_turned_into_an_operators():
    asked = access()
    forged = asked.sign(Role.OBSERVER).replace("observer", "operator")
    assert asked.role(forged) is None


@given(st.text(max_size=60))
def test_no_text_is_a_cookie_or_a_token(text):
    asked = access()
    assert asked.role(text) is None
    assert asked.use(text) is None


@pytest.mark.parametrize(
    "host", ["127.0.0.1:8080", "localhost:8080", "LOCALHOST:8080", "[::1]:8080"]
)
def test_its_own_names_are_hosts_and_origins(host):
    asked = access()
    assert asked.is_host(host)
    assert asked.is_origin(f"http://{host}")
    assert not asked.is_origin(f"https://{host}")


@pytest.mark.parametrize(
    "host",
    ["", "127.0.0.1", "localhost:8081", "evil.example:8080", "127.0.0.1:8080.evil"],
)
def test_other_names_are_none(host):
    asked = access()
    assert not asked.is_host(host)
    assert not asked.is_origin(f"http://{host}")


def test_with_tls_links_and_origins_are_https():
    asked = access(hosts=["arm.example"], port=443, secure=True)
    assert asked.links[Role.OBSERVER].startswith("https://arm.example:443/")
    assert asked.is_host("arm.example")
    assert asked.is_origin("https://arm.example")
    assert not asked.is_origin("http://arm.example")


def test_a_rate_allows_a_burst_and_then_so_many_a_second():
    clock = Clock()
    rate = Rate(10.0, 3, clock)
    assert [rate.allows() for _ in range(5)] == [True, True, True, False, False]
    clock.now += 0.1
    assert [rate.allows(), rate.allows()] == [True, False]
    clock.now += 100.0
    assert sum(rate.allows() for _ in range(9)) == 3


def test_the_key_file_outlives_a_kill_and_only_its_user_reads_it(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    file = KeyFile("default", "arm", 8080)
    key = file.read()
    assert len(key) == 32
    assert file.path.stat().st_mode & 0o777 == 0o600
    assert KeyFile("default", "arm", 8080).read() == key
    assert KeyFile("default", "arm", 8081).read() != key
    file.path.write_bytes(b"short")
    assert len(file.read()) == 32
    file.remove()
    file.remove()
    assert file.read() != key
