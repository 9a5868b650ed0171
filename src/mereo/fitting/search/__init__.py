"""Search for the pose and the state of an object in a frame, without a network."""
