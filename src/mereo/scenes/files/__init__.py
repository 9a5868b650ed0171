"""Scenes from users' files: schema, building, checking, and the first draft of a file."""
