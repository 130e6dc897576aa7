"""Digital controllers: they compute commands for actuators."""
