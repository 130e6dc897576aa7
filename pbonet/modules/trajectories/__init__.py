"""Trajectory generators: they output a goal for each cycle."""
