"""The share of a core in an ``agent.toml``."""

import pytest

from pbonet.config import parse_agent
from pbonet.errors import ConfigError


def test_the_share_of_a_core_is_what_the_kernel_grants_unless_it_is_said():
    assert parse_agent("").core_share is None
    assert parse_agent("core_share = 0.9\n").core_share == 0.9
    assert parse_agent("core_share = 1\n").core_share == 1.0


@pytest.mark.parametrize("share", ["0.0", "-0.5", "1.01", "95.0", "nan"])
def test_a_share_that_cannot_be_is_refused_with_its_line(share):
    with pytest.raises(ConfigError) as caught:
        parse_agent(f'name = "arm0"\ncore_share = {share}\n', "agent.toml")
    assert "agent.toml:2:1: core_share is out of bounds" in str(caught.value)
