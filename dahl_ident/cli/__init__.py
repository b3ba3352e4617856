"""The command line ``dahl-ident``, with the same terms as the Python API.

Exit status: 0 the result can be used; 1 bad input, with a message of one line; 2 wrong usage of the
command; 3 the result must not be used, and the output gives the reason.
"""

from dahl_ident.cli.app import main

__all__ = ["main"]
