"""Verbs that set up, upgrade, back up and restore machines over ssh."""
