"""Verbs of express mail: semaphores, queues, mailboxes and files of all machines."""
