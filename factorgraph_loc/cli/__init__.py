"""The command ``fgloc``: options, what is printed, exit codes."""
