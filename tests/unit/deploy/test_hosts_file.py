"""The file of machines: what it says, and how it is refused."""

import pytest

from pbonet.deploy import read_hosts
from pbonet.errors import PbonetError

GOOD = """
authority = "keys"
wheel = "wheels/pbonet-0.2.0-cp311-cp311-linux_x86_64.whl"
extras = ["robot", "files"]

[hosts.arm-pc]
address = "10.0.0.2"
names = ["arm-pc.lab", "10.0.0.2"]

[hosts.arm-pc.rtpus.arm0]
core = 3
listen = ["tls/0.0.0.0:7447"]
device.adc0 = {driver = "iio_adc", address = "/sys/bus/iio/devices/iio:device0"}

[hosts.desk.rtpus]
desk = "desk.toml"
"""


@pytest.fixture
def read(tmp_path):
    """Read a text as a file of machines."""

    def one(text, *only):
        path = tmp_path / "lab.toml"
        path.write_text(text)
        (tmp_path / "desk.toml").write_text("core = 1 # mine\n")
        return read_hosts(path, only)

    return one


def test_machines_with_configurations_and_addresses(read, tmp_path):
    file = read(GOOD)
    arm, desk = file.machines
    assert arm.reached_at == ("10.0.0.2", "arm-pc.lab")
    assert 'keys = "/etc/pbonet/keys"' in arm.configs["arm0"]
    assert "[device.adc0]" in arm.configs["arm0"]
    assert arm.cores == {"arm0": 3}
    assert desk.address == "desk"
    assert desk.configs == {"desk": "core = 1 # mine\n"}
    assert file.authority == tmp_path / "keys"
    assert file.extras == ("files", "robot")
    assert [one.name for one in file.wheels] == [
        "pbonet-0.2.0-cp311-cp311-linux_x86_64.whl"
    ]
    both = GOOD.replace('wheel = "', 'wheel = ["other.whl", "').replace(
        '.whl"\n', '.whl"]\n'
    )
    assert [one.name for one in read(both).wheels] == ["other.whl", file.wheels[0].name]
    assert read(GOOD.partition("extras")[2].partition("\n")[2]).wheels == []
    assert file.homes == {"arm0": "arm-pc", "desk": "desk"}
    assert [one.name for one in read(GOOD, "desk").machines] == ["desk"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("[hosts.desk.rtpus]", "[hosts.desk.rtpus"), "this is not TOML"),
        (("address =", "adress ="), "adress"),
        (("core = 3", "core = -3"), "there is no such core"),
        (("core = 3", "cores = 3"), "unknown key 'cores'"),
        (("core = 3", 'core = "3"'), "a whole number"),
        (("[hosts.arm-pc]", '["hosts"."../arm"]'), "is no name of a host"),
        (('desk = "desk.toml"', 'desk = "no.toml"'), "cannot be read"),
        (('desk = "desk.toml"', 'arm0 = "desk.toml"'), "two hosts have an RTPU arm0"),
        (('desk = "desk.toml"', '"../x" = "desk.toml"'), "not a valid name"),
        (('"robot"', '"robot]; rm"'), "is no extra of pbonet"),
    ],
)
def test_what_cannot_be_is_refused_with_its_place(read, change, said):
    text = GOOD.replace(*change)
    with pytest.raises(PbonetError) as caught:
        read(text)
    assert said in str(caught.value)
    assert caught.value.remedy or "core" in said


def test_an_unknown_machine_is_told_with_a_near_name(read):
    with pytest.raises(PbonetError, match=r"no host arm-cp .*did you mean arm-pc"):
        read(GOOD, "arm-cp")


def test_two_rtpus_of_a_machine_have_cores_of_their_own(read):
    more = "\n[hosts.arm-pc.rtpus.arm1]\ncore = 3\n"
    with pytest.raises(PbonetError, match="two RTPUs of a host have one core"):
        read(GOOD + more)
