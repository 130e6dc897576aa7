"""Express mail: what agents and masters say to each other (Stewart 1994, section 5.3).

Keys, messages, sessions and the request layer; everything over zenoh is opened here.
"""
