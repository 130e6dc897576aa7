"""The library's own RMOD files can be read, and its robot interfaces are safe."""

from pbonet.config import Library


def test_every_robot_interface_of_the_library_is_critical_and_safe():
    """One without CRITICAL is a part of a task that is, such as of a vehicle's link."""
    library = Library()
    records = library.records()
    assert {*records} == {*library.rmods()}, "a file that is wrong is left out"
    parts = {p.module for one in records.values() if one.critical for p in one.parts}
    robots = {}
    for name, record in records.items():
        info = library.load_rmod(record).info
        if info.robot_interface:
            robots[name] = info.critical_ok and (record.critical or name in parts)
    assert {"puma_pidg", "mujoco_arm", "mav_vehicle"} <= robots.keys()
    assert [name for name, is_safe in robots.items() if not is_safe] == []
