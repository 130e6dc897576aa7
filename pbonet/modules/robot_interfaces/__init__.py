"""Robot interfaces: they command hardware or its simulation, and measure."""
