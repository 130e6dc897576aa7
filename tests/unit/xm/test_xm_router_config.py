"""A router's configuration: what is refused, with the place, and what is printed."""

import re

import pytest

from pbonet.errors import ConfigError, ConfigFileError, NodeError
from pbonet.router import router_config
from pbonet.xm.net import pki
from pbonet.xm.net.credentials import Role

HERE = "tcp/127.0.0.1:7447"


@pytest.fixture(scope="module")
def authority(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lab")
    pki.make_authority(folder)
    return folder


def file(folder, text, name="router.json5"):
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "place", "said"),
    [
        ("{listen: {endpoints: []\n mode: 1}", ":1:", "expected"),
        ("{\n listen: {endpoint: []}}", ":2:11:", "unknown field `endpoint`"),
        ("{listen:\n {endpoints: 7}}", ":2:14:", "expected list of endpoints"),
    ],
)
def test_a_mistake_is_named_with_its_place(tmp_path, text, place, said):
    path = file(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        router_config.read(path)
    assert str(caught.value).startswith(f"{path}{place}")
    assert said in str(caught.value)


def test_files_that_are_none(tmp_path):
    with pytest.raises(ConfigFileError, match="No such file"):
        router_config.read(tmp_path / "router.json5")
    with pytest.raises(ConfigFileError, match=re.escape("--show` prints one")):
        router_config.read(file(tmp_path, "", "router.toml"))


@pytest.mark.parametrize(
    "text",
    [
        "{}",
        '{listen: {endpoints: ["tcp/0.0.0.0:7"]}}',
        '{listen: {endpoints: ["tls/0.0.0.0:7"]}}',
    ],
)
def test_what_is_open_to_all_is_refused(tmp_path, text):
    """By zenoh's own endpoint, too."""
    path = file(tmp_path, text)
    with pytest.raises(NodeError, match="is not protected"):
        router_config.read(path)
    assert router_config.endpoints(router_config.read(path, insecure=True), "listen")


def test_one_that_listens_nowhere():
    with pytest.raises(NodeError, match="listens somewhere"):
        router_config.read()


def test_plugins_are_zenohds(tmp_path):
    text = f'{{listen: {{endpoints: ["{HERE}"]}}, plugins: {{rest: {{}}}}}}'
    with pytest.raises(ConfigError, match=re.escape("got rest); remove `plugins`")):
        router_config.read(file(tmp_path, text))


def test_options_replace_what_the_file_says(tmp_path, authority):
    text = '{mode: "peer", listen: {endpoints: ["tcp/[::]:1"]}, id: "a1"}'
    path = file(tmp_path, text)
    told = router_config.read(path, listen=[HERE], connect=["tcp/127.0.0.1:2"])
    assert router_config.endpoints(told, "listen") == [HERE]
    assert router_config.endpoints(told, "connect") == ["tcp/127.0.0.1:2"]
    assert told.get_json("mode") == '"router"'
    assert told.get_json("id") == '"a1"'
    keys = pki.issue(authority, Role.GATEWAY, "router", hosts=["10.0.0.8"])
    told = router_config.read(path, listen=["tls/[::]:7447"], key_folder=keys)
    assert str(keys) in told.get_json("transport/link/tls")
    assert "pbonet-master" in told.get_json("access_control")


def test_keys_must_be_those_of_a_gateway(authority):
    keys = pki.issue(authority, Role.AGENT, "robot", hosts=["10.0.0.2"])
    with pytest.raises(ConfigFileError, match=r"expected gateway, got agent"):
        router_config.read(listen=["tls/[::]:7447"], key_folder=keys)


def test_what_is_printed_is_read_again(tmp_path):
    shown = router_config.show(router_config.read(listen=[HERE]))
    again = router_config.read(file(tmp_path, shown))
    assert router_config.show(again) == shown
    assert '"max_sessions": 10000' in shown
