"""What a backup has, and what is given back of it."""

import hashlib
import os
import pwd

import msgspec
import pytest
from msgspec import structs

from pbonet.deploy import backup, print_config_files, steps
from pbonet.deploy.backup import Content, Told
from pbonet.errors import ConfigFileError

CONFIG = steps.config_of("arm0")


def content(data=b"core = 1\n", path=CONFIG, **rights):
    """What a machine tells of a file."""
    given = {"mode": 0o640, "owner": "root", "group": "pbonet", **rights}
    return Content(
        path=path,
        digest=hashlib.sha256(data).hexdigest(),
        data=data,
        **given,
    )


def told(*files):
    return Told(files=[*files], enabled=["arm0"], release="r")


@pytest.fixture
def plan(tmp_path):
    """Back a file up, and plan how a machine that has another one gets it back."""

    def one(saved, there):
        backup._write(tmp_path, told(saved))
        return [*backup._plan(tmp_path, backup._read(tmp_path), told(there))]

    return one


@pytest.mark.parametrize(
    "change",
    [{"mode": 0o666}, {"owner": "anna"}, {"group": "users"}, {"owner": "1234"}],
)
def test_rights_are_given_back_as_contents_are(plan, change):
    first, *rest = plan(content(), content(**change))
    assert (first.state, first.diff) == ("change", "")
    assert first.what.endswith("becomes root:pbonet 0640")
    (put,) = first.actions
    assert (put.mode, put.owner, put.group) == (0o640, "root", "pbonet")
    assert [step.name for step in rest] == ["service"]
    (same,) = plan(content(), content())
    assert same.state == "same"


def test_backups_of_earlier_releases_have_no_groups(plan):
    (same,) = plan(content(group=""), content())
    assert same.state == "same"
    first = plan(content(group=""), content(mode=0o600))[0]
    assert first.actions[0].group == ""
    assert structs.asdict(first.actions[0])["mode"] == 0o640


def test_a_machine_tells_owner_group_and_mode(tmp_path):
    path = tmp_path / "arm0.toml"
    path.write_text("core = 1\n")
    path.chmod(0o4750)
    found = print_config_files.described(path)
    assert found["mode"] == 0o4750
    assert found["owner"] == pwd.getpwuid(os.getuid()).pw_name
    assert found["group"]
    said = msgspec.json.encode(found)
    assert msgspec.json.decode(said, type=Content).data == b"core = 1\n"


def test_an_empty_file_is_given_back(plan):
    empty = content(b"")
    (same,) = plan(empty, empty)
    assert same.state == "same"
    assert plan(empty, content())[0].actions[0].data == b""


def test_a_file_with_a_private_key_is_not_in_a_backup(tmp_path):
    path = f"{steps.ETC}/keys/other.pem"
    secret = structs.replace(content(path=path), data=b"")
    there = told(secret, content())
    backup._write(tmp_path, there)
    (same,) = backup._plan(tmp_path, backup._read(tmp_path), there)
    assert (same.state, same.what) == ("same", CONFIG)


@pytest.mark.parametrize(
    "path",
    [
        *("/etc/shadow", "/srv/other/authorized_keys", "etc/pbonet/arm0.toml"),
        *("/etc/pbonet/../shadow", "/etc/pbonet/../../srv/arm0.toml"),
    ],
)
def test_a_backup_names_no_other_file_of_a_machine(tmp_path, path):
    """It is written there by root."""
    backup._write(tmp_path, told(content()))
    manifest = tmp_path / backup.MANIFEST
    manifest.write_text(manifest.read_text().replace(CONFIG, path))
    with pytest.raises(ConfigFileError, match="no machine is configured by"):
        backup._read(tmp_path)


@pytest.mark.parametrize(
    ("now", "got"), [(b"core = 9\n", "another"), (None, "No such")]
)
def test_a_backup_whose_files_were_changed_is_refused(tmp_path, now, got):
    there = told(content())
    backup._write(tmp_path, there)
    path = tmp_path / CONFIG.lstrip("/")
    path.write_bytes(now) if now else path.unlink()
    with pytest.raises(ConfigFileError, match=rf"not as it was saved .*got {got}"):
        [*backup._plan(tmp_path, backup._read(tmp_path), there)]
