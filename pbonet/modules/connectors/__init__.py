"""Connectors: they join or select variables."""
