"""The inference path: from a sensor's frame to closed surfaces of every segment."""
