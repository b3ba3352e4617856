"""The command line: ``dahl-ident``, the Python API in the same words.

Exit status: 0 the result can be trusted; 1 bad input, said in one line; 2 wrong use of the
command; 3 the result is not to be trusted, and the output says why.
"""

from dahl_ident.cli.app import main

__all__ = ["main"]
