"""Many devices with one command: a table of results, and statistics of the population.

Nothing is imported here: a new process limits the threads of numerical libraries
(:func:`dahl_ident.campaigns.work.one_thread`) before any of them is loaded.
"""
