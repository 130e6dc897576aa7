"""Subsystem interfaces: they exchange variables with other subsystems."""
