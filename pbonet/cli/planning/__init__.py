"""Verbs that plan a job: where its tasks run, and how often."""
