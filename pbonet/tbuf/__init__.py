"""tbuf."""
