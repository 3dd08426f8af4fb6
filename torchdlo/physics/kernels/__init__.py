"""C++ kernels of the rods and how kernels are built."""
