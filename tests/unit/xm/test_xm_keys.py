"""Key folders: made, read, and refused when they cannot be used."""

import datetime as dt
import stat
import subprocess

import pytest
from cryptography import x509

from pbonet.cli import program
from pbonet.errors import ConfigFileError, NodeError
from pbonet.xm.net import credentials, pki, session
from pbonet.xm.net.credentials import Role


@pytest.fixture
def lab(tmp_path):
    pki.make_authority(tmp_path / "lab")
    return tmp_path / "lab"


def test_agents_keys_tell_where_it_is(lab):
    folder = pki.issue(lab, Role.AGENT, "arm-pc", hosts=["10.0.0.2", "::1", "arm.lab"])
    holder = pki.read(folder)
    assert (holder.name, holder.role) == ("arm-pc", Role.AGENT)
    assert (holder.revocable, holder.revoked, holder.refuses) == (True, False, ())
    assert holder.hosts == ("10.0.0.2", "::1", "arm.lab")
    assert 824 < holder.days <= 825


@pytest.mark.parametrize("role", [Role.MASTER, Role.OBSERVER])
def test_people_need_no_host(lab, role):
    assert pki.read(pki.issue(lab, role, "anna")).hosts == ()


def test_openssl_follows_the_chain(lab):
    """A second opinion on whether the certificate is the authority's."""
    folder = pki.issue(lab, Role.AGENT, "arm-pc", hosts=["10.0.0.2"])
    for purpose in ("sslserver", "sslclient"):
        done = subprocess.run(
            [
                *("openssl", "verify", "-purpose", purpose, "-verify_ip", "10.0.0.2"),
                *("-CAfile", lab / "ca.pem", folder / "cert.pem"),
            ],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr


def test_private_keys_are_their_owners(lab):
    folder = pki.issue(lab, Role.MASTER, "anna")
    for path in (lab / "ca.key", folder / "key.pem"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert credentials.check(folder) == folder


def test_key_that_everybody_may_read_is_refused(lab):
    folder = pki.issue(lab, Role.MASTER, "anna")
    (folder / "key.pem").chmod(0o644)
    with pytest.raises(ConfigFileError) as caught:
        credentials.check(folder)
    assert "all users may read" in str(caught.value)
    assert f"chmod 600 {folder}/key.pem" in str(caught.value)


def test_key_of_a_group_is_allowed(lab):
    folder = pki.issue(lab, Role.AGENT, "arm-pc", hosts=["h"])
    (folder / "key.pem").chmod(0o640)
    credentials.check(folder)


@pytest.mark.parametrize("missing", credentials.FILES)
def test_folder_without_a_file_is_none(lab, missing):
    folder = pki.issue(lab, Role.MASTER, "anna")
    (folder / missing).unlink()
    with pytest.raises(ConfigFileError) as caught:
        credentials.check(folder)
    assert str(caught.value).startswith(f"{folder}/{missing}: this is not a key folder")
    assert "pbonet keys" in caught.value.remedy


def refusal(folder, roles=tuple(Role)):
    """Return what is said of keys that nobody would take."""
    with pytest.raises(ConfigFileError) as caught:
        credentials.prove(folder, roles)
    return str(caught.value)


@pytest.mark.parametrize("role", Role)
def test_good_keys_are_proved(lab, role):
    folder = pki.issue(lab, role, "anna", hosts=["h"])
    credentials.prove(folder)
    credentials.prove(folder, [role])


def test_a_certificate_that_has_run_out_is_told(lab):
    folder = pki.issue(lab, Role.MASTER, "anna", days=-0.01)
    assert refusal(folder) == (
        f"{folder}/cert.pem: the certificate has expired (got certificate has expired);"
        " `pbonet keys agent|gateway|master|observer NAME` makes another"
    )
    assert pki.read(folder).days < 0  # and is still shown


def test_a_certificate_of_tomorrow_is_told(lab, monkeypatch):
    monkeypatch.setattr(pki, "_EARLY", dt.timedelta(hours=-1))
    folder = pki.issue(lab, Role.MASTER, "anna")
    assert "not valid yet" in refusal(folder)
    assert "set the clock" in refusal(folder)


def test_files_of_two_folders_are_told(lab, tmp_path):
    anna, bert = (pki.issue(lab, Role.MASTER, name) for name in ("anna", "bert"))
    (anna / "key.pem").write_bytes((bert / "key.pem").read_bytes())
    assert "do not belong together (expected cert.pem, its key.pem" in refusal(anna)
    pki.make_authority(tmp_path / "other")
    (bert / "ca.pem").write_bytes((tmp_path / "other" / "ca.pem").read_bytes())
    assert "not signed by the authority beside it" in refusal(bert)


@pytest.mark.parametrize("name", credentials.FILES)
def test_a_file_that_is_none_is_told(lab, name):
    folder = pki.issue(lab, Role.MASTER, "anna")
    (folder / name).write_text("what is this?")
    assert "do not belong together" in refusal(folder)


@pytest.mark.parametrize("role", [Role.MASTER, Role.OBSERVER])
def test_an_agent_takes_no_other_keys(lab, role):
    folder = pki.issue(lab, role, "anna")
    assert refusal(folder, credentials.AGENTS) == (
        f"{folder}/cert.pem: these keys are for another role (expected agent or "
        f"gateway, got {role}); `pbonet keys agent|gateway NAME` makes the correct ones"
    )


def test_nothing_is_written_over(lab):
    pki.issue(lab, Role.MASTER, "anna")
    with pytest.raises(NodeError, match="already has keys"):
        pki.issue(lab, Role.OBSERVER, "anna")
    with pytest.raises(NodeError, match="already has an authority"):
        pki.make_authority(lab)


@pytest.mark.parametrize("name", ["", "../anna", "a" * 32, "-x", "an na"])
def test_name_must_be_one(lab, name):
    with pytest.raises(NodeError, match="not a valid name"):
        pki.issue(lab, Role.MASTER, name)


@pytest.mark.parametrize("role", credentials.AGENTS)
def test_agent_without_a_host_is_refused(lab, role):
    with pytest.raises(NodeError) as caught:
        pki.issue(lab, role, "arm-pc")
    assert f"pbonet keys {role} arm-pc --host 10.0.0.2" in caught.value.remedy


def test_host_that_is_none_is_refused(lab):
    with pytest.raises(NodeError, match="this is not a host"):
        pki.issue(lab, Role.AGENT, "arm-pc", hosts=["ärm.lab"])


def test_no_authority(tmp_path):
    with pytest.raises(ConfigFileError) as caught:
        pki.issue(tmp_path, Role.MASTER, "anna")
    assert caught.value.remedy == f"make one: pbonet keys ca --ca {tmp_path}"


def test_damaged_authority(lab):
    (lab / "ca.pem").write_text("no certificate")
    with pytest.raises(ConfigFileError, match="damaged"):
        pki.issue(lab, Role.MASTER, "anna")


def test_damaged_certificate(lab):
    folder = pki.issue(lab, Role.MASTER, "anna")
    (folder / "cert.pem").write_text("no certificate")
    with pytest.raises(ConfigFileError, match="not a certificate of pbonet"):
        pki.read(folder)


def test_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "lab").write_text("a file")
    with pytest.raises(ConfigFileError, match="cannot be written"):
        pki.make_authority(tmp_path / "lab" / "keys")


# -- revocation ---


def test_a_revoked_certificate_is_refused_by_the_new_ca_and_others_are_not(lab):
    """Of a holder who has two, both; a later one of the same name is good."""
    anna, bert = (pki.issue(lab, Role.MASTER, name) for name in ("anna", "bert"))
    again = pki.issue(lab, Role.OBSERVER, "anna", folder=lab / "again")
    away = pki.issue(lab, Role.MASTER, "anna", folder=lab.parent / "away")
    written = pki.revoke(lab, "anna")
    assert written == [f / "ca.pem" for f in (lab, lab / "again", anna, bert)]
    for folder in (anna, again):
        assert "the certificate has been revoked" in refusal(folder)
        assert pki.read(folder).revoked
    credentials.prove(away)  # its ca.pem is the old one
    (away / "ca.pem").write_bytes((lab / "ca.pem").read_bytes())
    assert "the certificate has been revoked" in refusal(away)
    later = pki.issue(lab, Role.MASTER, "anna", folder=lab / "later")
    for folder in (bert, later):
        credentials.prove(folder)
        assert not pki.read(folder).revoked
        assert pki.read(folder).refuses == ("anna",)


def test_revocations_add_up_and_the_authority_lasts_as_long(lab):
    names = ["_a.b-.", "x" * 31, "bert"]
    folders = [pki.issue(lab, Role.AGENT, name, hosts=["h.lab"]) for name in names]
    bert = folders[-1]
    before = x509.load_pem_x509_certificate((lab / "ca.pem").read_bytes())
    for name in names[:2]:
        pki.revoke(lab, name)
    after = x509.load_pem_x509_certificate((lab / "ca.pem").read_bytes())
    assert after.not_valid_after_utc == before.not_valid_after_utc
    assert after.subject == before.subject
    pki.revoke(lab, names[0])  # as before
    assert pki.read(bert).refuses == tuple(sorted(names[:2]))
    assert [pki.read(folder).revoked for folder in folders] == [True, True, False]
    credentials.prove(bert)


def test_a_name_that_has_no_certificate_is_told(lab):
    pki.issue(lab, Role.MASTER, "anna")
    with pytest.raises(NodeError, match="was made for a holder ana") as caught:
        pki.revoke(lab, "ana")
    assert "anna" in caught.value.remedy
    assert pki.read(lab / "anna").refuses == ()


def test_a_folder_of_another_authority_keeps_its_own(lab, tmp_path):
    pki.make_authority(tmp_path / "other")
    alien = pki.issue(tmp_path / "other", Role.MASTER, "eve", folder=lab / "eve")
    kept = (alien / "ca.pem").read_bytes()
    pki.issue(lab, Role.MASTER, "anna")
    assert len(pki.revoke(lab, "anna")) == 2
    assert (alien / "ca.pem").read_bytes() == kept


def test_what_an_older_version_has_made(lab, monkeypatch):
    """An agent's certificate is a gateway's, and none has a name of its own."""
    old = x509.SubjectAlternativeName
    with monkeypatch.context() as patch:
        patch.setattr(x509, "SubjectAlternativeName", lambda names: old(names[:-1]))
        folder = pki.issue(lab, Role.GATEWAY, "arm-pc", hosts=["h"])
    (lab / "issued.txt").unlink()
    holder = pki.read(folder)
    subject = x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes()).subject
    assert "CN=pbonet-agent" in subject.rfc4514_string()
    assert (holder.role, holder.revocable) == (Role.GATEWAY, False)
    credentials.prove(folder, credentials.AGENTS)
    with pytest.raises(NodeError) as caught:
        pki.revoke(lab, "arm-pc")
    assert "make another authority" in caught.value.remedy


def test_the_commands_say_what_is_revoked(lab, capsys):
    for name in ("anna", "bert"):
        pki.issue(lab, Role.MASTER, name)
    program.run(["keys", "revoke", "anna", "--ca", str(lab)])
    assert f"{lab}/anna/ca.pem" in capsys.readouterr().out.splitlines()
    program.run(["keys", "gateway", "desk", "--host", "10.0.0.1", "--ca", str(lab)])
    capsys.readouterr()
    folders = [str(lab / name) for name in ("anna", "bert", "desk")]
    program.run(["keys", "show", *folders])
    anna, bert, desk = capsys.readouterr().out.splitlines()
    assert anna.startswith("anna: master, until ")
    assert anna.endswith(" (REVOKED); refuses anna")
    assert bert.endswith(" days left); refuses anna")
    assert desk.startswith("desk: gateway at 10.0.0.1, until ")


# -- endpoints ---


def test_tls_needs_keys():
    with pytest.raises(NodeError) as caught:
        session.check_endpoint("tls/10.0.0.2:7447")
    assert str(caught.value).startswith("tls/10.0.0.2:7447: TLS needs keys")


@pytest.mark.parametrize("protocol", ["tcp", "udp", "ws"])
def test_with_keys_everything_else_is_refused(lab, protocol):
    endpoint = f"{protocol}/127.0.0.1:7447"
    with pytest.raises(NodeError) as caught:
        session.check_endpoint(endpoint, key_folder=lab)
    assert caught.value.expected == "tls/127.0.0.1:7447"


def test_with_keys_any_address_is_allowed(lab):
    endpoint = "tls/[2001:db8::1]:7447"
    assert session.check_endpoint(endpoint, insecure=False, key_folder=lab) == endpoint


def test_over_tls_a_host_of_ipv6_is_dialled_by_name(lab):
    """Its address in brackets can be listened on, and is in no certificate."""
    with pytest.raises(NodeError) as caught:
        session.check_dialled("tls/[2001:db8::1]:7447", key_folder=lab)
    assert caught.value.expected == "tls/NAME:7447"
    for endpoint in ("tls/arm.lab:7447", "tls/10.0.0.2:7447"):
        assert session.check_dialled(endpoint, key_folder=lab) == endpoint
    assert session.check_dialled("tcp/[2001:db8::1]:7447") == "tcp/[2001:db8::1]:7447"


def test_without_either_only_this_machine():
    with pytest.raises(NodeError) as caught:
        session.check_endpoint("tcp/10.0.0.2:7447", insecure=False)
    assert "pbonet keys" in caught.value.remedy
    assert "--insecure" in caught.value.remedy
