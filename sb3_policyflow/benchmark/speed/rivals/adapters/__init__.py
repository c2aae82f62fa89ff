"""One module for each rival, with ``make(setting)``, which returns what trains for one iteration.

Each imports its library, and is itself imported only in a process that is to train with it.
"""
