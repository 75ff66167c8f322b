"""Real people as supervisors: a fleet that runs one timestep at a time, and the pages on which people help it.

`engine`, `seats`, `record` and `session` know nothing of the web; `server` and `guard` know nothing of robots.
"""
