"""Registration of an object's own deformation model to one frame of a depth camera."""
