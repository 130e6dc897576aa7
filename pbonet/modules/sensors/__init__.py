"""Sensors and estimators: they turn raw measurements into quantities."""
