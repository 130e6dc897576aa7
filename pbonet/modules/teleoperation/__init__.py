"""Teleoperation: what a person commands."""
