"""What a GPU needs to answer within milliseconds: two kernels, and frames of fixed shapes as CUDA graphs."""
