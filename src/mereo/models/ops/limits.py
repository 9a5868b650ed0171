"""What a GPU needs to answer within milliseconds: two kernels, and frames of fixed shapes as CUDA graphs."""

MOST_ORDERED = 16384
"""Points of one cloud that a program of the GPU can keep: 16 in each of 1024 threads."""
