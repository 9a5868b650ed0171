"""One frame's way to its answer: which points, who finds the object in them, and whether that is believed."""
