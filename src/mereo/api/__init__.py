"""The public functions: objects, frames, the answer to a frame, following, and what leads to weights."""
