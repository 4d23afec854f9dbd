"""The command line ``regnf``: one module a command."""
