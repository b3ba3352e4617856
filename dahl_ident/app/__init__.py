"""The page for those who do not program: from a file to a signed report, in a browser.

A server on this machine alone shows pages made from the plain files of a folder (`work`). What
takes time is a command of ``dahl-ident`` in a child process (`work`, `commands`), so that the page
shows the commands that it ran, and everything can be repeated without it.
"""

from dahl_ident.app.server import serve

__all__ = ["serve"]
