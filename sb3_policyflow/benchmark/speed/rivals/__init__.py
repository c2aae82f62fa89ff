"""Whole iterations of PolicyFlow and of the PPOs that one would use in its place, in turn.

``command.py`` starts a process for each (``process.py``), which runs ``worker.py`` and in it one
adapter of ``adapters/``. The command asks one process after the other for an iteration; the others
wait. None of the libraries is a dependency of the package.
"""
