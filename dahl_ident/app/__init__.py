"""Web pages for users who do not program: from a file to a signed report.

A server that only this machine can reach makes the pages from plain files in a folder (`work`).
Every task that takes time is a command of ``dahl-ident`` in a child process (`work`, `commands`).
The pages show these commands, so that everything can be repeated without them.
"""
