"""Verbs with which an operator sees how machines and subsystems are, and why."""
