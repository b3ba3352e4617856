"""What a process that does fits has loaded before it starts, with one numerical thread.

Loaded once by the server that the processes are forked from; a process that replaces one that
died starts at once.
"""

from dahl_ident.campaigns.work import one_thread

one_thread()

import dahl_ident as di  # noqa: E402 - threads are limited before numerical libraries are loaded

LOADED = (di.extract, di.fit, di.read_frequency_response, di.read_record, di.report)
