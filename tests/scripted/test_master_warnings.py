"""Warnings of a master: which are told, and when again."""

from __future__ import annotations

from unittest.mock import Mock


def test_warning_is_told_once_while_it_holds_and_again_when_it_is_back(arm):
    arm.start("puma")
    arm.heard.clear()
    arm.control("grav_comp", "off")
    (told,) = arm.heard
    arm.control("jttrace", "off")
    arm.control("jttrace", "on")
    assert arm.heard.count(told) == 1
    arm.files.producers = Mock(side_effect=AssertionError)
    arm.control("jttrace", "reinit")  # nothing is new, so the library is not read
    del arm.files.producers
    arm.control("grav_comp", "on")
    arm.heard.clear()
    arm.control("grav_comp", "off")
    assert arm.heard == [told]
