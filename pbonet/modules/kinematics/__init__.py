"""Kinematics and dynamics of arms."""
