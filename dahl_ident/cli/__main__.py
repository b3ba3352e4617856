"""``python -m dahl_ident.cli``: the command line, if its script is not on the path."""

from dahl_ident.cli import main

main()
