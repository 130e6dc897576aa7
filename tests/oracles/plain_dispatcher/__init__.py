"""The dispatcher's rules in plain Python, and a core in virtual time under them."""
