"""From a sensor's frame to closed surfaces of every segment."""
