"""Command line: the commands, and what they print."""
