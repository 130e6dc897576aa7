"""Judges configurations: legal, in order, schedulable? Nothing is run or asked."""
