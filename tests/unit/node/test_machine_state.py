"""What an agent says of its machine's memory."""

from pbonet.node.agent.machine_state import copy_speed


def test_the_speed_of_memory_is_measured_once():
    """No bound is exact: a memory moves 100 MB to 1 TB a second."""
    copy_speed.cache_clear()
    speed = copy_speed()
    assert 1e8 <= speed <= 1e12
    assert copy_speed() is speed
