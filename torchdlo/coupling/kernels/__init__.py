"""C++ kernels of the couplings."""
