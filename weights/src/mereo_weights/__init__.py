"""Trained networks of mereo's built-in objects, each with its model card: files alone, which mereo looks up by name."""
