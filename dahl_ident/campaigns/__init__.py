"""Many devices with one command: a table of results, and statistics of the population."""
